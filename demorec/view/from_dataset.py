"""Episodes out of exported datasets: numbers from the data files, the scene from demorec's own tables beside them."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import RecordingError, in_words, resource_error
from demorec.core.geometry import Array, Pose
from demorec.core.plain import from_json
from demorec.datasets.lerobot.files import read_json
from demorec.datasets.lerobot.layout import AUTOMATIC_FEATURES, DatasetInfo
from demorec.datasets.lerobot.paths import SIDECAR_DIR
from demorec.datasets.lerobot.reader import episode_places, read_tasks
from demorec.datasets.lerobot.robots import DatasetRobot
from demorec.episode.episode import Outcome, SimulatedInfo, SuccessCheck
from demorec.episode.external import Camera, EpisodeInfo, Feature, Origin
from demorec.episode.features import DEPTH_SUFFIX, ENVIRONMENT_STATE, IMAGE_PREFIX, STATE_KINDS, state_names
from demorec.episode.validity import read_episode_info
from demorec.mcap.external.transforms import JointPositions
from demorec.robots.assets import asset_path
from demorec.robots.kinematics import ArmKinematics
from demorec.robots.urdf import Urdf, check_primitives
from demorec.view.dataset_episode import DatasetEpisode, dataset_rows
from demorec.view.episode import Curves, PlayedEpisode, PlayedExternal
from demorec.view.held_objects import held_object_poses


def dataset_episodes(root: Path) -> list[int]:
    """Numbers of the episodes in a dataset.

    Raises:
        RecordingError: It is damaged.
    """
    return [place.episode_index for place in episode_places(root, DatasetInfo.load(root))]


@contextmanager
def open_dataset_episode(root: Path, episode_index: int) -> Iterator[PlayedEpisode | PlayedExternal]:
    """One episode of a dataset.

    Raises:
        RecordingError: It cannot be read.
    """
    try:
        episode = _read_episode(root, episode_index)
    except (OSError, ValueError, TypeError, KeyError, IndexError) as error:  # nulls and odd values in its tables
        unreadable = RecordingError(f"The dataset cannot be read ({in_words(error)}): {root}")
        raise resource_error(error) or unreadable from error
    yield episode


def _read_episode(root: Path, episode_index: int) -> PlayedEpisode | PlayedExternal:
    found = DatasetEpisode(root, episode_index)
    if found.row.get("episode_info") is None:
        return _external(found)
    row, described = found.row, found.described
    export = dict(read_json(root / SIDECAR_DIR / "export.json"))
    info = read_episode_info(row["episode_info"])
    missing = {"observation.state", "action"} - described.features.keys()
    if missing:
        raise RecordingError(f"The dataset has no {' and no '.join(sorted(missing))}, so it cannot be shown: {root}")
    data = found.data
    num_frames = len(data["action"])
    num_arm = len(info.robot.arm_joints)
    widths = {len(state_names(info.robot, kind)) for kind in STATE_KINDS}
    if not num_frames or data["observation.state"].shape[1] not in widths:
        raise RecordingError(f"The dataset has no rows of episode {episode_index}, or of another robot: {root}")
    state = data["observation.state"]
    if found.robot is not None:
        check_primitives(found.robot.urdf)
    base_from_tcp = (
        data["observation.ee_pose"] if "observation.ee_pose" in data else _tcp_poses(info, state, found.robot)
    )
    fingers = info.robot.gripper.joint_position(state[:, num_arm])
    ends = {item["name"]: _pose_row(item["world_from_object_end"]) for item in row["objects"]}
    return PlayedEpisode(
        name=f"episode_{episode_index:06d}",
        group=root.resolve().name,
        identity=f"dataset-{root.resolve().name}-{episode_index}",
        source=str(row["source"]),
        info=info,
        outcome=_outcome(row, num_frames),
        robot_description=None if found.robot is None else found.robot.urdf,
        time_ns=found.time_ns,
        joint_position=np.concatenate([state[:, :num_arm], fingers], axis=1),
        base_from_tcp=base_from_tcp,
        object_poses=_object_poses(info, ends, data, described, base_from_tcp),
        end_poses=ends,
        world_from_camera=_camera_poses(root, episode_index),
        phase=_phases(row, num_frames),
        curves=_curves(info, data, base_from_tcp, found.time_ns, with_targets=export.get("action") == "joint"),
        videos=found.videos(),
        depth={name.removesuffix(DEPTH_SUFFIX): read for name, read in found.depth().items()},
        statements=found.statements(),
        boxes=found.boxes(),
    )


def _external(found: DatasetEpisode) -> PlayedExternal:
    """An episode as its dataset knows it, at the dataset's rate."""
    root, row, described, robot = found.root, found.row, found.described, found.robot
    data, time_ns, videos, depth = found.data, found.time_ns, found.videos(), found.depth()
    names = {
        name: described.features[name].names or tuple(str(index) for index in range(values.shape[1]))
        for name, values in data.items()
        if name not in AUTOMATIC_FEATURES and not name.startswith("next.")
    }
    tasks = read_tasks(root)
    joints, units = ({}, {}) if robot is None else (robot.record.joints, robot.record.units)
    features = tuple(
        Feature(name=name, dtype="float32", names=parts, joints=joints.get(name, ()), units=units.get(name, ()))
        for name, parts in names.items()
    )
    positions = JointPositions(features)
    values = positions.of(data).T if positions.joints else ()
    return PlayedExternal(
        name=f"episode_{found.number:06d}",
        group=root.resolve().name,
        identity=hashlib.sha256(f"{root.resolve()} {found.number}".encode()).hexdigest()[:16],
        source=str(row.get("source", root.resolve().name)),
        info=EpisodeInfo(
            episode_index=found.number,
            instruction=tasks[int(data["task_index"][0, 0])] if len(time_ns) else "",
            robot=described.robot_type or "",
            fps=int(described.fps),
            urdf="" if robot is None else robot.urdf,
            features=features,
            cameras=tuple(_camera(described, name) for name in [*videos, *depth]),
            origin=from_json(row["origin"], Origin) if row else Origin(kind="dataset"),
        ),
        outcome=_external_outcome(row, data, len(time_ns)),
        time_ns=time_ns,
        joint_position=dict(zip(positions.joints, values, strict=True)),
        curves={name: Curves(time_ns=time_ns, values=data[name], names=parts) for name, parts in names.items()},
        videos=videos,
        depth=depth,
        statements=found.statements(),
    )


