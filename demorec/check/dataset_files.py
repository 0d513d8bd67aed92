"""Checks of a LeRobot dataset's files: tables and videos against info.json, episodes against the sidecar."""

from __future__ import annotations

import math
import reprlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from demorec.check.base import Measurement, NotMeasured, counted, dataset_check
from demorec.check.dataset import CheckedDataset
from demorec.datasets.episode import SUCCESS
from demorec.datasets.lerobot.files import open_table, read_table, tables_in
from demorec.datasets.lerobot.inspect import episode_digests, noted
from demorec.datasets.lerobot.layout import (
    AUTOMATIC_FEATURES,
    TASKS_PATH,
    DatasetFeature,
)
from demorec.datasets.lerobot.videos import opened_video

_TYPES = {
    "float32": pa.float32(), "float64": pa.float64(), "int64": pa.int64(), "bool": pa.bool_(), "string": pa.string(),
}  # fmt: skip
_RATE_TOLERANCE = 0.01
"""Files that were put together have rates that are a little off."""


@dataset_check(measures="reasons why rows cannot be read or are not those of their episode")
def dataset_readable(dataset: CheckedDataset) -> Measurement:
    """Read info.json, the tables and every row."""
    tasks = dataset.folder.tasks
    frames = sum(dataset.folder.listed[number].length for number in dataset.rows)
    good = f"{len(dataset.rows)} episodes, {frames} frames, {len(tasks)} tasks"
    return counted(list(dict.fromkeys(dataset.unreadable.values())), good)


@dataset_check(measures="wrong counters, indices and timestamps")
def dataset_counts(dataset: CheckedDataset) -> Measurement:
    """Compare totals with the tables; indices count up without a gap, timestamps are frame_index / fps."""
    info, tasks, wrong = dataset.info, dataset.folder.tasks, []
    if dataset.folder.is_found_by_rows:
        wrong.append("the table of episodes")
    totals = {
        "total_episodes": (info.total_episodes, len(dataset.folder.listed)),
        "total_frames": (info.total_frames, sum(place.length for place in dataset.folder.listed)),
        "total_tasks": (info.total_tasks, len(tasks)),
    }
    wrong += [f"{name} is {said}, found {found}" for name, (said, found) in totals.items() if said != found]
    start = 0
    for number, place in enumerate(dataset.folder.listed):
        rows = dataset.rows.get(number)
        if place.episode_index != number or place.from_index != start:
            wrong.append(f"the place of episode {number}")
        if rows is None:
            start += place.length
            continue
        count = np.arange(place.length)
        expected = {
            "index": start + count,
            "episode_index": np.full(place.length, number),
            "frame_index": count,
            "timestamp": (count / info.fps).astype(np.float32),
        }
        for name, values in expected.items():
            if name in rows and not np.array_equal(rows[name].reshape(-1), values):
                wrong.append(f"{name} of episode {number}")
        used = {int(index) for index in rows["task_index"].reshape(-1)}
        names = {tasks[index] if 0 <= index < len(tasks) else "" for index in used}
        if names != set(place.tasks):
            wrong.append(f"the task of episode {number}")
        start += place.length
    if not info.is_old:
        # LeRobot takes the row of a number, whatever number stands in it.
        numbers = read_table(dataset.path / TASKS_PATH, ["task_index"]).column("task_index").to_pylist()
        wrong += ["the tasks' numbers"] if numbers != list(range(len(numbers))) else []
        wrong += [*_wrong_ranges(dataset), *_stray_rows(dataset)]
    return counted(wrong, f"{start} frames at {info.fps} fps")


