"""`demorec list`: what there is to choose from."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from tyro.conf import Positional

from demorec.cli.shared.output import aligned, say, say_json

if TYPE_CHECKING:
    from demorec.core.registry import Registry


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

        registry: Registry[Any] = getattr(tables, self.what.upper())
        describe = _DESCRIBED.get(self.what, _own_summary)
        rows = [(name, describe(registry, name)) for name in registry.names()]
        if self.json:
            say_json([{"name": name, "summary": summary} for name, summary in rows])
        else:
            say(*aligned(rows))
        return 0


def _own_summary(registry: Registry[Any], name: str) -> str:
    return str(registry.load(name).summary)


def _robot(registry: Registry[Any], name: str) -> str:
    robot = registry.load(name)
    opening = 1000 * robot.gripper.open_width
    return f"{len(robot.arm_joints)} joints, gripper opening {opening:.0f} mm, from {robot.urdf}"


def _kinds(registry: Registry[Any], name: str) -> str:
    kinds = registry.load(name).kinds
    return f"{sum(kind.count for kind in kinds)} shapes: {', '.join(kind.noun for kind in kinds)}"


def _first_line_of_docstring(registry: Registry[Any], name: str) -> str:
    return (registry.load(name).__doc__ or "").strip().splitlines()[0]


_DESCRIBED: Mapping[str, Callable[[Registry[Any], str], str]] = {
    "robots": _robot,
    "objects": _kinds,
    "renderers": _first_line_of_docstring,
}
"""How a row is described in one line, where it has no summary of its own."""
