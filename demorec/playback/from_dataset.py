"""Episodes out of exported datasets: numbers from the data files, the scene from demorec's own tables beside them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.errors import RecordingError, in_words, resource_error
from demorec.geometry import Array, Pose
from demorec.lerobot.boxes import BOXES_DIR, read_boxes
from demorec.lerobot.files import read_json, read_table
from demorec.lerobot.language import COLUMNS, spoken_episodes
from demorec.lerobot.layout import DatasetInfo
from demorec.lerobot.packets import PACKET_CODECS, episode_distances, episode_packets
from demorec.lerobot.paths import SIDECAR_DIR
from demorec.lerobot.reader import EpisodePlace, episode_places
from demorec.lerobot.robots import DatasetRobot, read_robot
from demorec.playback.collected_dataset import collected_of_dataset
from demorec.playback.episode import Box, Curves, Depth, PlayedCollected, PlayedEpisode, Video, timed
from demorec.playback.held_objects import held_object_poses
from demorec.scene.assets import asset_path
from demorec.scene.episode import EpisodeInfo, Outcome, SuccessCheck, frame_time_ns
from demorec.scene.features import DEPTH_SUFFIX, ENVIRONMENT_STATE, IMAGE_PREFIX, STATE_KINDS, state_names
from demorec.scene.kinematics import ArmKinematics
from demorec.scene.urdf import Urdf, check_primitives
from demorec.scene.validity import read_episode_info


def dataset_episodes(root: Path) -> list[int]:
    """Numbers of the episodes in a dataset.

    Raises:
        RecordingError: It was not exported by demorec, or is damaged.
    """
    return [int(row["episode_index"]) for row in _rows(root, f"{SIDECAR_DIR}/episodes", ["episode_index"])]


@contextmanager
def open_dataset_episode(root: Path, episode_index: int) -> Iterator[PlayedEpisode | PlayedCollected]:
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


def _read_episode(root: Path, episode_index: int) -> PlayedEpisode | PlayedCollected:
    row = _episode_row(root, episode_index)
    described = DatasetInfo.load(root)
    place = _place(root, described, episode_index)
    columns = [name for name, feature in described.features.items() if feature.is_numeric]
    if row["episode_info"] is None:
        data = _data(root, place, columns)
        time_ns = _times(len(data["index"]), described)
        videos, depth = _videos(root, described, place, time_ns), _depth(root, described, place, time_ns)
        robot, statements = _robot(root, row), _statements(root, episode_index, described, time_ns)
        return collected_of_dataset(root, row, described, data, time_ns, videos, depth, robot, statements)
    export = dict(read_json(root / SIDECAR_DIR / "export.json"))
    info = read_episode_info(row["episode_info"])
    missing = {"observation.state", "action"} - described.features.keys()
    if missing:
        raise RecordingError(f"The dataset has no {' and no '.join(sorted(missing))}, so it cannot be shown: {root}")
    data = _data(root, place, columns)
    num_frames = len(data["action"])
    num_arm = len(info.robot.arm_joints)
    widths = {len(state_names(info.robot, kind)) for kind in STATE_KINDS}
    if not num_frames or data["observation.state"].shape[1] not in widths:
        raise RecordingError(f"The dataset has no rows of episode {episode_index}, or of another robot: {root}")
    time_ns = _times(num_frames, described)
    state = data["observation.state"]
    if (robot := _robot(root, row)) is not None:
        check_primitives(robot.urdf)
    base_from_tcp = data["observation.ee_pose"] if "observation.ee_pose" in data else _tcp_poses(info, state, robot)
    fingers = info.robot.gripper.joint_position(state[:, num_arm])
    ends = {item["name"]: _pose_row(item["world_from_object_end"]) for item in row["objects"]}
    return PlayedEpisode(
        name=f"episode_{episode_index:06d}",
        group=root.resolve().name,
        identity=f"dataset-{root.resolve().name}-{episode_index}",
        source=str(row["source"]),
        info=info,
        outcome=_outcome(row, num_frames),
        robot_description=None if robot is None else robot.urdf,
        time_ns=time_ns,
        joint_position=np.concatenate([state[:, :num_arm], fingers], axis=1),
        base_from_tcp=base_from_tcp,
        object_poses=_object_poses(info, ends, data, described, base_from_tcp),
        end_poses=ends,
        world_from_camera=_camera_poses(root, episode_index),
        phase=_phases(row, num_frames),
        curves=_curves(info, data, base_from_tcp, time_ns, with_targets=export.get("action") == "joint"),
        videos=_videos(root, described, place, time_ns),
        depth={name.removesuffix(DEPTH_SUFFIX): read for name, read in _depth(root, described, place, time_ns).items()},
        statements=_statements(root, episode_index, described, time_ns),
        boxes=_boxes(root, described, data["index"][:, 0]),
    )


def _times(num_frames: int, described: DatasetInfo) -> NDArray[np.int64]:
    """(T,) of the frames, since the first one."""
    return np.array([frame_time_ns(index, int(described.fps)) for index in range(num_frames)], dtype=np.int64)


def _rows(root: Path, table: str, columns: list[str] | None, episode_index: int | None = None) -> list[dict[str, Any]]:
    files = sorted((root / table).glob("*/*.parquet"))
    if not files:
        raise RecordingError(
            f"The dataset has no {table}: only datasets of demorec can be shown; rerun shows others: {root}"
        )
    rows = [row for file in files for row in read_table(file, columns).to_pylist()]
    return [row for row in rows if episode_index is None or row.get("episode_index") == episode_index]


def _episode_row(root: Path, episode_index: int) -> dict[str, Any]:
    for row in _rows(root, f"{SIDECAR_DIR}/episodes", None, episode_index):
        return row
    raise RecordingError(f"The dataset has no episode {episode_index}: {root}")


def _place(root: Path, described: DatasetInfo, episode_index: int) -> EpisodePlace:
    for place in episode_places(root, described):
        if place.episode_index == episode_index:
            return place
    raise RecordingError(f"The dataset has no episode {episode_index} in its own tables: {root}")


def _robot(root: Path, row: dict[str, Any]) -> DatasetRobot | None:
    """The arm of an episode; None in a dataset that does not keep it."""
    name = row.get("robot_digest")
    return None if name is None else read_robot(root, str(name))


def _data(root: Path, place: EpisodePlace, columns: list[str]) -> dict[str, Array]:
    rows = _rows(root, "data", columns, place.episode_index)
    if len(rows) != place.length:
        raise RecordingError(
            f"Episode {place.episode_index} of the dataset has {len(rows)} rows, its table of episodes says "
            f"{place.length}: {root}"
        )
    result = {}
    for name in columns:
        try:
            values = np.array([row[name] for row in rows], dtype=np.float64)
        except (ValueError, TypeError, OverflowError) as error:
            raise RecordingError(f"The column {name} holds something else than numbers: {root}") from error
        result[name] = values if values.ndim == 2 else values[:, None]
    return result


def _tcp_poses(info: EpisodeInfo, state: Array, robot: DatasetRobot | None) -> Array:
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
    info: EpisodeInfo, ends: dict[str, Array], data: dict[str, Array], described: DatasetInfo, base_from_tcp: Array
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
    return Outcome(
        success=row["success"],
        checks=tuple(SuccessCheck(**check) for check in row["checks"]),
        failure_phase=row["failure_phase"],
        failure_reason=row["failure_reason"],
        num_frames=num_frames,
        num_retries=row["num_retries"],
        final_state_digest=row["final_state_digest"],
    )


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
    rows = _rows(root, f"{SIDECAR_DIR}/camera_poses", None, episode_index)
    names = [name for name in (rows[0] if rows else {}) if name not in ("episode_index", "frame_index")]
    return {name: np.array([row[name] for row in rows]) for name in names}


def _curves(
    info: EpisodeInfo,
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


def _videos(root: Path, described: DatasetInfo, place: EpisodePlace, time_ns: NDArray[np.int64]) -> dict[str, Video]:
    """Camera -> its coded pictures."""
    result = {}
    for key, feature in described.features.items():
        codec = PACKET_CODECS.get(str((feature.info or {}).get("video.codec")))
        if feature.is_video and codec is not None and not feature.is_depth:
            packets = partial(_packets, root, described, key, place, time_ns)
            result[key.removeprefix(IMAGE_PREFIX)] = Video(codec=codec, packets=packets)
    return result


def _packets(
    root: Path, described: DatasetInfo, key: str, place: EpisodePlace, time_ns: NDArray[np.int64]
) -> Iterator[tuple[int, bytes, bool]]:
    for packet in episode_packets(root, described, key, place):
        # Those before the episode are decoded with its first frame.
        yield int(time_ns[max(packet.frame, 0)]), packet.data, packet.is_keyframe


def _depth(root: Path, described: DatasetInfo, place: EpisodePlace, time_ns: NDArray[np.int64]) -> dict[str, Depth]:
    """Depth feature, without its prefix -> reads (time_ns, (H, W) metres) of every frame."""
    return {
        key.removeprefix(IMAGE_PREFIX): partial(timed, time_ns, partial(episode_distances, root, described, key, place))
        for key, feature in described.features.items()
        if feature.is_video and feature.is_depth
    }


def _statements(
    root: Path, episode_index: int, described: DatasetInfo, time_ns: NDArray[np.int64]
) -> tuple[tuple[int, str, str], ...]:
    """(time_ns, style, sentence) of what the language columns say of an episode."""
    if not set(COLUMNS) <= described.features.keys():
        return ()
    (episode,) = islice(spoken_episodes(root), episode_index, episode_index + 1)
    frames = [min(round(row["timestamp"] * described.fps), len(time_ns) - 1) for row in episode.persistent]
    return tuple(
        (int(time_ns[frame]), str(row["style"]), str(row["content"]))
        for frame, row in zip(frames, episode.persistent, strict=True)
    )


def _boxes(root: Path, described: DatasetInfo, index: Array) -> dict[str, dict[int, list[tuple[str, Box]]]]:
    """Camera -> frame -> what it sees, of a dataset with boxes beside it; `index` (T,) is that of the rows."""
    frame_of = {int(value): frame for frame, value in enumerate(index.tolist())}
    found: dict[str, dict[int, list[tuple[str, Box]]]] = {}
    for key in described.video_keys:
        path = root / BOXES_DIR / f"{key}.json"
        if not path.exists():
            continue
        seen = found.setdefault(key.removeprefix(IMAGE_PREFIX), {})
        for item in read_boxes(path):
            if item.index in frame_of:
                seen.setdefault(frame_of[item.index], []).append((item.object, item.box))
    return found