def _wrong_ranges(dataset: CheckedDataset) -> Iterator[str]:
    """Where the episodes' table says that things are: rows of the dataset, and seconds of each video."""
    ends = [f"videos/{key}/to_timestamp" for key in dataset.info.video_keys]
    for path in tables_in(dataset.path, "meta/episodes"):
        columns = open_table(path).schema_arrow.names
        names = [name for name in ("dataset_to_index", *ends) if name in columns]
        begins = [name.replace("to_", "from_") for name in names]
        for row in read_table(path, ["episode_index", "length", *names, *begins]).to_pylist():
            for begin, end in zip(begins, names, strict=True):
                unit = 1 if end == "dataset_to_index" else dataset.info.fps
                if not abs((row[end] - row[begin]) * unit - row["length"]) < 0.5:
                    yield f"{end} of episode {row['episode_index']}"


def _stray_rows(dataset: CheckedDataset) -> Iterator[str]:
    """Rows of the data files that belong to no episode."""
    for file in tables_in(dataset.path, "data"):
        found, listed = open_table(file).metadata.num_rows, dataset.folder.num_rows.get(file, 0)
        if listed != found:
            yield f"{file.name} has {found} rows, {listed} of them of episodes"


@dataset_check(
    measures="video files without an episode",
    fail=math.inf,
)
def dataset_strays(dataset: CheckedDataset) -> Measurement | None:
    """Find mp4 files without an episode, as merges, deleted episodes and renamed cameras leave them."""
    if dataset.info.is_old:
        return None
    used = {path for place in dataset.folder.listed for path, _ in place.videos.values()}
    found = sorted(set((dataset.path / "videos").rglob("*.mp4")) - used)
    return counted([path.relative_to(dataset.path).as_posix() for path in found])


@dataset_check(measures="episodes without a coded image for every frame")
def dataset_videos(dataset: CheckedDataset) -> Measurement | None:
    """Find the encoded images of every episode in every camera's file, one after the other.

    In front of an episode there may be images from the keyframe on that its first one needs.
    """
    if not dataset.info.video_keys:
        return None
    wrong: list[str] = []
    for key in dataset.info.video_keys:
        ends: dict[Path, int] = {}
        for place in dataset.folder.listed:
            path, first = place.videos[key]
            end, ends[path] = ends.get(path, 0), first + place.length
            with noted(wrong, dataset.path):
                # Between two episodes there is nothing but what the second one is decoded from.
                if first not in (end, end + dataset.folder.video(key, place).lead):
                    wrong.append(f"{key}, episode {place.episode_index}: starts at image {first}")
    return Measurement(value=len(wrong), detail="; ".join(wrong[:2]) or f"{len(dataset.info.video_keys)} cameras")


@dataset_check(measures="episodes on which dataset and sidecar disagree", needs="the sidecar that demorec keeps")
def dataset_sidecar(dataset: CheckedDataset) -> Measurement | NotMeasured:
    """Compare instruction, outcome and content digest of each episode with the sidecar."""
    if not dataset.sidecar:
        return NotMeasured(why="it needs the sidecar that demorec keeps")
    count = len(dataset.folder.listed)
    known = [row["episode_index"] for row in dataset.sidecar]
    if sorted(set(known)) != known or not set(known) <= set(range(count)):
        return Measurement(value=1, detail=f"its rows are of the episodes {reprlib.repr(known)}, there are {count}")
    missing = sorted(set(range(count)) - set(known))
    wrong = [f"episode {number} is unknown, as one that LeRobot recorded with resume" for number in missing]
    infos = {each.number: each.info for each in dataset.described()}
    digests = dict(zip(dataset.rows, episode_digests(dataset.folder, list(dataset.rows)), strict=True))
    for row in dataset.sidecar:
        number = row["episode_index"]
        if (rows := dataset.rows.get(number)) is None:
            continue
        if number in infos and dataset.folder.listed[number].tasks != (infos[number].instruction,):
            wrong.append(f"episode {number} has another instruction")
        elif SUCCESS in rows and bool(rows[SUCCESS][-1, 0]) != bool(row["success"]):
            wrong.append(f"episode {number} has another outcome")
        elif digests[number] != row["content_digest"]:
            wrong.append(f"episode {number} has changed since it was exported")
    return counted(wrong, f"{len(known)} episodes")


