"""Episodes out of exported datasets: numbers from the data files, the scene from demorec's own tables beside them.

A dataset without environment state does not carry the way of objects: what the hand holds moves with the hand. Known
are every object's pose at the start and at the end, the gripper's pose and opening, and what was asked of it. So an
object stands at its start until fingers that are told to close stop around it, then moves with the hand, and when it is
let go for the last time it is at its end. A push, a fall or a slip between the fingers is not in the data.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import RecordingError, describe_error, resource_error
from demorec.core.geometry import Array, Pose
from demorec.datasets.lerobot.files import read_json
from demorec.datasets.lerobot.folder import LeRobotFolder
from demorec.datasets.lerobot.layout import DatasetInfo
from demorec.datasets.lerobot.paths import SIDECAR_DIR
from demorec.datasets.lerobot.recording import DatasetRecording, with_robot
from demorec.datasets.lerobot.robots import DatasetRobot
from demorec.episode.episode import Outcome, SuccessCheck
from demorec.episode.features import DEPTH_SUFFIX, ENVIRONMENT_STATE, STATE_KINDS, state_names
from demorec.episode.info import EpisodeInfo
from demorec.episode.scene import Scene
from demorec.episode.simulated import on_request
from demorec.episode.validity import read_episode_info
from demorec.robots.assets import asset_path
from demorec.robots.kinematics import ArmKinematics
from demorec.robots.urdf import Urdf, check_primitives
from demorec.view.episode import Box, PlayedEpisode, millimetres, simulated_curves, timed
from demorec.view.from_recording import played_episode


@contextmanager
def open_dataset_episode(dataset: LeRobotFolder, number: int) -> Iterator[PlayedEpisode]:
    """One episode of a dataset, by its place in it from 0.

    Raises:
        ConfigError: It lacks a feature that the user names.
        RecordingError: It cannot be read.
    """
    try:
        episode = _read_episode(dataset, number)
    except (OSError, ValueError, TypeError, KeyError, IndexError) as error:  # nulls and odd values in its tables
        unreadable = RecordingError(f"The dataset cannot be read ({describe_error(error)}): {dataset.root}")
        raise resource_error(error) or unreadable from error
    yield episode


def _read_episode(dataset: LeRobotFolder, number: int) -> PlayedEpisode:
    root, episode_index = dataset.root, dataset.places[number].episode_index
    recording = DatasetRecording(dataset, number)
    group = root.resolve().name
    last, fps, times = recording.num_frames - 1, dataset.info.fps, recording.table().time_ns
    known = {
        "name": f"episode_{episode_index:06d}",
        "group": group,
        "source": str(recording.known.get("source", group)),
        "statements": tuple(
            (int(times[min(round(row["timestamp"] * fps), last)] - times[0]), str(row["style"]), str(row["content"]))
            for row in recording.spoken.persistent
        ),
    }
    if recording.known.get("root_seed") is not None:
        (row,) = dataset.sidecar_rows("episodes", episode_index)
        return _simulated(recording, row, known | {"identity": f"dataset-{group}-{episode_index}"})
    info, robot = recording.info, recording.robot
    if not info.urdf and robot is not None:
        info = with_robot(info, robot, recording.dataset.roles)
    known["identity"] = hashlib.sha256(f"{root.resolve()} {episode_index}".encode()).hexdigest()[:16]
    return played_episode(recording, known, info, recording.dataset.roles)


def _simulated(recording: DatasetRecording, row: dict[str, Any], known: dict[str, Any]) -> PlayedEpisode:
    dataset, root = recording.dataset, recording.path
    described, columns = dataset.info, recording.table()
    export = dict(read_json(root / SIDECAR_DIR / "export.json"))
    info = read_episode_info(row["episode_info"])
    missing = {"observation.state", "action"} - described.features.keys()
    if missing:
        raise RecordingError(f"The dataset has no {' and no '.join(sorted(missing))}, so it cannot be shown: {root}")
    data = {name: values.astype(np.float64) for name, values in columns.features.items()}
    num_arm = len(info.simulated.robot.arm_joints)
    widths = {len(state_names(info.simulated.robot, kind)) for kind in STATE_KINDS}
    state = data["observation.state"]
    if not len(state) or state.shape[1] not in widths:
        raise RecordingError(
            f"The dataset has no rows of episode {recording.place.episode_index}, or of another robot: {root}"
        )
    robot = recording.robot
    if robot is not None:
        check_primitives(robot.urdf)
    base_from_tcp = data["observation.ee_pose"] if "observation.ee_pose" in data else _tcp_poses(info, state, robot)
    fingers = info.simulated.robot.gripper.joint_position(state[:, num_arm])
    ends = {item["name"]: _pose_row(item["world_from_object_end"]) for item in row["objects"]}
    joints = {"position": state}
    if "observation.velocity" in data:
        joints["velocity"] = data["observation.velocity"]
    if export.get("action") == "joint":
        joints["target"] = data["action"]
    shown = replace(info, features=recording.info.features)
    episode = played_episode(recording, known, shown, recording.dataset.roles)
    return replace(
        episode,
        outcome=_outcome(row, len(state)),
        robot_description=None if robot is None else robot.urdf,
        joint_position=dict(zip(info.simulated.robot.joint_names, [*state[:, :num_arm].T, *fingers.T], strict=True)),
        base_from_tcp=base_from_tcp,
        object_poses=_object_poses(info, ends, data, described, base_from_tcp),
        end_poses=ends,
        world_from_camera=_camera_poses(recording),
        phase=_phases(row, len(state)),
        curves=simulated_curves(
            info.simulated.robot,
            episode.time_ns,
            data,
            [feature for feature in on_request(info) if feature.name in data],
            joints=joints,
            opening=state[:, num_arm],
            target=data["action"][:, -1],
            base_from_tcp=base_from_tcp,
        ),
        depth={
            name.removesuffix(DEPTH_SUFFIX): partial(
                timed, episode.time_ns, partial(millimetres, partial(recording.distances, name))
            )
            for name in recording.depth_cameras
        },
        boxes={name: _boxes(recording, name) for name in recording.cameras},
    )


def _boxes(recording: DatasetRecording, camera: str) -> dict[int, list[tuple[str, Box]]]:
    """Frame -> what a camera sees there."""
    seen: dict[int, list[tuple[str, Box]]] = {}
    for frame, name, box in recording.boxes(camera):
        seen.setdefault(frame, []).append((name, box))
    return seen


def _tcp_poses(info: EpisodeInfo, state: Array, robot: DatasetRobot | None) -> Array:
    """(T, 7) from the joints, of a dataset that leaves observation.ee_pose out."""
    spec = info.simulated.robot
    urdf = Urdf.load(asset_path(spec.urdf), scale=info.simulated.scene.robot.scale) if robot is None else robot.model
    arm = ArmKinematics(
        urdf,
        arm_joints=spec.arm_joints,
        tcp_link=spec.tcp_link,
        lower=spec.position_lower,
        upper=spec.position_upper,
    )
    return np.array([arm.forward(row).vector() for row in state[:, : arm.num_joints]])


def _object_poses(
    info: EpisodeInfo, ends: dict[str, Array], data: dict[str, Array], described: DatasetInfo, base_from_tcp: Array
) -> dict[str, Array]:
    """Name -> (T, 7): recorded where the dataset has `observation.environment_state`, else as the hand carries them."""
    if ENVIRONMENT_STATE not in data:
        opening, target = data["observation.state"][:, len(info.simulated.robot.arm_joints)], data["action"][:, -1]
        return held_object_poses(info.simulated.scene, ends, base_from_tcp, opening, target, int(described.fps))
    first = {name: column for column, name in enumerate(described.features[ENVIRONMENT_STATE].names or ())}
    base, values = info.simulated.scene.robot.world_from_base, data[ENVIRONMENT_STATE]
    result = {}
    for body in info.simulated.scene.movable:
        column = first[f"{body.name}.pose.x"]
        rows = values[:, column : column + 7]
        result[body.name] = np.array([(base @ Pose(position=p[:3], quat_xyzw=p[3:])).vector() for p in rows])
    return result


def _pose_row(values: Any) -> Array:
    """(7,) position and quaternion of a table; ValueError for others."""
    pose = np.array(values, dtype=np.float64)
    if pose.shape != (7,) or not np.isfinite(pose).all():
        raise ValueError(f"{str(values)[:40]} is no pose")
    return pose


def _outcome(row: dict[str, Any], num_frames: int) -> Outcome:
    names = ("success", "failure_phase", "failure_reason", "num_retries", "final_state_digest")
    checks = tuple(SuccessCheck(**check) for check in row["checks"])
    return Outcome(num_frames=num_frames, checks=checks, **{name: row[name] for name in names})


def _phases(row: dict[str, Any], num_frames: int) -> tuple[str, ...]:
    names = [""] * num_frames
    for phase in row["phases"]:
        if not 0 <= phase["from"] <= phase["to"] <= num_frames:
            raise ValueError(f"a phase from frame {phase['from']} to {phase['to']} of {num_frames}")
        names[phase["from"] : phase["to"]] = [phase["name"]] * (phase["to"] - phase["from"])
    return tuple(names)


def _camera_poses(recording: DatasetRecording) -> dict[str, Array]:
    """Camera -> (T, 7) of the cameras that move."""
    rows = recording.dataset.sidecar_rows("camera_poses", recording.place.episode_index)
    names = [name for name in (rows[0] if rows else {}) if name not in ("episode_index", "frame_index")]
    return {name: np.array([row[name] for row in rows]) for name in names}


_STOPPED_BEFORE_TARGET = 1e-3
"""How much wider than asked the opening is at least when something is between the fingers, metres."""
_STANDS_STILL = 0.015
"""Speed of the opening below which closing fingers have met something, m/s."""
_SNAPS_SHUT = 0.06
"""Speed of the opening above which they have lost it, m/s; between the two it gives way."""
_WITHIN_REACH = 0.02
"""How far from the TCP the surface of what is held may be, metres."""


def held(opening: Array, target: Array, fps: int) -> NDArray[np.bool_]:
    """(T,) whether something is between the fingers.

    Args:
        opening: (T,) measured, metres.
        target: (T,) what was asked for, metres.
        fps: Frames per second.
    """
    speed = fps * np.abs(np.diff(opening, prepend=opening[:1]))
    result = np.zeros(len(opening), dtype=np.bool_)
    is_held = False
    for frame, is_stopped in enumerate(opening > target + _STOPPED_BEFORE_TARGET):
        is_held = bool(is_stopped and speed[frame] < (_SNAPS_SHUT if is_held else _STANDS_STILL))
        result[frame] = is_held
    return result


def held_object_poses(
    scene: Scene, end_poses: Mapping[str, Array], base_from_tcp: Array, opening: Array, target: Array, fps: int
) -> dict[str, Array]:
    """Name -> (T, 7) world_from_object of every object with a known end.

    Args:
        scene: At the start.
        end_poses: Name -> (7,) world_from_object at the end.
        base_from_tcp: (T, 7).
        opening: (T,) of the gripper, metres.
        target: (T,) opening that was asked for, metres.
        fps: Frames per second.
    """
    world_from_base = scene.robot.world_from_base
    world_from_tcp = [world_from_base @ Pose(position=row[:3], quat_xyzw=row[3:]) for row in base_from_tcp]
    present = {name: scene.body(name).world_from_body for name in end_poses}
    poses: dict[str, Array] = {name: np.empty((len(base_from_tcp), 7)) for name in end_poses}
    let_go: dict[str, int] = {}
    name, tcp_from_object = "", Pose()
    for frame, (is_held, tcp) in enumerate(zip(held(opening, target, fps), world_from_tcp, strict=True)):
        if is_held and not name:
            name = _within_reach(scene, present, tcp)
            if name:
                tcp_from_object = tcp.inverse() @ present[name]
        elif not is_held and name:
            let_go[name], name = frame, ""
        if name:
            present[name] = tcp @ tcp_from_object
        for other, pose in present.items():
            poses[other][frame] = pose.vector()
    for other, frame in let_go.items():
        poses[other][frame:] = end_poses[other]
    return poses


def _within_reach(scene: Scene, present: Mapping[str, Pose], world_from_tcp: Pose) -> str:
    """The object nearest to the TCP, "" when none is between the fingers."""

    def distance(name: str) -> float:
        centre = np.linalg.norm(present[name].position - world_from_tcp.position)
        return float(centre) - max(scene.body(name).shape.extents) / 2

    nearest = min(present, key=distance, default="")
    return nearest if nearest and distance(nearest) < _WITHIN_REACH else ""