def _camera(described: DatasetInfo, name: str) -> Camera:
    height, width = described.features[IMAGE_PREFIX + name].shape[:2]
    return Camera(name=name, width=width, height=height)


def _external_outcome(row: Mapping[str, Any], data: Mapping[str, Array], num_frames: int) -> Outcome:
    """As the sidecar has it, or else as the last row says."""
    if row:
        return Outcome(success=row["success"], num_frames=num_frames, failure_reason=row["failure_reason"])
    ends = data.get("next.success")
    success = None if ends is None or not num_frames else bool(ends[-1, 0])
    return Outcome(success=success, num_frames=num_frames)


def _tcp_poses(info: SimulatedInfo, state: Array, robot: DatasetRobot | None) -> Array:
    """(T, 7) from the joints, of a dataset that leaves observation.ee_pose out."""
    spec = info.robot
    urdf = Urdf.load(asset_path(spec.urdf), scale=info.scene.robot.scale) if robot is None else robot.model
    arm = ArmKinematics.from_urdf(
        urdf,
        arm_joints=spec.arm_joints,
        tcp_link=spec.tcp_link,
        lower=spec.position_lower,
        upper=spec.position_upper,
    )
    return np.array([arm.forward(row).vector() for row in state[:, : arm.num_joints]])


def _object_poses(
    info: SimulatedInfo, ends: dict[str, Array], data: dict[str, Array], described: DatasetInfo, base_from_tcp: Array
) -> dict[str, Array]:
    """Name -> (T, 7): recorded where the dataset has `observation.environment_state`, else as the hand carries them."""
    if ENVIRONMENT_STATE not in data:
        opening, target = data["observation.state"][:, len(info.robot.arm_joints)], data["action"][:, -1]
        return held_object_poses(info.scene, ends, base_from_tcp, opening, target, int(described.fps))
    first = {name: column for column, name in enumerate(described.features[ENVIRONMENT_STATE].names or ())}
    base, values = info.scene.robot.world_from_base, data[ENVIRONMENT_STATE]
    result = {}
    for body in info.scene.movable:
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


def _camera_poses(root: Path, episode_index: int) -> dict[str, Array]:
    """Camera -> (T, 7) of the cameras that move."""
    if not (root / SIDECAR_DIR / "camera_poses").is_dir():
        return {}
    rows = dataset_rows(root, f"{SIDECAR_DIR}/camera_poses", None, episode_index)
    names = [name for name in (rows[0] if rows else {}) if name not in ("episode_index", "frame_index")]
    return {name: np.array([row[name] for row in rows]) for name in names}


def _curves(
    info: SimulatedInfo,
    data: dict[str, Array],
    base_from_tcp: Array,
    time_ns: NDArray[np.int64],
    *,
    with_targets: bool,
) -> dict[str, Curves]:
    joints = info.robot.arm_joints
    state, velocity, action = data["observation.state"], data.get("observation.velocity"), data["action"]
    number = len(joints)

    def curves(values: Array, names: tuple[str, ...]) -> Curves:
        return Curves(time_ns=time_ns, values=values, names=names)

    result = {
        "position": curves(state[:, :number], joints),
        "gripper": curves(state[:, number : number + 1], ("opening",)),
        "gripper target": curves(action[:, -1:], ("target",)),
        "ee": curves(base_from_tcp[:, :3], ("x", "y", "z")),
    }
    if velocity is not None:
        result["velocity"] = curves(velocity[:, :number], joints)
    if with_targets:
        result["target"] = curves(action[:, :number], joints)
    return result
