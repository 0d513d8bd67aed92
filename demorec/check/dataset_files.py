"""Is a LeRobot dataset whole: tables, counts, videos, statistics, and what stands beside it."""

from __future__ import annotations

import json
import math
import os
import re
import subprocess
import sys
import tempfile
from typing import Any

import numpy as np

from demorec.check.base import Measurement, check, worst
from demorec.check.dataset import Dataset
from demorec.errors import ExportError, MissingDependencyError, in_words
from demorec.geometry import Array
from demorec.lerobot.files import check_video, read_json
from demorec.lerobot.inspect import episode_digests
from demorec.lerobot.reader import PacketReader
from demorec.lerobot.verify import LEROBOT, lerobot_is_installed


@check(
    group="dataset",
    scope="dataset",
    measures="tables that cannot be read",
    warn=0,
    reads=(
        "meta/info.json",
        "meta/episodes",
    ),
)
def dataset_readable(dataset: Dataset) -> Measurement:
    """info.json, the tables and every row can be read."""
    frames = sum(len(rows["index"]) for rows in dataset.rows)
    return Measurement(value=0, detail=f"{len(dataset.rows)} episodes, {frames} frames, {len(dataset.tasks)} tasks")


@check(
    group="dataset",
    scope="dataset",
    measures="counters, indices and timestamps that are not as they must be",
    warn=0,
    reads=(
        "timestamp",
        "frame_index",
        "episode_index",
        "index",
        "task_index",
    ),
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


@check(
    group="dataset",
    scope="dataset",
    measures="episodes without a coded picture for every frame",
    warn=0,
    reads=(
        "observation.images.{camera}",
        "observation.images.{camera}_depth",
    ),
)
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
            wrong.append(str(error))
        finally:
            reader.close()
    return Measurement(value=len(wrong), detail="; ".join(wrong[:2]) or f"{len(dataset.info.video_keys)} cameras")


@check(
    group="dataset",
    scope="dataset",
    measures="statistics against those recomputed from all rows, in standard deviations",
    warn=0.01,
    fail=0.05,
    reads=(
        "meta/stats.json",
        "observation.state",
        "observation.velocity",
        "observation.ee_pose",
        "observation.environment_state",
        "action",
    ),
)
def dataset_statistics(dataset: Dataset) -> Measurement | None:
    """meta/stats.json, by which training normalises, is that of the data."""
    stats, found = _stats(dataset), []
    if not dataset.rows:
        return None
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
            told = _numbers(said.get(quantity, np.inf))
            off = np.abs(told - value) / scale if told.shape == value.shape else np.array([np.inf])
            found.append(Measurement(value=float(off.max()), detail=f"{quantity} of {name}"))
    return worst(*found)


def _stats(dataset: Dataset) -> dict[str, Any]:
    path = dataset.path / "meta" / "stats.json"
    try:
        found = read_json(path)
        if not isinstance(found, dict) or not all(isinstance(entry, dict) for entry in found.values()):
            raise ValueError("it holds no object of objects")
    except (OSError, ValueError) as error:
        raise ExportError(f"The statistics cannot be read ({in_words(error)}): {path}") from error
    return found


def _numbers(value: Any) -> Array:
    """(N,) numbers of an entry in the statistics, however nested; (0,) for what is none."""
    try:
        return np.asarray(value, dtype=np.float64).reshape(-1)
    except (ValueError, TypeError, OverflowError):
        return np.zeros(0)


@check(
    group="dataset",
    scope="dataset",
    measures="mean colour in the statistics against decoded pictures, of 1",
    warn=0.06,
    fail=0.12,
    needs_pictures=True,
    reads=(
        "meta/stats.json",
        "observation.images.{camera}",
    ),
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
            check_video(path)
            try:
                with av.open(str(path), format="mp4") as container:
                    _bound_pictures(container, dataset.info.features[key].shape)
                    for number, frame in enumerate(container.decode(video=0)):
                        if number % 10 == 0:
                            means.append(frame.to_ndarray(format="rgb24").mean(axis=(0, 1)) / 255)
            except (OSError, av.FFmpegError) as error:
                raise ExportError(f"The video cannot be decoded ({in_words(error)}): {path}") from error
        said = _numbers(stats.get(key, {}).get("mean", np.full(3, np.inf)))
        if means:
            value = float(np.abs(np.mean(means, axis=0) - said).max()) if said.shape == (3,) else math.inf
            found.append(Measurement(value=value, detail=f"{key}, {len(means)} pictures"))
    return worst(*found)


def _bound_pictures(container: Any, shape: tuple[int, ...]) -> None:
    """Refuse to decode pictures much larger than the dataset says: a few bytes can announce gigabytes."""
    height, width = shape[:2]
    for stream in container.streams.video:
        stream.codec_context.options = {"max_pixels": str((height + 128) * (width + 128))}


@check(
    group="dataset",
    scope="dataset",
    measures="episodes on which dataset and sidecar disagree",
    warn=0,
    reads=("demorec/",),
)
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
    group="dataset",
    scope="dataset",
    measures="errors when the installed LeRobot opens it",
    warn=0,
    needs_pictures=True,
    reads=("meta/info.json",),
)
def dataset_opens(dataset: Dataset) -> Measurement:
    """LeRobot opens the dataset and reads first, middle and last frame, pictures included."""
    if not lerobot_is_installed():
        raise MissingDependencyError("Opening a dataset as a training does", "lerobot", f"pip install '{LEROBOT}'")
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
        said = re.sub(r"^[\w.]+: ", "", lines[-1])[:200] if lines else f"it ends with the exit status {done.returncode}"
        return Measurement(value=1, detail=f"LeRobot cannot open it ({said})")
    told = json.loads(done.stdout.splitlines()[-1])
    same = (told["episodes"], told["frames"]) == (dataset.info.total_episodes, dataset.info.total_frames)
    return Measurement(value=int(not same), detail=f"{told['episodes']} episodes, {told['frames']} frames")
