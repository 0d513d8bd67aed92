"""Is a LeRobot dataset right: counts, rows, videos, statistics, twins, physics, and what stands beside it."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
from numpy.typing import NDArray

from demorec.assets import asset_path
from demorec.check.alignment import servo_response
from demorec.check.base import Measurement, check, worst
from demorec.check.coverage import infos_by_task, largest_gap, twins
from demorec.check.rows import displacement, link_matrices, matrices
from demorec.check.run import motion_vector
from demorec.episode import EpisodeInfo
from demorec.errors import ExportError
from demorec.export.inspect import episode_digests
from demorec.export.layout import SIDECAR_DIR, DatasetInfo
from demorec.export.reader import EpisodePlace, PacketReader, RowReader, episode_places, read_tasks
from demorec.features import ACTION, EE_POSE, STATE, VELOCITY, ActionKind, action_names
from demorec.geometry import Array
from demorec.plain import from_json
from demorec.urdf import Urdf

Rows = Mapping[str, NDArray[Any]]


class Dataset:
    """A LeRobot v3.0 dataset, read without LeRobot; properties raise ExportError where the files do not give them.

    Args:
        path: Its folder.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    @cached_property
    def info(self) -> DatasetInfo:
        """meta/info.json."""
        return DatasetInfo.load(self.path)

    @cached_property
    def places(self) -> list[EpisodePlace]:
        """The episodes' table."""
        return list(episode_places(self.path, self.info))

    @cached_property
    def tasks(self) -> list[str]:
        """Instructions."""
        return read_tasks(self.path)

    @cached_property
    def rows(self) -> list[Rows]:
        """Feature -> (T, D) of every episode."""
        reader = RowReader(self.path, self.info)
        return [reader.read(place) for place in self.places]

    @cached_property
    def sidecar(self) -> list[dict[str, Any]]:
        """The rows that demorec keeps beside each episode; empty for a dataset of somebody else's."""
        names = ["episode_index", "success", "content_digest", "frame_stride", "episode_info"]
        rows: list[dict[str, Any]] = []
        for path in sorted((self.path / SIDECAR_DIR / "episodes").glob("*/*.parquet")):
            try:
                rows += pq.read_table(path, columns=names).to_pylist()
            except (OSError, ValueError) as error:
                raise ExportError(f"The sidecar's table cannot be read ({error}): {path}") from error
        return rows

    @cached_property
    def infos(self) -> list[EpisodeInfo]:
        """What was known of each episode before its first frame; empty for a dataset of somebody else's."""
        try:
            return [from_json(row["episode_info"], EpisodeInfo) for row in self.sidecar]
        except (ValueError, KeyError, TypeError) as error:
            raise ExportError(f"The sidecar's episode_info cannot be used ({error}): {self.path}") from error

    def described(self) -> list[tuple[Rows, EpisodeInfo]]:
        """(rows, info) of each episode that the sidecar describes."""
        return list(zip(self.rows, self.infos, strict=False))

    def action_kind(self, info: EpisodeInfo) -> ActionKind | None:
        """What the action column holds, by the names of its components; None when it is none of ours."""
        names = self.info.features[ACTION].names if ACTION in self.info.features else None
        kinds: tuple[ActionKind, ...] = ("joint", "joint_increment", "ee", "ee_delta")
        return next((kind for kind in kinds if action_names(info.robot, kind) == names), None)


@check(group="dataset", scope="dataset", measures="tables that cannot be read", warn=0)
def dataset_readable(dataset: Dataset) -> Measurement:
    """info.json, the tables and every row can be read."""
    frames = sum(len(rows["index"]) for rows in dataset.rows)
    return Measurement(value=0, detail=f"{len(dataset.rows)} episodes, {frames} frames, {len(dataset.tasks)} tasks")


