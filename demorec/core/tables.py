"""Tables of everything users can name; `demorec.core.extension` provides their rows."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from demorec.core.extension import targets_of
from demorec.core.registry import Registry, is_foreign, modules_of, split_name
from demorec.robots.assets import model_name

if TYPE_CHECKING:
    from demorec.check.base import Check
    from demorec.datasets.options import Exporter
    from demorec.objects.shelf import Shelf
    from demorec.render import Renderer
    from demorec.render.cameras import CameraPreset
    from demorec.robots.robot import RobotSpec
    from demorec.tasks.base import Task

TASKS: Registry[type[Task]] = Registry(kind="task", rows=targets_of("tasks"), subclass_of="demorec.tasks.base:Task")
ROBOTS: Registry[RobotSpec] = Registry(
    kind="robot", rows=targets_of("robots"), instance_of="demorec.robots.robot:RobotSpec"
)
CAMERAS: Registry[CameraPreset] = Registry(
    kind="camera", rows=targets_of("cameras"), instance_of="demorec.render.cameras:CameraPreset"
)
OBJECTS: Registry[Shelf] = Registry(kind="shelf", rows=targets_of("objects"), instance_of="demorec.objects.shelf:Shelf")
RENDERERS: Registry[type[Renderer]] = Registry(kind="renderer", rows=targets_of("renderers"))
EXECUTORS: Registry[Callable[..., Any]] = Registry(kind="executor", rows=targets_of("executors"))
EXPORTERS: Registry[Exporter[Any]] = Registry(kind="format", rows=targets_of("exporters"))
EXTRA_FILES: Registry[Any] = Registry(kind="flag", rows=targets_of("extra_files"))
FILE_CHECKS: Registry[Check] = Registry(kind="check", rows=targets_of("file_checks"))
LISTS: Registry[Callable[[], Any]] = Registry(kind="list", rows=targets_of("lists"))
RANKINGS: Registry[Callable[..., Any]] = Registry(kind="ranking", rows=targets_of("rankings"))


def load_robot(name: str, allowed: Collection[str] = ()) -> RobotSpec:
    """Load a robot by `ROBOTS.load`, with the model path of a user's robot in the form that recordings use.

    Raises:
        ConfigError: As in `Registry.load`, or recordings cannot name the model's location.
    """
    robot = ROBOTS.load(name, allowed)
    module, *_ = modules_of([ROBOTS.target(name)])
    return replace(robot, urdf=model_name(robot.urdf, module)) if is_foreign(module) else robot


def environment_name(task: str) -> str:
    """Gymnasium ID of a task's environment: "demorec/PickPlace-v0", or "demorec/Mine-v0" for "my_package:Mine"."""
    name = "".join(word.capitalize() for word in task.split("_")) if task in TASKS.rows else task.rpartition(":")[2]
    return f"demorec/{name}-v0"


def camera_name(name: str) -> str:
    """Name of a camera in recordings and datasets: the row's name, or "top" for "my_cameras:TOP"."""
    return name if split_name(name) is None else name.rpartition(":")[2].lower()
