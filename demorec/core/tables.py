"""The tables of everything that a user can name, but for commands (`COMMANDS` in demorec/cli).

A row here and one file make a new one (CONTRIBUTING.md).
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from demorec.core.registry import Registry, modules_of, split_name
from demorec.robots.assets import model_name

if TYPE_CHECKING:
    from demorec.check.base import Check
    from demorec.datasets.options import Exporter
    from demorec.objects.shelf import Shelf
    from demorec.render import Renderer
    from demorec.render.cameras import CameraPreset
    from demorec.robots.robot import RobotSpec
    from demorec.tasks.base import Task


def _named_alike(package: str, *modules: tuple[str, ...]) -> dict[str, str]:
    """The rows of objects that are called as their rows are: a module of the package, then what it has, in order."""
    return {name: f"{package}.{module}:{name}" for module, *names in modules for name in names}


TASKS: Registry[type[Task]] = Registry(
    kind="task",
    rows={
        "pick_place": "demorec.tasks.pick:PickPlace",
        "place_in_tray": "demorec.tasks.trays:PlaceInTray",
        "stack": "demorec.tasks.cubes:Stack",
        "stack_three": "demorec.tasks.cubes:StackThree",
        "unstack": "demorec.tasks.cubes:Unstack",
        "sort_by_color": "demorec.tasks.trays:SortByColor",
        "line_up": "demorec.tasks.cubes:LineUp",
        "pick_from_clutter": "demorec.tasks.pick:PickFromClutter",
        "pick_shapes": "demorec.tasks.pick:PickShapes",
        "pick_anything": "demorec.tasks.anything:PickAnything",
        "tutorial": "demorec.tasks.tutorial:Tutorial",
    },
    subclass_of="demorec.tasks.base:Task",
)

ROBOTS: Registry[RobotSpec] = Registry(
    kind="robot",
    rows={
        "panda": "demorec.robots.panda:PANDA",
        "iiwa": "demorec.robots.iiwa:IIWA",
        "so101": "demorec.robots.so101:SO101",
    },
    instance_of="demorec.robots.robot:RobotSpec",
)

CAMERAS: Registry[CameraPreset] = Registry(
    kind="camera",
    rows={
        "front": "demorec.render.cameras:FRONT",
        "wrist": "demorec.render.cameras:WRIST",
        "top": "demorec.render.cameras:TOP",
        "workspace": "demorec.render.cameras:WORKSPACE",
    },
    instance_of="demorec.render.cameras:CameraPreset",
)

OBJECTS: Registry[Shelf] = Registry(
    kind="shelf",
    rows={
        "household": "demorec.objects.household:HOUSEHOLD",
        "blocks": "demorec.objects.blocks:BLOCKS",
        "cubes": "demorec.objects.blocks:CUBES",
        "random": "demorec.objects.folder:RANDOM",
    },
    instance_of="demorec.objects.shelf:Shelf",
)

RENDERERS: Registry[type[Renderer]] = Registry(
    kind="renderer",
    rows={
        "raster": "demorec.render.raster:RasterRenderer",
        "tiny": "demorec.sim.renderers:TinyRenderer",
        "egl": "demorec.sim.renderers:EglRenderer",
    },
)

EXPORTERS: Registry[Exporter[Any]] = Registry(
    kind="format",
    rows={"lerobot": "demorec.datasets.lerobot.options:LEROBOT", "hdf5": "demorec.extensions.hdf5.options:HDF5"},
)

CHECKS: Registry[Check] = Registry(
    kind="check",
    rows=_named_alike(
        "demorec.check",
        ("file", "opens", "checksums", "topics", "readable", "complete", "frame_times", "stamps", "video_frames"),
        ("file", "missing_images"),
        ("images", "images_decode"),
        ("run", "run_files", "run_complete", "run_agrees"),
        ("run_dataset", "run_dataset"),
        ("run", "import_findings", "import_dropped"),
        ("sidecar", "dataset_sidecar"),
    ),
)


def load_robot(name: str, allowed: Collection[str] = ()) -> RobotSpec:
    """`ROBOTS.load`, with the model of a robot of the user's own named as recordings name it.

    Raises:
        ConfigError: As `Registry.load`, or the model lies where a recording cannot name it.
    """
    robot = ROBOTS.load(name, allowed)
    module, *_ = modules_of([name]) or ("",)
    return replace(robot, urdf=model_name(robot.urdf, module)) if module else robot


def environment_name(task: str) -> str:
    """Gymnasium's name of a task's environment: "demorec/PickPlace-v0", or "demorec/Mine-v0" for "my_package:Mine"."""
    name = "".join(word.capitalize() for word in task.split("_")) if task in TASKS.rows else task.rpartition(":")[2]
    return f"demorec/{name}-v0"


def camera_name(name: str) -> str:
    """What a camera is called in recordings and datasets: the row's name, or "top" for "my_cameras:TOP"."""
    return name if split_name(name) is None else name.rpartition(":")[2].lower()