@check(
    group="dataset", scope="dataset", measures="counters, indices and timestamps that are not as they must be", warn=0
)
def dataset_counts(dataset: Dataset) -> Measurement:
    """Totals agree with the tables; indices count up without a gap; timestamps are frame_index / fps."""
    info, wrong = dataset.info, []
    totals = {
        "total_episodes": (info.total_episodes, len(dataset.places)),
        "total_frames": (info.total_frames, sum(place.length for place in dataset.places)),
        "total_tasks": (info.total_tasks, len(dataset.tasks)),
    }
    wrong += [f"{name} is {said}, found {found}" for name, (said, found) in totals.items() if said != found]
    start = 0
    for number, (place, rows) in enumerate(zip(dataset.places, dataset.rows, strict=True)):
        count = np.arange(place.length)
        expected = {
            "index": start + count,
            "episode_index": np.full(place.length, number),
            "frame_index": count,
            "timestamp": (count / info.fps).astype(np.float32),
        }
        for name, values in expected.items():
            if not np.array_equal(rows[name].reshape(-1), values):
                wrong.append(f"{name} of episode {number}")
        if place.episode_index != number or place.from_index != start:
            wrong.append(f"the place of episode {number}")
        used = {int(index) for index in rows["task_index"].reshape(-1)}
        names = {dataset.tasks[index] if index < len(dataset.tasks) else "" for index in used}
        if names != set(place.tasks):
            wrong.append(f"the task of episode {number}")
        start += place.length
    return Measurement(value=len(wrong), detail="; ".join(wrong[:3]) or f"{start} frames at {info.fps} fps")


@check(group="dataset", scope="dataset", measures="episodes without a coded picture for every frame", warn=0)
def dataset_videos(dataset: Dataset) -> Measurement | None:
    """Every episode has its pictures in every camera's file, one after the other."""
    if not dataset.info.video_keys:
        return None
    wrong = []
    for key in dataset.info.video_keys:
        reader = PacketReader(dataset.path, dataset.info, key)
        ends: dict[object, int] = {}
        try:
            for place in dataset.places:
                position, first = place.videos[key]
                if first != ends.get(position, 0):
                    wrong.append(f"{key}, episode {place.episode_index}: starts at picture {first}")
                ends[position] = first + place.length
                for _ in reader.read(place):
                    pass
        except ExportError as error:
            wrong.append(f"{key}: {error}")
        finally:
            reader.close()
    return Measurement(value=len(wrong), detail="; ".join(wrong[:2]) or f"{len(dataset.info.video_keys)} cameras")


@check(
    group="dataset",
    scope="dataset",
    measures="statistics against those recomputed from all rows, in standard deviations",
    warn=0.01,
    fail=0.05,
)
def dataset_statistics(dataset: Dataset) -> Measurement | None:
    """meta/stats.json, by which training normalises, is that of the data."""
    stats, found = _stats(dataset), []
    for name, feature in dataset.info.features.items():
        if feature.is_video or feature.dtype == "string":
            continue
        values = np.concatenate([rows[name].reshape(len(rows[name]), -1) for rows in dataset.rows]).astype(np.float64)
        said = stats.get(name)
        if said is None:
            found.append(Measurement(value=math.inf, detail=f"{name} has no statistics"))
            continue
        deviation = values.std(axis=0)
        scale = np.maximum(deviation, 1e-4)
        true = {"min": values.min(axis=0), "max": values.max(axis=0), "mean": values.mean(axis=0), "std": deviation}
        for quantity, value in true.items():
            told = np.asarray(said.get(quantity, np.inf), dtype=np.float64).reshape(-1)
            off = np.abs(told - value) / scale if told.shape == value.shape else np.array([np.inf])
            found.append(Measurement(value=float(off.max()), detail=f"{quantity} of {name}"))
    return worst(*found)


def _stats(dataset: Dataset) -> dict[str, Any]:
    path = dataset.path / "meta" / "stats.json"
    try:
        return dict(json.loads(path.read_text()))
    except (OSError, ValueError, TypeError) as error:
        raise ExportError(f"The statistics cannot be read ({error}): {path}") from error