@dataset_check(measures="statements of info.json that its tables and videos contradict")
def dataset_schema(dataset: CheckedDataset) -> Measurement:
    """Compare columns, types and shapes; codec, size and rate of each video file."""
    wrong = [*_columns(dataset), *_videos(dataset)]
    found = f"{len(dataset.info.features)} features"
    return counted(wrong, found)


def _columns(dataset: CheckedDataset) -> Iterator[str]:
    """Of the data files, against the features; and of the counters, against what they always are."""
    features = {name: feature for name, feature in dataset.info.features.items() if not feature.is_video}
    for name, fixed in AUTOMATIC_FEATURES.items():
        found = features.get(name)
        is_precise = name == "timestamp" and found is not None and found.dtype == "float64"
        if found is None or found.shape != fixed.shape or not (is_precise or found.dtype == fixed.dtype):
            yield f"{name} is no {fixed.dtype} of shape {fixed.shape}"
    for path in tables_in(dataset.path, "data"):
        schema = open_table(path).schema_arrow
        columns = set(schema.names)
        needed = [name for name in features if name not in dataset.info.unlisted]
        yield from (f"{path.name} has no column {name}" for name in needed if name not in columns)
        yield from (f"{path.name} has a column {name}, which is no feature" for name in columns if name not in features)
        for name in features:
            if name in columns and not _fits(schema.field(name).type, features[name]):
                yield f"{name} is {schema.field(name).type} in {path.name}, {features[name].dtype} in info.json"


def _fits(found: pa.DataType, feature: DatasetFeature) -> bool:
    if feature.dtype not in _TYPES:
        return True  # images in tables, which other writers have
    size = None
    while pa.types.is_list(found) or pa.types.is_fixed_size_list(found) or pa.types.is_large_list(found):
        if pa.types.is_fixed_size_list(found):
            size = (size or 1) * found.list_size
        found = found.value_type
    if size is not None and size != math.prod(feature.shape):
        return False
    return bool(found == _TYPES[feature.dtype] or (feature.dtype == "string" and pa.types.is_large_string(found)))


def _videos(dataset: CheckedDataset) -> Iterator[str]:
    for key in dataset.info.video_keys:
        feature = dataset.info.features[key]
        width, height = feature.image_size
        info = feature.info or {}
        said: dict[str, Any] = {"height": height, "width": width}
        said |= {name: info[f"video.{name}"] for name in ("codec", "pix_fmt") if info.get(f"video.{name}")}
        said |= {"sound": info["has_audio"]} if isinstance(info.get("has_audio"), bool) else {}
        for path in dict.fromkeys(place.videos[key][0] for place in dataset.folder.listed):
            found: dict[str, Any] = {}
            rate = float(dataset.info.fps)
            # A video that cannot be read is a finding of `dataset_videos`.
            with noted([], dataset.path), opened_video(path) as (container, stream):
                context, rate = stream.codec_context, float(stream.average_rate or 0)
                codec = {"libdav1d": "av1"}.get(context.name, context.name)
                found = {"height": context.height, "width": context.width, "pix_fmt": context.pix_fmt, "codec": codec}
                found["sound"] = bool(container.streams.audio)
            for quantity, value in found.items():
                if quantity in said and said[quantity] != value:
                    yield f"{key}: {quantity} is {said[quantity]} in info.json, {value} in {path.name}"
            if not abs(rate - dataset.info.fps) <= _RATE_TOLERANCE * dataset.info.fps:
                yield f"{key}: fps is {dataset.info.fps} in info.json, {rate:.4g} in {path.name}"
        if feature.is_depth and feature.shape[2] != 1:
            yield f"{key} is a depth map of {feature.shape[2]} channels"
        for quantity, value in (("height", height), ("width", width), ("channels", feature.shape[2])):
            if info.get(f"video.{quantity}", value) != value:
                yield f"{key}: video.{quantity} is {info[f'video.{quantity}']}, the shape has {value}"
        if info.get("video.fps", dataset.info.fps) != dataset.info.fps:
            yield f"{key}: video.fps is {info['video.fps']}, the dataset has {dataset.info.fps}"
