"""Is a LeRobot dataset whole: are its tables and videos as info.json says, and does LeRobot open it."""

from __future__ import annotations

import json
import math
import os
import re
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from demorec.check.base import Measurement, counted, dataset_check
from demorec.check.dataset import Dataset
from demorec.core.errors import ExportError, MissingDependencyError, ResourceError
from demorec.core.tables import ROBOTS
from demorec.datasets.episode import DONE, REWARD, SUCCESS
from demorec.datasets.lerobot.files import open_table, read_json, read_table, tables_in
from demorec.datasets.lerobot.inspect import dataset_problems
from demorec.datasets.lerobot.layout import (
    AUTOMATIC_FEATURES,
    EPISODES_PATH,
    TASKS_PATH,
    DatasetFeature,
    FilePosition,
)
from demorec.datasets.lerobot.paths import INFO_PATH
from demorec.datasets.lerobot.robots import ELEMENT_SUFFIX
from demorec.datasets.lerobot.verify import LEROBOT, lerobot_is_installed
from demorec.datasets.lerobot.videos import PacketReader, opened_video
from demorec.episode.features import STATE

_TYPES = {
    "float32": pa.float32(), "float64": pa.float64(), "int64": pa.int64(), "bool": pa.bool_(), "string": pa.string(),
}  # fmt: skip
_CHANNELS, _CHANNEL_COUNTS = ("channel", "channels"), (1, 3, 4)
_RATE_TOLERANCE = 0.01
"""Files that were put together have rates that are a little off."""


@dataset_check(measures="tables that cannot be read")
def dataset_readable(dataset: Dataset) -> Measurement:
    """info.json, the tables and every row can be read."""
    frames = sum(len(rows["index"]) for rows in dataset.rows)
    return Measurement(value=0, detail=f"{len(dataset.rows)} episodes, {frames} frames, {len(dataset.tasks)} tasks")


@dataset_check(measures="counters, indices and timestamps that are not as they must be")
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
        names = {dataset.tasks[index] if 0 <= index < len(dataset.tasks) else "" for index in used}
        if names != set(place.tasks):
            wrong.append(f"the task of episode {number}")
        start += place.length
    wrong += _wrong_ends(dataset)
    if not info.is_old:
        # LeRobot takes the row of a number, whatever number stands in it.
        numbers = read_table(dataset.path / TASKS_PATH, ["task_index"]).column("task_index").to_pylist()
        wrong += ["the tasks' numbers"] if numbers != list(range(len(numbers))) else []
        wrong += [*_wrong_ranges(dataset), *_stray_rows(dataset)]
    return counted(wrong, f"{start} frames at {info.fps} fps")


def _wrong_ranges(dataset: Dataset) -> Iterator[str]:
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


def _stray_rows(dataset: Dataset) -> Iterator[str]:
    """Rows of the data files that belong to no episode."""
    used: dict[Path, int] = {}
    for place in dataset.places:
        used[place.data] = used.get(place.data, 0) + place.length
    for file in tables_in(dataset.path, "data"):
        found = open_table(file).metadata.num_rows
        if (count := used.get(file, 0)) != found:
            yield f"{file.name} has {found} rows, {count} of them of episodes"


def _wrong_ends(dataset: Dataset) -> Iterator[str]:
    """Where an episode is said to be done, if most are at their last row, and goes on after that; a reward where there
    is no success, if nothing is rewarded but that."""
    if DONE in dataset.info.features:
        done = [rows[DONE].reshape(-1) for rows in dataset.rows]
        for number, flags in enumerate(done):
            if (flags[:-1] > flags[1:]).any():
                yield f"episode {number} goes on after its {DONE}"
        last = [bool(flags[-1]) and int(flags.sum()) == 1 for flags in done]
        if not any(flags.any() for flags in done) and "next.truncated" not in dataset.info.features:
            yield f"{DONE} of all episodes"
        if sum(last) > len(last) / 2:
            yield from (f"{DONE} of episode {number}" for number, is_last in enumerate(last) if not is_last)
    if {REWARD, SUCCESS} <= dataset.info.features.keys():
        sparse = all(np.isin(rows[REWARD], (0, 1)).all() for rows in dataset.rows)
        for number, rows in enumerate(dataset.rows if dataset.sidecar or sparse else ()):
            if not np.array_equal(rows[REWARD].reshape(-1) > 0, rows[SUCCESS].reshape(-1)):
                yield f"{REWARD} of episode {number}"


