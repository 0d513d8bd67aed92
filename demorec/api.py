"""The interface for other packages: every name here keeps its meaning from one version to the next.

Names are loaded when they are used: importing this module costs nothing. Names of an extension need its folder.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from demorec.check.base import Fault as Fault
    from demorec.check.base import NotMeasuredError as NotMeasuredError
    from demorec.check.base import check as check
    from demorec.cli.shared.flags import Positional as Positional
    from demorec.cli.shared.output import say as say
    from demorec.core.atomic import atomic_write as atomic_write
    from demorec.core.config import GenerateConfig as GenerateConfig
    from demorec.core.errors import ConfigError as ConfigError
    from demorec.core.errors import DemorecError as DemorecError
    from demorec.core.errors import ExportError as ExportError
    from demorec.core.errors import RecordingError as RecordingError
    from demorec.core.errors import SceneError as SceneError
    from demorec.core.extension import CommandRow as CommandRow
    from demorec.core.extension import ExporterRow as ExporterRow
    from demorec.core.extension import Extension as Extension
    from demorec.core.extension import ExtraFilesRow as ExtraFilesRow
    from demorec.core.extension import KindRow as KindRow
    from demorec.core.extension import ReaderRow as ReaderRow
    from demorec.core.geometry import Pose as Pose
    from demorec.core.replacing import ReplaceableKind as ReplaceableKind
    from demorec.datasets.episode import ExportEpisode as ExportEpisode
    from demorec.datasets.lerobot.language import Statement as Statement
    from demorec.datasets.options import CommonOptions as CommonOptions
    from demorec.datasets.options import Exporter as Exporter
    from demorec.datasets.options import ExportReport as ExportReport
    from demorec.datasets.options import ProgressCallback as ProgressCallback
    from demorec.datasets.sources import find_recordings as find_recordings
    from demorec.episode.episode import Event as Event
    from demorec.episode.episode import Outcome as Outcome
    from demorec.episode.episode import SuccessCheck as SuccessCheck
    from demorec.episode.episode import Table as Table
    from demorec.episode.features import ENVIRONMENT_STATE as ENVIRONMENT_STATE
    from demorec.episode.features import state_names as state_names
    from demorec.episode.info import Camera as Camera
    from demorec.episode.info import EpisodeInfo as EpisodeInfo
    from demorec.episode.info import Feature as Feature
    from demorec.episode.protocol import Episode as Episode
    from demorec.episode.protocol import SceneMotion as SceneMotion
    from demorec.episode.scene import Body as Body
    from demorec.episode.scene import Goal as Goal
    from demorec.episode.scene import Scene as Scene
    from demorec.episode.scene import Shape as Shape
    from demorec.extensions.doctor.evidence import EpisodeEvidence as EpisodeEvidence
    from demorec.extensions.doctor.evidence import Evidence as Evidence
    from demorec.extensions.policies.gym_env import DemorecEnv as DemorecEnv
    from demorec.extensions.policies.gym_env import env_id as env_id
    from demorec.extensions.recorder.recorder import RecordedEpisode as RecordedEpisode
    from demorec.extensions.recorder.recorder import Recorder as Recorder
    from demorec.generate.executor import Executor as Executor
    from demorec.generate.executor import attempt_episode as attempt_episode
    from demorec.mcap import EpisodeWriter as EpisodeWriter
    from demorec.mcap import Recording as Recording
    from demorec.mcap import open_recording as open_recording
    from demorec.objects.shelf import Shelf as Shelf
    from demorec.render import Renderer as Renderer
    from demorec.render.cameras import CameraPreset as CameraPreset
    from demorec.robots.iiwa import IIWA as IIWA
    from demorec.robots.motors import Motors as Motors
    from demorec.robots.panda import PANDA as PANDA
    from demorec.robots.robot import JawGripper as JawGripper
    from demorec.robots.robot import ParallelGripper as ParallelGripper
    from demorec.robots.robot import RobotSpec as RobotSpec
    from demorec.robots.so101 import SO101 as SO101
    from demorec.robots.so101 import SO101_FOLLOWER as SO101_FOLLOWER
    from demorec.sim.world import World as World
    from demorec.tasks.base import PlacingTask as PlacingTask
    from demorec.tasks.base import Task as Task
    from demorec.tasks.base import on_table as on_table
    from demorec.tasks.base import random_cube as random_cube
    from demorec.tasks.furniture import mark as mark
    from demorec.tasks.furniture import robot_at_origin as robot_at_origin
    from demorec.tasks.furniture import table_and_floor as table_and_floor
    from demorec.tasks.grasping import hand_down as hand_down
    from demorec.tasks.grasping import hand_yaw as hand_yaw
    from demorec.tasks.grasping import raised as raised
    from demorec.tasks.grasping import symmetric_yaws as symmetric_yaws
    from demorec.tasks.pick import PickPlace as PickPlace
    from demorec.tasks.sampling import Region as Region
    from demorec.tasks.sampling import Sampler as Sampler
    from demorec.tasks.sampling import wording as wording
    from demorec.tasks.script import ExpertFailure as ExpertFailure
    from demorec.tasks.script import Step as Step
    from demorec.tasks.script import steady_width as steady_width
    from demorec.tasks.skills import Expert as Expert
    from demorec.tasks.success import placement_checks as placement_checks
    from demorec.testing import RobotContract as RobotContract
    from demorec.testing import TaskContract as TaskContract
    from demorec.view.episode import Playback as Playback
    from demorec.view.paths import Paths as Paths
    from demorec.view.scene import log_episode as log_episode
    from demorec.view.scene import new_recording as new_recording
    from demorec.view.sources import PlaybackSource as PlaybackSource
    from demorec.view.sources import find_episodes as find_episodes

GROUPS: Mapping[str, Mapping[str, tuple[str, ...]]] = {
    "Record": {
        "demorec.extensions.recorder.recorder": ("Recorder", "RecordedEpisode"),
    },
    "Read": {
        "demorec.mcap": ("open_recording", "Recording"),
        "demorec.datasets.sources": ("find_recordings",),
        "demorec.episode.protocol": ("Episode", "SceneMotion"),
        "demorec.episode.info": ("EpisodeInfo", "Feature", "Camera"),
        "demorec.episode.episode": ("Table", "Event", "Outcome"),
        "demorec.episode.features": ("state_names", "ENVIRONMENT_STATE"),
        "demorec.core.geometry": ("Pose",),
    },
    "View": {
        "demorec.view.sources": ("find_episodes",),
        "demorec.view.scene": ("log_episode", "new_recording"),
        "demorec.view.paths": ("Paths",),
    },
    "Write a task": {
        "demorec.tasks.base": ("Task", "PlacingTask", "random_cube", "on_table"),
        "demorec.tasks.pick": ("PickPlace",),
        "demorec.episode.scene": ("Scene", "Body", "Shape", "Goal"),
        "demorec.tasks.sampling": ("Sampler", "Region", "wording"),
        "demorec.tasks.furniture": ("mark", "robot_at_origin", "table_and_floor"),
        "demorec.tasks.skills": ("Expert",),
        "demorec.tasks.script": ("Step", "ExpertFailure", "steady_width"),
        "demorec.tasks.grasping": ("hand_down", "hand_yaw", "raised", "symmetric_yaws"),
        "demorec.sim.world": ("World",),
        "demorec.episode.episode": ("SuccessCheck",),
        "demorec.tasks.success": ("placement_checks",),
        "demorec.testing": ("TaskContract",),
    },
    "Describe a robot, a camera, objects": {
        "demorec.robots.robot": ("RobotSpec", "ParallelGripper", "JawGripper"),
        "demorec.robots.motors": ("Motors",),
        "demorec.robots.panda": ("PANDA",),
        "demorec.robots.iiwa": ("IIWA",),
        "demorec.robots.so101": ("SO101", "SO101_FOLLOWER"),
        "demorec.testing": ("RobotContract",),
        "demorec.render.cameras": ("CameraPreset",),
        "demorec.render": ("Renderer",),
        "demorec.objects.shelf": ("Shelf",),
    },
    "Simulate and learn": {
        "demorec.core.config": ("GenerateConfig",),
        "demorec.mcap": ("EpisodeWriter",),
        "demorec.extensions.policies.gym_env": ("DemorecEnv", "env_id"),
    },
    "Write an extension": {
        "demorec.core.extension": ("Extension", "CommandRow", "ExporterRow", "ExtraFilesRow", "KindRow", "ReaderRow"),
        "demorec.view.sources": ("PlaybackSource",),
        "demorec.view.episode": ("Playback",),
        "demorec.datasets.options": ("Exporter", "CommonOptions", "ExportReport", "ProgressCallback"),
        "demorec.datasets.episode": ("ExportEpisode",),
        "demorec.datasets.lerobot.language": ("Statement",),
        "demorec.core.atomic": ("atomic_write",),
        "demorec.core.replacing": ("ReplaceableKind",),
        "demorec.check.base": ("check", "Fault", "NotMeasuredError"),
        "demorec.extensions.doctor.evidence": ("Evidence", "EpisodeEvidence"),
        "demorec.generate.executor": ("Executor", "attempt_episode"),
        "demorec.cli.shared.flags": ("Positional",),
        "demorec.cli.shared.output": ("say",),
    },
    "Handle errors": {
        "demorec.core.errors": ("DemorecError", "ConfigError", "RecordingError", "ExportError", "SceneError"),
    },
}
"""Purpose -> module -> names, in the order of docs/api.md."""
_MODULES = {name: module for modules in GROUPS.values() for module, names in modules.items() for name in names}


def __getattr__(name: str) -> Any:
    """Load a name; AttributeError if it is not promised, or if its extension is missing."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        return getattr(importlib.import_module(_MODULES[name]), name)
    except ModuleNotFoundError as error:
        if not (error.name or "").startswith("demorec.extensions"):
            raise
        extension = _MODULES[name].split(".")[2]
        raise AttributeError(f"{name!r} needs the extension {extension}, which is missing") from error


def __dir__() -> list[str]:
    """Return the promised names."""
    return sorted(_MODULES)
