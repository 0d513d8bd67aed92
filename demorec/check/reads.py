"""Which check reads what: every topic, metadata field and dataset column, with the checks that look at it.

What there is follows from the tables and dataclasses that the data are made with, so that a new stream or field shows
up here by itself; what is read is declared on each check's row. The rest must be in `UNCHECKED`, with a reason.
"""

from __future__ import annotations

import dataclasses
import types
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal, get_args, get_origin, get_type_hints

from demorec.core.geometry import Pose
from demorec.core.tables import CHECKS, load_robot
from demorec.datasets.lerobot.facts import PROGRESS_PATH
from demorec.datasets.lerobot.language import COLUMNS
from demorec.datasets.lerobot.layout import AUTOMATIC_FEATURES
from demorec.episode import features
from demorec.episode.episode import Outcome, SimulatedInfo
from demorec.episode.scene import Body, RobotPlacement, Scene, SceneCamera, Shape
from demorec.mcap import channels
from demorec.mcap.metadata import EPISODE, EXTERNAL, OUTCOME, RECOVERED, CameraStreams
from demorec.mcap.streams import SUBTASK, frame_streams
from demorec.mcap.transforms import FrameTree
from demorec.runs.run_file import IMPORT_NAME, RunFile

SourceKind = Literal["topic", "field", "column"]

UNCHECKED: Mapping[str, str] = {
    "info.origin": "a text for people: of which recording a replay or a picture was made",
    "info.scene.hold": "how things are held shows only in a replay (--replay, --deep)",
    "info.scene.bodies.lateral_friction": "shows only in a replay (--replay, --deep)",
    "info.scene.bodies.spinning_friction": "shows only in a replay (--replay, --deep)",
    "info.scene.bodies.rolling_friction": "shows only in a replay (--replay, --deep)",
    "info.scene.bodies.restitution": "shows only in a replay (--replay, --deep)",
    "info.scene.bodies.linear_damping": "shows only in a replay (--replay, --deep)",
    "info.scene.bodies.angular_damping": "shows only in a replay (--replay, --deep)",
    "info.scene.bodies.role": "of the task's code; a new run of the script shows it (--deep)",
    "info.scene.bodies.yaw_symmetry": "of the task's code; a new run of the script shows it (--deep)",
    "info.scene.physics.solver_iterations": "shows only in a replay (--replay, --deep)",
    "info.scene.physics.contact_breaking_threshold": "shows only in a replay (--replay, --deep)",
    "info.scene.physics.finger_stiffness": "shows only in a replay (--replay, --deep)",
    "info.scene.goals.yaw_symmetry": "of the task's code; a new run of the script shows it (--deep)",
    "outcome.final_state_digest": "velocities of the last moment are in no recording; a replay compares it",
    "outcome.checks.unit": "a word for people",
    "run.beyond": "episodes of an earlier, larger request: no part of the run",
    "run.sessions": "clock, machine and worker of each start: nothing to compare them with",
    "run.export": "what was exported when; the dataset is judged by itself",
    "run.attempts.seconds": "CPU times: nothing to compare them with",
}
"""What no check reads, and why."""


@dataclass(frozen=True, kw_only=True)
class Coverage:
    """One thing that is recorded or exported.

    Attributes:
        name: "/tf", "info.scene.bodies.mass", "observation.state"; of a body or camera in braces.
        kind: What it is.
        checks: Names of the checks that read it, or something that it is part of.
        why_not: Where there is none: the reason.
    """

    name: str
    kind: SourceKind
    checks: tuple[str, ...]
    why_not: str = ""


def coverage() -> list[Coverage]:
    """Everything there is, in order, with its checks."""
    declared = {name: CHECKS.load(name).reads for name in CHECKS.names()}
    found = []
    for kind, name in everything():
        checks = tuple(check for check, reads in declared.items() if any(_covers(read, name) for read in reads))
        why_not = "" if checks else next((why for part, why in UNCHECKED.items() if _covers(part, name)), "")
        found.append(Coverage(name=name, kind=kind, checks=checks, why_not=why_not))
    return found


def _covers(part: str, name: str) -> bool:
    """Whether a declared name is that, or the whole that it is a part of."""
    return name == part or name.startswith(f"{part}.")


def everything() -> Iterator[tuple[SourceKind, str]]:
    """(kind, name) of all that recordings, runs and datasets hold."""
    for topic in topics():
        yield "topic", topic
    for record in (EPISODE, OUTCOME, RECOVERED):
        yield "field", f"metadata {record}"
    for name, kind in (("info", SimulatedInfo), ("cameras", CameraStreams), ("outcome", Outcome), ("run", RunFile)):
        for field in _leaves(kind, name):
            yield "field", field
    yield "field", f"metadata {EXTERNAL}"
    yield "field", IMPORT_NAME
    for topic in ("/frames", "/{feature}", SUBTASK):
        yield "topic", topic
    for column in columns():
        yield "column", column


def topics() -> list[str]:
    """Every topic that a recording may have."""
    camera = SceneCamera(name="{camera}", width=16, height=16, fov_y=1.0, mount="world", mount_from_camera=Pose())
    shape = Shape(kind="box", size=(0.1, 0.1, 0.1))
    body = Body(name="{body}", role="object", shape=shape, world_from_body=Pose(), mass=1.0)
    robot = load_robot("panda")
    placement = RobotPlacement(
        name=robot.name, world_from_base=Pose(), joint_position=robot.home_q, gripper_width=robot.gripper.max_width
    )
    info = SimulatedInfo(
        episode_index=0,
        attempt=0,
        root_seed=0,
        task="",
        instruction="",
        robot=robot,
        scene=Scene(robot=placement, bodies=(body,), cameras=(camera,)),
        fps=30,
        physics_hz=240,
    )
    found = [stream.topic for stream in frame_streams(info)]
    found += [topic for topic, _, _ in channels.latched_messages(info, FrameTree(info), has_labels=True)]
    found += [channels.TF, channels.PHASE, channels.EVENTS, channels.DELIBERATE_MISS]
    found += [channels.camera_topic("{camera}", stream) for stream in channels.PICTURE_STREAMS]
    return sorted(set(found))


def _leaves(kind: Any, name: str) -> Iterator[str]:
    """Dotted names of all fields of a dataclass, those of dataclasses within it (also in tuples and mappings) too."""
    hints = get_type_hints(kind)
    for field in dataclasses.fields(kind):
        inner = next(_dataclasses_of(hints[field.name]), None)
        path = f"{name}.{field.name}"
        if inner is None:
            yield path
        else:
            yield from _leaves(inner, path)


def _dataclasses_of(hint: Any) -> Iterator[Any]:
    if dataclasses.is_dataclass(hint):
        if hint is not Pose:
            yield hint
    elif isinstance(hint, types.UnionType) or get_origin(hint) is not None:
        for argument in get_args(hint):
            yield from _dataclasses_of(argument)


def columns() -> list[str]:
    """Every column of a LeRobot dataset and the files beside them."""
    pictures = features.IMAGE_PREFIX + "{camera}"
    numbers = (features.STATE, features.VELOCITY, features.EE_POSE, features.ENVIRONMENT_STATE, features.ACTION)
    files = ("meta/info.json", "meta/stats.json", "meta/episodes", "demorec/", PROGRESS_PATH)
    return [*numbers, pictures, pictures + features.DEPTH_SUFFIX, *AUTOMATIC_FEATURES, *COLUMNS, *files]
