"""Renderers are given plain data: nothing in their folder calls a simulator, not even one that is passed in."""

from __future__ import annotations

import ast
from pathlib import Path

import pybullet
import pytest

import demorec.render

FILES = sorted(Path(demorec.render.__file__).parent.rglob("*.py"))


def pybullet_names(source: str) -> set[str]:
    """Attributes that are called like functions or constants of PyBullet."""
    attributes = {node.attr for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Attribute)}
    return attributes & {name for name in dir(pybullet) if not name.startswith("__") and name.lower() != name}


def test_a_call_through_a_parameter_would_be_found() -> None:
    assert pybullet_names("def f(c): return c.getVisualShapeData(0)[c.GEOM_BOX]") == {"getVisualShapeData", "GEOM_BOX"}


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_nothing_asks_a_simulator(path: Path) -> None:
    assert pybullet_names(path.read_text()) == set()