@dataset_check(
    measures="files of images that no episode has, and of episodes that are said to lie elsewhere",
    fail=math.inf,
)
def dataset_strays(dataset: Dataset) -> Measurement | None:
    """Every mp4 file is of a camera and an episode: catches what merges, deleted episodes and renamed cameras leave.

    Where the table of an episode lies, LeRobot takes from the episode's row when it merges or deletes.
    """
    if dataset.info.is_old:
        return None
    used = {path for place in dataset.places for path, _ in place.videos.values()}
    found = sorted(set((dataset.path / "videos").rglob("*.mp4")) - used)
    strays = [*(path.relative_to(dataset.path).as_posix() for path in found), *_said_elsewhere(dataset)]
    return Measurement(value=len(strays), detail=", ".join(strays[:3]))


def _said_elsewhere(dataset: Dataset) -> Iterator[str]:
    names = ["meta/episodes/chunk_index", "meta/episodes/file_index"]
    for file in tables_in(dataset.path, "meta/episodes"):
        if set(names) <= set(open_table(file).schema_arrow.names):
            there = file.relative_to(dataset.path).as_posix()
            for chunk, number in {tuple(row.values()) for row in read_table(file, names).to_pylist()}:
                told = isinstance(chunk, int) and isinstance(number, int)
                path = FilePosition(chunk=chunk, file=number).path(EPISODES_PATH) if told else "no file"
                if path != there:
                    yield f"{there} says of its episodes that they lie in {path}"


@dataset_check(measures="episodes without a coded image for every frame")
def dataset_videos(dataset: Dataset) -> Measurement | None:
    """Every episode has its images in every camera's file, one after the other.

    In front of an episode there may be images from the keyframe on that its first one needs.
    """
    if not dataset.info.video_keys:
        return None
    wrong = []
    for key in dataset.info.video_keys:
        ends: dict[Path, int] = {}
        try:
            with closing(PacketReader(key)) as reader:
                for place in dataset.places:
                    path, first = place.videos[key]
                    end, ends[path] = ends.get(path, 0), first + place.length
                    for number, _ in enumerate(reader.read(place)):
                        # Between two episodes there is nothing but what the second one is decoded from.
                        if number == 0 and first != end and reader.keyframe != end:
                            wrong.append(f"{key}, episode {place.episode_index}: starts at image {first}")
        except ExportError as error:
            wrong.append(str(error))
    return Measurement(value=len(wrong), detail="; ".join(wrong[:2]) or f"{len(dataset.info.video_keys)} cameras")


@dataset_check(measures="statements of info.json that its tables and videos contradict")
def dataset_schema(dataset: Dataset) -> Measurement:
    """Columns, types, shapes, names; codec, size and rate of each video file; splits that cover all episodes."""
    wrong = [*_columns(dataset), *_names(dataset), *_videos(dataset), *_splits(dataset)]
    found = f"{len(dataset.info.features)} features"
    return counted(wrong, found)


def _columns(dataset: Dataset) -> Iterator[str]:
    """Of the data files, against the features; and of the counters, against what they always are."""
    features = {name: feature for name, feature in dataset.info.features.items() if not feature.is_video}
    for name, fixed in AUTOMATIC_FEATURES.items():
        found = features.get(name)
        if found is None or (found.dtype, found.shape) != (fixed.dtype, fixed.shape):
            yield f"{name} is no {fixed.dtype} of shape {fixed.shape}"
    for path in tables_in(dataset.path, "data"):
        schema = open_table(path).schema_arrow
        columns = set(schema.names)
        yield from (f"{path.name} has no column {name}" for name in features if name not in columns)
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


def _names(dataset: Dataset) -> Iterator[str]:
    for name, feature in dataset.info.features.items():
        for place, told in enumerate(feature.names or ()) if len(feature.shape) == 3 else ():
            if told in _CHANNELS and place < 3 and feature.shape[place] not in _CHANNEL_COUNTS:
                yield f"{name} has {feature.shape[place]} {told} by its names"
        if feature.names is None or len(feature.shape) != 1:
            continue
        if len(feature.names) != feature.shape[0]:
            yield f"{name} has {len(feature.names)} names for {feature.shape[0]} components"
        if len(set(feature.names)) != len(feature.names):
            yield f"{name} names a component twice"
    state = dataset.info.features.get(STATE)
    joints = [ELEMENT_SUFFIX.sub("", name) for name in state.names or ()] if state is not None else []
    robot = dataset.info.robot_type
    for other in ROBOTS.names() if joints and robot in ROBOTS.names() else ():
        if other != robot and all(other in name for name in joints[:-1]):
            yield f"robot_type is {robot}, the joints are those of {other}"
    known = ROBOTS.load(robot).arm_joints if robot in ROBOTS.names() else ()
    lacking = [joint for joint in known if joint not in joints]
    if lacking and len(lacking) <= len(known) / 2 and len(joints) >= len(known):  # of an arm called otherwise all are
        yield f"robot_type is {robot}, no joint is its {lacking[0]}"


