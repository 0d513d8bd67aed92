"""The import rules of pyproject.toml cover every folder, and modules do not import each other in cycles."""

from __future__ import annotations

import tomllib
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path
from typing import Any

import grimp

PROJECT = Path(__file__).parents[2] / "pyproject.toml"
NEW_FOLDER = "demorec.made_for_trial"


@cache
def _graph(*, with_type_checking: bool) -> grimp.ImportGraph:
    return grimp.build_graph(
        *("demorec", "lerobot_policy_act_keypoints"),
        include_external_packages=True,
        exclude_type_checking_imports=not with_type_checking,
        cache_dir=None,
    )


def _rules() -> list[dict[str, Any]]:
    rules: list[dict[str, Any]] = tomllib.loads(PROJECT.read_text())["tool"]["importlinter"]["contracts"]
    return rules


def _folders() -> list[str]:
    """Every folder and loose module of the package, and one that does not exist yet."""
    return [*sorted(_graph(with_type_checking=False).find_children("demorec")), NEW_FOLDER]


def test_no_modules_import_each_other() -> None:
    """Neither at the top, nor inside functions, nor for the type checker alone."""
    graph = _graph(with_type_checking=True)
    TopologicalSorter({module: graph.find_modules_directly_imported_by(module) for module in graph.modules}).prepare()


def test_every_folder_has_its_own_rule() -> None:
    """The author of a new folder must specify the direction of its imports."""
    placed: set[str] = set()
    for rule in _rules():
        placed |= {f"demorec.{layer.strip('()')}" for layer in rule.get("layers", ())}
        placed |= {*rule.get("source_modules", ()), *rule.get("containers", ())}
    assert set(_folders()) - placed == {NEW_FOLDER}
