"""`demorec list`: list the available choices."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional, arg

from demorec.cli.shared.output import aligned, say, say_json
from demorec.core.extension import extensions
from demorec.core.registry import Registry, check_choice
from demorec.core.tables import CAMERAS, EXPORTERS, LISTS, OBJECTS, RENDERERS, ROBOTS, TASKS

if TYPE_CHECKING:
    from demorec.objects.shelf import Shelf
    from demorec.robots.robot import RobotSpec


_TABLES: Mapping[str, Registry[Any]] = {
    "tasks": TASKS,
    "cameras": CAMERAS,
    "robots": ROBOTS,
    "objects": OBJECTS,
    "renderers": RENDERERS,
    "exporters": EXPORTERS,
}
_NAMES = (*_TABLES, *LISTS.names(), "extensions")


@dataclass(frozen=True, kw_only=True)
class ListRows:
    """List the available choices: tasks, cameras, robots, objects, renderers, export formats and more.

    Examples:
      demorec list tasks
      demorec list cameras --json
    """

    what: Annotated[Positional[str], arg(metavar="LIST", help=f"One of: {', '.join(_NAMES)}.")]
    json: bool = False
    """Print JSON: a list of names and summaries."""

    def run(self) -> int:
        """Print one line per row."""
        check_choice("list", self.what, _NAMES)
        rows = rows_of(self.what)
        if self.json:
            say_json([{"name": name, "summary": summary} for name, summary in rows])
        else:
            say(*aligned(rows))
        return 0


def rows_of(what: str) -> list[tuple[str, str]]:
    """Return (name, description in one line) of every row of a list."""
    if what in LISTS.rows:
        return list(LISTS.load(what)())
    if what == "extensions":
        return [(each.name, each.summary) for each in extensions().found]
    registry = _TABLES[what]
    describe = _DESCRIBED.get(what, lambda row: str(row.summary))
    return [(name, describe(registry.load(name))) for name in registry.names()]


def _robot(robot: RobotSpec) -> str:
    opening = 1000 * robot.gripper.open_width
    return f"{len(robot.arm_joints)} joints, gripper opening {opening:.0f} mm, from {robot.urdf}"


def _kinds(shelf: Shelf) -> str:
    return f"{sum(kind.count for kind in shelf.kinds)} shapes: {', '.join(kind.noun for kind in shelf.kinds)}"


_DESCRIBED: Mapping[str, Callable[[Any], str]] = {
    "robots": _robot,
    "objects": _kinds,
    "renderers": lambda renderer: (renderer.__doc__ or "").strip().partition("\n")[0],
}
"""One-line description of rows that have no summary."""
