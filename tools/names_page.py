"""Print docs/api.md: every name that commands accept and that `demorec.api` has, as the code describes it."""

from __future__ import annotations

import ast
import importlib
import inspect
import itertools
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

from demorec.api import GROUPS
from demorec.cli.list_rows import rows_of
from demorec.core.tables import TASKS
from demorec.episode.info import OBSERVATION
from demorec.sim.sensors import SENSORS

COMMANDS = """# Every name: for commands, and for Python

`make docs` writes this page from the code. `demorec list` prints the names for commands, and those that installed
packages add.
"""
TITLES = {
    "robots": "Robots (`--robot`)",
    "cameras": "Cameras (`--cameras`)",
    "objects": "Objects (`--objects`)",
    "renderers": "Renderers (`--renderer`)",
    "exporters": "Export formats (`demorec export FORMAT`)",
    "checks": "Checks (`demorec explain CHECK`)",
    "extensions": "Extensions",
}
PYTHON = """# Python

`demorec.api` has what other packages may rely on; everything else may change.

    from demorec.api import open_recording
"""
FOREIGN = {"Positional": "Marks a field of a command as a positional argument (tyro's `Positional`)."}
"""Names of other packages."""


def page() -> str:
    """Return the page."""
    tasks = [(name, TASKS.load(name).summary, success(TASKS.load(name))) for name in TASKS.names()]
    sensors = [(OBSERVATION + sensor.quantity, sensor.meaning) for sensor in SENSORS]
    parts = [COMMANDS, table("Tasks (`--task`)", ("name", "motion", "success"), tasks)]
    parts += [table(title, ("name", "meaning"), rows_of(what)) for what, title in TITLES.items()]
    parts += [table("Sensors of simulated arms", ("feature", "meaning"), sensors), PYTHON]
    for purpose, modules in GROUPS.items():
        places = [(name, importlib.import_module(module)) for module, names in modules.items() for name in names]
        rows = [(name, sentence(module, name)) for name, module in places]
        parts.append(table(purpose, ("name", "meaning"), rows))
    return "\n".join(parts)


def table(title: str, columns: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a section with a table; the first column holds names."""
    lines = [f"| `{name}` | {' | '.join(text.replace('|', '\\|') for text in texts)} |" for name, *texts in rows]
    return "\n".join([f"## {title}\n", f"| {' | '.join(columns)} |", "|---" * len(columns) + "|", *lines, ""])


def success(task: type[Any]) -> str:
    """Return the conditions of success of a task: the paragraph of its docstring after "Success:"."""
    found = re.search(r"Success: (.+?)(?=\n\S|\n\n|\Z)", inspect.getdoc(task) or "", re.DOTALL)
    assert found, f"the docstring of {task.__name__} has no line that begins with Success:"
    return " ".join(found[1].split()).removesuffix(".")


def sentence(module: ModuleType, name: str) -> str:
    """Return the first sentence about a name: of its docstring, the string below a constant, or its module."""
    value = getattr(module, name)
    if name in FOREIGN:
        text = FOREIGN[name]
    elif inspect.isclass(value) or inspect.isfunction(value):
        text = inspect.getdoc(value) or ""
    else:
        text = constant_text(Path(str(module.__file__)), name) or inspect.getdoc(module) or ""
    return re.split(r"(?<=\.) (?=[A-Z])", " ".join(text.split("\n\n")[0].split()))[0]


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
