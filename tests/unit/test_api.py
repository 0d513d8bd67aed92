"""demorec.api: its names load on demand, and programs outside of demorec need no others."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

from demorec import api

ROOT = Path(__file__).parents[2]
OUTSIDE = ("examples", "plugins", "viewers", "tests/support/lab_extension")


def test_every_name_loads() -> None:
    names = [name for modules in api.GROUPS.values() for names in modules.values() for name in names]
    assert len(set(names)) == len(names)
    for name in names:
        value = getattr(api, name)
        assert value is not None
        assert name in dir(api)
    with pytest.raises(AttributeError, match="no attribute 'OpenRecording'"):
        _ = api.OpenRecording


def test_types_are_those_of_the_names() -> None:
    """Type checkers read the module's imports, which must equal those at run time."""
    tree = ast.parse(Path(api.__file__).read_text())
    typed = {
        name.asname: node.module
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom)
        for name in node.names
        if name.asname
    }
    promised = [(module, names) for modules in api.GROUPS.values() for module, names in modules.items()]
    assert typed == {name: module for module, names in promised for name in names}


def test_importing_it_loads_nothing() -> None:
    code = "import sys; import demorec.api; print(sys.modules.keys() & {'numpy', 'pybullet', 'mcap'})"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "set()\n"


def test_programs_outside_use_nothing_else() -> None:
    for folder in OUTSIDE:
        for file in (ROOT / folder).rglob("*.py"):
            if "tests" in file.relative_to(ROOT / folder).parts:
                continue
            for node in ast.walk(ast.parse(file.read_text())):
                modules = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
                modules += [name.name for name in node.names] if isinstance(node, ast.Import) else []
                assert not {m for m in modules if m.startswith("demorec.")} - {"demorec.api"}, file


def test_the_page_is_current() -> None:
    made = subprocess.run(
        [sys.executable, ROOT / "tools" / "names_page.py"], capture_output=True, text=True, check=True
    )
    assert (ROOT / "docs" / "api.md").read_text() == made.stdout, "make docs"
