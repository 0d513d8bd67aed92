"""Descriptions of the arms of a dataset's episodes, in the folder `demorec/robots/` of the dataset.

Each arm has two files, named by a digest of both: `DIGEST.urdf`, and `DIGEST.json` with everything that a URDF cannot
express. Episodes refer to their arm by the digest, so one dataset can hold episodes of different arms.
"""

from __future__ import annotations

import functools
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from demorec.core.plain import digest, leave_out_default, to_json
from demorec.datasets.lerobot.files import write_text
from demorec.datasets.lerobot.paths import SIDECAR_DIR
from demorec.episode.features import ACTION, EE_POSE, STATE
from demorec.episode.info import Feature
from demorec.robots.motors import Motors
from demorec.robots.so101 import SO101_FOLLOWER
from demorec.robots.urdf import Urdf, parse_xml

if TYPE_CHECKING:
    from demorec.datasets.episode import ExportEpisode

ROBOTS_DIR = f"{SIDECAR_DIR}/robots"
IN_MOTOR_UNITS = {"so101": SO101_FOLLOWER}
"""Row of `ROBOTS` that LeRobot also drives, in other units -> LeRobot's arm."""
_KEPT = ("material", "link", "joint")
"""Parts of a URDF that place and draw links; the rest is for simulators and controllers, and contains many paths."""
_IN_PACKAGE = re.compile(r"^(?:file:/*)?/.*/share/([^/]+/.+)$")
"""An absolute path into an installed ROS package."""
_ABSOLUTE = re.compile(r"^(file:|/|~|[A-Za-z]:[\\/]|\\\\)")


@dataclass(frozen=True, kw_only=True)
class DatasetRobot:
    """An arm: its URDF, and properties that a URDF cannot express.

    Attributes:
        name: The dataset's `robot_type`.
        urdf: Links and joints; of a simulated arm, whose meshes are in its model, with boxes instead.
        joints: Feature -> for each element the URDF joint with that position, "" for other elements.
        units: Feature -> units of its elements, if known; positions are in rad and m otherwise.
        calibration: Feature -> calibration of its elements (`Feature.calibration`), for servos in other units.
    """

    name: str
    urdf: str = ""
    joints: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    units: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    calibration: Mapping[str, tuple[tuple[float, float], ...]] = field(default_factory=dict)

    @classmethod
    def of(cls, name: str, urdf: str, moving: Iterable[Feature]) -> DatasetRobot:
        """Describe an arm by the features that its joints move."""
        features = list(moving)
        return cls(
            name=name,
            urdf=urdf,
            joints={feature.name: feature.joints for feature in features},
            units={feature.name: feature.units for feature in features if feature.units},
            calibration={feature.name: feature.calibration for feature in features if feature.calibration},
        )

    @functools.cached_property
    def digest(self) -> str:
        """Digest of the whole description; the name of its files."""
        return digest(self)

    @functools.cached_property
    def model(self) -> Urdf:
        """Joint tree; lengths are those of the arm at any scale."""
        return Urdf.parse(self.urdf)


leave_out_default(DatasetRobot, "urdf")


def robot_of(episode: ExportEpisode[Any]) -> DatasetRobot | None:
    """Return the robot of an episode with the joints that the features move; None if its URDF is unknown. Raises
    RecordingError if the recording is damaged.
    """
    if not (text := episode.urdf):
        return None
    info = episode.info
    if episode.scene is None:
        moving = [feature for feature in info.features if any(feature.joints)]
        return DatasetRobot.of(info.robot_name, portable_urdf(text), moving)
    recorded = {feature.name: feature for feature in info.features}
    state, pose = recorded[STATE], recorded[EE_POSE]
    if episode.state == "joint_ee":
        no_joints = ("",) * len(pose.names)
        state = replace(state, joints=(*state.joints, *no_joints), units=(*state.units, *pose.units))
    return DatasetRobot.of(info.robot_name, text, [state])


def motor_features(motors: Motors) -> tuple[Feature, ...]:
    """Describe state and action as LeRobot records them from a real arm."""
    known: Any = {"units": motors.units, "joints": motors.joints, "calibration": motors.to_positions}
    return tuple(Feature(name=name, names=motors.names, **known) for name in (STATE, ACTION))


@functools.lru_cache(maxsize=8)  # usually the same for all recordings of a run
def portable_urdf(text: str) -> str:
    """Return the links, joints and materials of a URDF, without paths of the source machine. Files in a ROS package are
    named by package (package://NAME/...), files with other absolute paths by file name only. Comments are removed,
    because xacro writes its working folder into one.
    """
    robot = parse_xml(text)
    for part in list(robot):
        if part.tag not in _KEPT:
            robot.remove(part)
    for part in robot.iter():
        if (name := part.get("filename")) is not None:
            part.set("filename", _portable(name))
    ET.indent(robot, " ")
    return ET.tostring(robot, encoding="unicode") + "\n"


def _portable(name: str) -> str:
    if found := _IN_PACKAGE.match(name):
        return f"package://{found[1]}"
    return re.split(r"[/\\]", name)[-1] if _ABSOLUTE.match(name) else name


def write_robot(root: Path, robot: DatasetRobot) -> None:
    """Write the files of an arm unless they exist."""
    folder = root / ROBOTS_DIR
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in ((".urdf", robot.urdf), (".json", to_json(replace(robot, urdf=""), indent=2) + "\n")):
        path = folder / f"{robot.digest}{name}"
        if not path.exists():
            write_text(path, text)