@check(
    group="dataset",
    scope="dataset",
    measures="mean colour in the statistics against decoded pictures, of 1",
    warn=0.06,
    fail=0.12,
    needs_pictures=True,
)
def dataset_picture_statistics(dataset: Dataset) -> Measurement | None:
    """The statistics of each camera are those of its pictures, by a sample of each file."""
    import av

    stats, found = _stats(dataset), []
    for key in dataset.info.video_keys:
        if dataset.info.features[key].is_depth:
            continue
        means = []
        for path in sorted((dataset.path / "videos" / key).glob("*/*.mp4")):
            try:
                with av.open(str(path)) as container:
                    for number, frame in enumerate(container.decode(video=0)):
                        if number % 10 == 0:
                            means.append(frame.to_ndarray(format="rgb24").mean(axis=(0, 1)) / 255)
            except (OSError, av.FFmpegError) as error:
                raise ExportError(f"The video cannot be decoded ({error}): {path}") from error
        said = np.asarray(stats.get(key, {}).get("mean", np.full(3, np.inf)), dtype=np.float64).reshape(-1)
        if means:
            value = float(np.abs(np.mean(means, axis=0) - said).max()) if said.shape == (3,) else math.inf
            found.append(Measurement(value=value, detail=f"{key}, {len(means)} pictures"))
    return worst(*found)


@check(group="dataset", scope="dataset", measures="episodes that move like another", warn=0)
def dataset_duplicates(dataset: Dataset) -> Measurement | None:
    """Every episode is there once: no two have the same motion (within 0.0001 rad)."""
    if len(dataset.rows) < 2 or STATE not in dataset.info.features:
        return None
    motions = [motion_vector(rows[STATE]) for rows in dataset.rows]
    count, pair = twins(motions, [f"episode {n}" for n in range(len(motions))], tolerance=1e-4)
    return Measurement(value=count, detail=pair or f"{len(motions)} different motions")


@check(
    group="dataset",
    scope="dataset",
    measures="largest gap in the range of a randomised quantity, share",
    warn=0.35,
    fail=0.6,
)
def dataset_coverage(dataset: Dataset) -> Measurement | None:
    """Start places, yaws, sizes and goals are spread over their ranges (judged from 30 episodes on)."""
    return worst(*(largest_gap(group) for group in infos_by_task(dataset.infos).values()))


# ------------------------------------------------------------------------------------------------- physics


@check(
    group="dataset",
    scope="dataset",
    measures="state against joint limits and the gripper's range",
    unit="rad, m",
    warn=0.005,
    fail=0.05,
)
def dataset_joint_limits(dataset: Dataset) -> Measurement | None:
    """States are rad and metres within the robot's limits."""
    found = []
    for number, (rows, info) in enumerate(dataset.described()):
        robot, state = info.robot, rows[STATE].astype(np.float64)
        low = np.array([*robot.position_lower, 0.0])
        high = np.array([*robot.position_upper, robot.gripper_max_width * info.scene.robot.scale])
        beyond = np.maximum(np.maximum(low - state, state - high), 0.0)
        frame = int(np.argmax(beyond.max(axis=1)))
        found.append(Measurement(value=float(beyond.max()), frame=frame, detail=f"episode {number}"))
    return worst(*found)


@check(
    group="dataset", scope="dataset", measures="ratio of state differences to velocities, off 1", warn=0.1, fail=0.16
)
def dataset_velocity(dataset: Dataset) -> Measurement | None:
    """States change by velocity over time: catches a wrong fps and other joints' velocities. All episodes together."""
    if VELOCITY not in dataset.info.features:
        return None
    product = square = 0.0
    for rows in dataset.rows:
        state, velocity = rows[STATE].astype(np.float64)[:, :-1], rows[VELOCITY].astype(np.float64)[:, :-1]
        mean = (velocity[1:] + velocity[:-1]) / 2
        product += float((np.diff(state, axis=0) * dataset.info.fps * mean).sum())
        square += float((mean * mean).sum())
    if square == 0.0:
        return None
    # At few frames a second the mean of two velocities says less about the way between them.
    value = abs(product / square - 1.0) * min(1.0, dataset.info.fps / 20)
    return Measurement(value=value, detail=f"ratio {product / square:.3f}")


