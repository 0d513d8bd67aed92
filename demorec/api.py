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
    from demorec.core.extension import ReaderRow as ReaderRow
    from demorec.core.geometry import Pose as Pose
    from demorec.core.replacing import ReplaceableKind as ReplaceableKind
    from demorec.datasets.episode import ExportEpisode as ExportEpisode
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
    from demorec.mcap import EpisodeWriter as EpisodeWriter
    from demorec.mcap import Recording as Recording
    from demorec.mcap import open_recording as open_recording
    from demorec.mcap.recorder import RecordedEpisode as RecordedEpisode
    from demorec.mcap.recorder import Recorder as Recorder
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
    from demorec.tasks.base import Task as Task
    from demorec.tasks.furniture import mark as mark
    from demorec.tasks.furniture import robot_at_origin as robot_at_origin
    from demorec.tasks.furniture import table_and_floor as table_and_floor
    from demorec.tasks.grasping import hand_down as hand_down
    from demorec.tasks.grasping import hand_yaw as hand_yaw
    from demorec.tasks.grasping import raised as raised
    from demorec.tasks.grasping import symmetric_yaws as symmetric_yaws
    from demorec.tasks.pick import PickPlace as PickPlace
    from demorec.tasks.placing import PlacingTask as PlacingTask
    from demorec.tasks.placing import on_table as on_table
    from demorec.tasks.placing import random_cube as random_cube
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
    from demorec.view.paths import Paths as Paths
    from demorec.view.scene import log_episode as log_episode
    from demorec.view.scene import new_recording as new_recording
    from demorec.view.sources import find_episodes as find_episodes

GROUPS: Mapping[str, Mapping[str, str]] = {
    "Record": {
        "Recorder": "demorec.mcap.recorder",
        "RecordedEpisode": "demorec.mcap.recorder",
    },
    "Read": {
        "open_recording": "demorec.mcap",
        "Recording": "demorec.mcap",
        "find_recordings": "demorec.datasets.sources",
        "Episode": "demorec.episode.protocol",
        "EpisodeInfo": "demorec.episode.info",
        "Feature": "demorec.episode.info",
        "Camera": "demorec.episode.info",
        "Table": "demorec.episode.episode",
        "Event": "demorec.episode.episode",
        "Outcome": "demorec.episode.episode",
        "SceneMotion": "demorec.episode.protocol",
        "state_names": "demorec.episode.features",
        "ENVIRONMENT_STATE": "demorec.episode.features",
        "Pose": "demorec.core.geometry",
    },
    "View": {
        "find_episodes": "demorec.view.sources",
        "log_episode": "demorec.view.scene",
        "new_recording": "demorec.view.scene",
        "Paths": "demorec.view.paths",
    },
    "Write a task": {
        "Task": "demorec.tasks.base",
        "PlacingTask": "demorec.tasks.placing",
        "PickPlace": "demorec.tasks.pick",
        "Scene": "demorec.episode.scene",
        "Body": "demorec.episode.scene",
        "Shape": "demorec.episode.scene",
        "Goal": "demorec.episode.scene",
        "Sampler": "demorec.tasks.sampling",
        "Region": "demorec.tasks.sampling",
        "wording": "demorec.tasks.sampling",
        "mark": "demorec.tasks.furniture",
        "robot_at_origin": "demorec.tasks.furniture",
        "table_and_floor": "demorec.tasks.furniture",
        "random_cube": "demorec.tasks.placing",
        "on_table": "demorec.tasks.placing",
        "Expert": "demorec.tasks.skills",
        "Step": "demorec.tasks.script",
        "ExpertFailure": "demorec.tasks.script",
        "steady_width": "demorec.tasks.script",
        "hand_down": "demorec.tasks.grasping",
        "hand_yaw": "demorec.tasks.grasping",
        "raised": "demorec.tasks.grasping",
        "symmetric_yaws": "demorec.tasks.grasping",
        "World": "demorec.sim.world",
        "SuccessCheck": "demorec.episode.episode",
        "placement_checks": "demorec.tasks.success",
        "TaskContract": "demorec.testing",
    },
    "Describe a robot, a camera, objects": {
        "RobotSpec": "demorec.robots.robot",
        "ParallelGripper": "demorec.robots.robot",
        "JawGripper": "demorec.robots.robot",
        "Motors": "demorec.robots.motors",
        "PANDA": "demorec.robots.panda",
        "IIWA": "demorec.robots.iiwa",
        "SO101": "demorec.robots.so101",
        "SO101_FOLLOWER": "demorec.robots.so101",
        "RobotContract": "demorec.testing",
        "CameraPreset": "demorec.render.cameras",
        "Renderer": "demorec.render",
        "Shelf": "demorec.objects.shelf",
    },
    "Simulate and learn": {
        "GenerateConfig": "demorec.core.config",
        "EpisodeWriter": "demorec.mcap",
        "DemorecEnv": "demorec.extensions.policies.gym_env",
        "env_id": "demorec.extensions.policies.gym_env",
    },
    "Write an extension": {
        "Extension": "demorec.core.extension",
        "CommandRow": "demorec.core.extension",
        "ExporterRow": "demorec.core.extension",
        "ReaderRow": "demorec.core.extension",
        "Exporter": "demorec.datasets.options",
        "CommonOptions": "demorec.datasets.options",
        "ExportReport": "demorec.datasets.options",
        "ExportEpisode": "demorec.datasets.episode",
        "ProgressCallback": "demorec.datasets.options",
        "atomic_write": "demorec.core.atomic",
        "ReplaceableKind": "demorec.core.replacing",
        "check": "demorec.check.base",
        "Fault": "demorec.check.base",
        "NotMeasuredError": "demorec.check.base",
        "Evidence": "demorec.extensions.doctor.evidence",
        "EpisodeEvidence": "demorec.extensions.doctor.evidence",
        "Positional": "demorec.cli.shared.flags",
        "say": "demorec.cli.shared.output",
    },
    "Handle errors": {
        "DemorecError": "demorec.core.errors",
        "ConfigError": "demorec.core.errors",
        "RecordingError": "demorec.core.errors",
        "ExportError": "demorec.core.errors",
        "SceneError": "demorec.core.errors",
    },
}
"""Purpose -> name -> its module, in the order of docs/api.md."""
_MODULES = {name: module for names in GROUPS.values() for name, module in names.items()}


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
