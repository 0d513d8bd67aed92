"""Print docs/api.md: the names of demorec.api by purpose, each with the first sentence of its documentation."""

from __future__ import annotations

import ast
import importlib
import inspect
import itertools
import re
from pathlib import Path
from types import ModuleType

from demorec.api import GROUPS

HEAD = """# Python API

`demorec.api` has what other packages may rely on; everything else may change. `make docs` writes this page.

    from demorec.api import open_recording
"""
FOREIGN = {"Positional": "Marks a field of a command as a positional argument (tyro's `Positional`)."}
"""Names of other packages."""


def page() -> str:
    """Return the page."""
    parts = [HEAD]
    for purpose, names in GROUPS.items():
        rows = [f"| `{name}` | {sentence(importlib.import_module(module), name)} |" for name, module in names.items()]
        parts.append("\n".join([f"## {purpose}\n", "| name | meaning |", "|---|---|", *rows, ""]))
    return "\n".join(parts)


def sentence(module: ModuleType, name: str) -> str:
    """Return the first sentence about a name: of its docstring, the string below a constant, or its module."""
    value = getattr(module, name)
    if name in FOREIGN:
        text = FOREIGN[name]
    elif inspect.isclass(value) or inspect.isfunction(value):
        text = inspect.getdoc(value) or ""
    else:
        text = constant_text(Path(str(module.__file__)), name) or inspect.getdoc(module) or ""
    return re.split(r"(?<=\.) (?=[A-Z])", " ".join(text.split("\n\n")[0].split()))[0].replace("|", "\\|")


def constant_text(file: Path, name: str) -> str:
    """Return the string below the assignment of a constant; "" without one."""
    for line, below in itertools.pairwise(ast.parse(file.read_text()).body):
        targets = [*getattr(line, "targets", ()), getattr(line, "target", None)]
        is_named = any(isinstance(target, ast.Name) and target.id == name for target in targets)
        if is_named and isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant):
            return str(below.value.value)
    return ""


if __name__ == "__main__":
    print(page(), end="")