@check(
    group="dataset",
    scope="dataset",
    measures="EE pose against forward kinematics of the state",
    unit="m",
    warn=1e-4,
    fail=1e-3,
)
def dataset_forward_kinematics(dataset: Dataset) -> Measurement | None:
    """observation.ee_pose is that of observation.state (float32; 0.1 m per rad of rotation)."""
    if EE_POSE not in dataset.info.features:
        return None
    found, urdfs = [], {}
    for number, (rows, info) in enumerate(dataset.described()):
        key = (info.robot.urdf, info.scene.robot.scale)
        if key not in urdfs:
            urdfs[key] = Urdf.load(asset_path(info.robot.urdf), scale=info.scene.robot.scale)
        joints = dict(zip(info.robot.arm_joints, rows[STATE].astype(np.float64).T, strict=False))
        fk = link_matrices(urdfs[key], info.robot.tcp_link, joints, len(rows[STATE]))
        off = displacement(matrices(rows[EE_POSE].astype(np.float64)), fk)
        frame = int(np.argmax(off))
        found.append(Measurement(value=float(off[frame]), frame=frame, detail=f"episode {number}"))
    return worst(*found)


@check(group="dataset", scope="dataset", measures="lag between action and state, off the contract's, frames", warn=0)
def dataset_action_lag(dataset: Dataset) -> Measurement | None:
    """Action t is what leads from observation t to t + 1, in every episode; catches shifted and made-up actions.

    Poses are compared by position. Exploration noise is in the states and not in the actions: what counts is the
    third of the moving frames in which the two are nearest. Increments are summed up first; where noise was executed,
    it is taken back in them and they cannot be: then their course, smoothed, is compared with that of the changes of
    state, all episodes together, and two frames are allowed.
    """
    found, wishes, changes = [], [], []
    for number, (rows, info) in enumerate(dataset.described()):
        kind = dataset.action_kind(info)
        if kind is None:
            continue
        action, state = rows[ACTION].astype(np.float64), rows[STATE].astype(np.float64)
        arm = len(info.robot.arm_joints)
        is_joint = kind in ("joint", "joint_increment")
        if not is_joint and EE_POSE not in rows:
            continue
        width = arm if is_joint else 3
        reached = state[:, :arm] if is_joint else rows[EE_POSE].astype(np.float64)[:, :3]
        start = np.array(info.scene.robot.joint_position) if is_joint else reached[0]
        substeps = max(info.physics_hz // dataset.info.fps, 1)
        if kind in ("joint_increment", "ee_delta") and not info.behaviour.get("action_noise", 0.0):
            action = np.concatenate([start + np.cumsum(action[:, :width], axis=0), action[:, -1:]], axis=1)
        elif kind in ("joint_increment", "ee_delta"):
            # The servo is linear: its response to increments is the increments of its response.
            wishes.append(servo_response(action[:, :width], start=np.zeros(width), substeps=substeps)[1:])
            changes.append(np.diff(reached, axis=0))
            continue
        lag = _quantile_lag(action[:, :width], reached, start, substeps=substeps)
        if lag is not None:
            detail = f"episode {number}: {lag:+g} frames" if math.isfinite(lag) else f"episode {number}: unrelated"
            found.append(Measurement(value=abs(lag), detail=detail))
    if wishes:
        found.append(_course_lag(wishes, changes))
    return worst(*found)


def _course_lag(wishes: list[Array], changes: list[Array], *, reach: int = 4, window: int = 9) -> Measurement:
    """By how many whole frames changes run behind wishes, by the correlation of their smoothed courses."""
    box = np.ones(window) / window

    def smooth(table: Array) -> Array:
        return np.stack([np.convolve(column, box, mode="same") for column in table.T], axis=1)

    products, sizes = np.zeros(2 * reach + 1), np.zeros(2)
    for wish, change in zip(wishes, changes, strict=True):
        x, y = smooth(wish), smooth(change)
        core = slice(reach, len(x) - reach)
        sizes += (x[core] ** 2).sum(), (y[core] ** 2).sum()
        products += [float((x[core] * np.roll(y, -k, axis=0)[core]).sum()) for k in range(-reach, reach + 1)]
    best = int(np.argmax(products))
    likeness = products[best] / max(math.sqrt(sizes[0] * sizes[1]), 1e-12)
    lag = best - reach
    if likeness < 0.5:
        return Measurement(value=math.inf, detail=f"actions and changes of state are unrelated ({likeness:.2f})")
    return Measurement(value=max(abs(lag) - 2, 0), detail=f"all episodes: {lag:+d} frames, likeness {likeness:.2f}")


def _quantile_lag(wanted: Array, reached: Array, start: Array, *, substeps: int) -> float | None:
    expected = servo_response(wanted, start=start, substeps=substeps)
    shifts = range(-3, 4)
    core = np.arange(3, len(expected) - 3)
    if len(core) < 10:
        return None
    step = np.linalg.norm(reached[core + 1] - reached[core - 1], axis=1) / 2
    moving = step > 0.3 * math.sqrt(float((step**2).mean()))
    core, step = core[moving], step[moving]
    if len(core) < 10:
        return None
    off = [float(np.quantile(np.linalg.norm(reached[core + k] - expected[core], axis=1) / step, 0.33)) for k in shifts]
    best = int(np.argmin(off))
    return math.inf if off[best] > 3.0 else float(shifts[best])


# ------------------------------------------------------------------------------------------------- beside it


@check(group="dataset", scope="dataset", measures="episodes on which dataset and sidecar disagree", warn=0)
def dataset_sidecar(dataset: Dataset) -> Measurement | None:
    """Task, success and content digest of each episode are those that the sidecar keeps."""
    if not dataset.sidecar:
        return None
    wrong = []
    if len(dataset.sidecar) != len(dataset.rows):
        wrong.append(f"{len(dataset.sidecar)} rows for {len(dataset.rows)} episodes")
    digests = episode_digests(dataset.path, dataset.info)
    for number, (row, rows, info, place) in enumerate(
        zip(dataset.sidecar, dataset.rows, dataset.infos, dataset.places, strict=False)
    ):
        if row["episode_index"] != number:
            wrong.append(f"row {number} is of episode {row['episode_index']}")
        elif place.tasks != (info.instruction,):
            wrong.append(f"episode {number} has another instruction")
        elif "next.success" in rows and bool(rows["next.success"][-1, 0]) != row["success"]:
            wrong.append(f"episode {number} has another outcome")
        elif digests[number] != row["content_digest"]:
            wrong.append(f"episode {number} has changed since it was exported")
    return Measurement(value=len(wrong), detail="; ".join(wrong[:3]) or f"{len(dataset.sidecar)} episodes")


_OPEN = """
import json, sys
from lerobot.datasets.lerobot_dataset import LeRobotDataset
dataset = LeRobotDataset(repo_id="local/check", root=sys.argv[1])
frames = sorted({0, len(dataset) // 2, len(dataset) - 1})
for frame in frames:
    item = dataset[frame]
    assert int(item["index"]) == frame, f"row {frame} has index {int(item['index'])}"
print(json.dumps({"episodes": dataset.num_episodes, "frames": len(dataset)}))
"""


@check(
    group="dataset", scope="dataset", measures="errors when the installed LeRobot opens it", warn=0, needs_pictures=True
)
def dataset_opens(dataset: Dataset) -> Measurement:
    """LeRobot opens the dataset and reads first, middle and last frame, pictures included."""
    with tempfile.TemporaryDirectory(prefix="demorec-check-") as cache:
        environment = {**os.environ, "HF_HUB_OFFLINE": "1", "HF_DATASETS_OFFLINE": "1", "HF_DATASETS_CACHE": cache}
        done = subprocess.run(
            [sys.executable, "-c", _OPEN, str(dataset.path)],
            capture_output=True,
            text=True,
            env=environment,
            timeout=600,
            check=False,
        )
    if done.returncode != 0:
        lines = [line for line in done.stderr.splitlines() if line.strip()]
        return Measurement(value=1, detail=lines[-1][:200] if lines else f"exit status {done.returncode}")
    told = json.loads(done.stdout.splitlines()[-1])
    same = (told["episodes"], told["frames"]) == (dataset.info.total_episodes, dataset.info.total_frames)
    return Measurement(value=int(not same), detail=f"{told['episodes']} episodes, {told['frames']} frames")