def _videos(dataset: Dataset) -> Iterator[str]:
    for key in dataset.info.video_keys:
        feature = dataset.info.features[key]
        height, width = feature.shape[:2]
        info = feature.info or {}
        said: dict[str, Any] = {"height": height, "width": width}
        said |= {name: info[f"video.{name}"] for name in ("codec", "pix_fmt") if info.get(f"video.{name}")}
        said |= {"sound": info["has_audio"]} if isinstance(info.get("has_audio"), bool) else {}
        for path in dict.fromkeys(place.videos[key][0] for place in dataset.places):
            with opened_video(path) as (container, stream):
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


def _splits(dataset: Dataset) -> Iterator[str]:
    """Every episode in one split, none beyond."""
    splits = read_json(dataset.path / INFO_PATH).get("splits")
    if splits is None:
        return
    used: list[int] = []
    try:
        for text in splits.values():
            first, last = (int(part) for part in text.split(":"))
            if not 0 <= first <= last <= dataset.info.total_episodes:
                raise ValueError(text)
            used += range(first, last)
    except (AttributeError, TypeError, ValueError):
        yield f"the splits {str(splits)[:80]} are no ranges of its {dataset.info.total_episodes} episodes"
        return
    if sorted(used) != list(range(dataset.info.total_episodes)):
        yield f"the splits have {len(used)} of {dataset.info.total_episodes} episodes"


_PATIENCE_S = 600
_NO_MEMORY = re.compile(
    r"MemoryError|bad_alloc|out of memory|allocate memory|unable to allocate|(m|re)alloc of size|failed to map segment"
    r"|can't start new thread",
    re.IGNORECASE,
)
"""How Python, NumPy, PyTorch, Arrow and the dynamic linker say that there is too little."""
_OPEN = """
import json, sys
from lerobot.datasets.lerobot_dataset import LeRobotDataset
print("loaded", flush=True)
dataset = LeRobotDataset(repo_id="local/check", root=sys.argv[1])
frames = sorted({0, len(dataset) // 2, len(dataset) - 1})
for frame in frames:
    item = dataset[frame]
    assert int(item["index"]) == frame, f"row {frame} has index {int(item['index'])}"
print(json.dumps({"episodes": dataset.num_episodes, "frames": len(dataset)}))
"""


@dataset_check(
    measures="errors when the installed LeRobot opens it",
    needs_images=True,
)
def dataset_opens(dataset: Dataset) -> Measurement | None:
    """LeRobot opens the dataset and reads first, middle and last frame, images included."""
    if dataset.info.is_old:  # LeRobot 0.6 reads v3.0 alone
        return None
    if not lerobot_is_installed():
        raise MissingDependencyError("Opening a dataset as a training does", "lerobot", f"pip install '{LEROBOT}'")
    with tempfile.TemporaryDirectory(prefix="demorec-check-") as cache:
        environment = {**os.environ, "HF_HUB_OFFLINE": "1", "HF_DATASETS_OFFLINE": "1", "HF_DATASETS_CACHE": cache}
        try:
            done = subprocess.run(
                [sys.executable, "-c", _OPEN, str(dataset.path)],
                capture_output=True,
                text=True,
                errors="replace",
                env=environment,
                timeout=_PATIENCE_S,
                check=False,
            )
        except subprocess.TimeoutExpired:
            return Measurement(value=1, detail=f"LeRobot has not opened it after {_PATIENCE_S} s")
    if done.returncode != 0:
        lines = [line for line in done.stderr.splitlines() if line.strip()]
        said = re.sub(r"^[\w.]+: ", "", lines[-1])[:200] if lines else f"it ends with the exit status {done.returncode}"
        if not done.stdout.startswith("loaded") or done.returncode == -signal.SIGKILL or _NO_MEMORY.search(done.stderr):
            raise ResourceError(
                f"LeRobot could not be tried ({said.strip().rstrip('.')}): is there too little memory? Free some, or "
                f"raise the limit (ulimit -v); whether the dataset is sound is not known: {dataset.path}"
            )
        # It asks the Hub for files that are missing here, and complains that it may not.
        problems = dataset_problems(dataset.path, dataset.info)
        return Measurement(value=1, detail=f"LeRobot cannot open it ({problems[0] if problems else said})")
    found = json.loads(done.stdout.splitlines()[-1])
    same = (found["episodes"], found["frames"]) == (dataset.info.total_episodes, dataset.info.total_frames)
    return Measurement(value=int(not same), detail=f"{found['episodes']} episodes, {found['frames']} frames")
