"""`demorec list`: what there is to choose from."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from tyro.conf import Positional

from demorec.cli.shared.output import aligned, say, say_json

if TYPE_CHECKING:
    from demorec.core.registry import Registry
    from demorec.objects.shelf import Shelf
    from demorec.robots.robot import RobotSpec


@dataclass(frozen=True, kw_only=True)
class ListRows:
    """List the available tasks, cameras, robots, objects, renderers, export formats or checks.

    Examples:
      demorec list tasks
      demorec list cameras --json
    """

    what: Positional[Literal["tasks", "cameras", "robots", "objects", "renderers", "exporters", "checks"]]
    """What to list."""
    json: bool = False
    """Print JSON: a list of names and summaries."""

    def run(self) -> int:
        """Print one line each."""
        from demorec.core import tables

        if self.what == "checks":
            from demorec.extensions.doctor.explain_command import check_rows

            rows = list(check_rows())
        else:
            registry: Registry[Any] = getattr(tables, self.what.upper())
            describe = _DESCRIBED.get(self.what, lambda row: str(row.summary))
            rows = [(name, describe(registry.load(name))) for name in registry.names()]
        if self.json:
            say_json([{"name": name, "summary": summary} for name, summary in rows])
        else:
            say(*aligned(rows))
        return 0


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
"""How a row is described in one line, where it has no summary of its own."""
