"""Differences of a dataset's info.json, tables and statistics from its rows and videos, and the corrections."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from demorec.core.errors import ExportError, without_path
from demorec.core.replacing import shown
from demorec.datasets.lerobot.files import column_numbers, open_table, read_json, read_table, table_batches
from demorec.datasets.lerobot.layout import AUTOMATIC_FEATURES, STATS_PATH, TASKS_PATH, DatasetFeature, DatasetInfo
from demorec.datasets.lerobot.paths import INFO_PATH
from demorec.extensions.datasets.episode_places import EpisodePlace, read_tasks
from demorec.extensions.datasets.folder import LeRobotFolder
from demorec.extensions.datasets.inspect import OLD_STATS, range_errors, stored_dtype
from demorec.extensions.datasets.mp4_index import mp4_index
from demorec.extensions.datasets.statistic_errors import statistic_errors

_SIZES = {"chunks_size": 1000, "data_files_size_in_mb": 100, "video_files_size_in_mb": 200}
_COUNTS: dict[str, int] = {"total_episodes": 0, "total_frames": 0, "total_tasks": 0, **_SIZES}
"""Counts in info.json, and replacements for impossible values."""
_MAX_COUNT = 1e9
_DTYPES = frozenset(
    ("float32", "float64", "int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "bool", "string")
)
_MAX_RATE_ERROR = 0.1
"""Maximum relative difference between the timestamp step and 1/fps; measured jitter leaves the median within it."""
_MAX_VIDEO_ERROR = 0.01
_CODING = ("video.codec", "video.pix_fmt", "video.height", "video.width", "video.fps")

Repaired = tuple[DatasetInfo, list[str]]
"""Repaired info, and a sentence for each change."""


def stated_info(root: Path) -> Mapping[str, Any]:
    """Read info.json; ExportError if it is missing or damaged."""
    try:
        found = read_json(root / INFO_PATH)
    except (OSError, ValueError):
        found = None
    if not isinstance(found, dict):
        raise ExportError(f"{INFO_PATH} cannot be read, so rate and names are unknown: {root}")
    return found


def usable_info(stated: Mapping[str, Any], root: Path) -> DatasetInfo:
    """Parse info.json without impossible counts; ExportError if more of it is damaged."""
    data = dict(stated)
    for name, default in _COUNTS.items():
        value = data.get(name)
        if not isinstance(value, int | float) or not 0 < value < _MAX_COUNT:
            data[name] = default
    return DatasetInfo.from_json(data, root)


def repaired_features(info: DatasetInfo, tables: Sequence[Path], videos: Sequence[Path]) -> Repaired:
    """Correct the features by columns and videos. Raises ExportError if data files differ in a feature's type."""
    schemas = [open_table(path).schema_arrow for path in tables]
    features = dict(info.features)
    changes: list[str] = []
    for name in dict.fromkeys(name for schema in schemas for name in schema.names):
        found = _described(tables, schemas, name)
        if (feature := features.get(name)) is not None and (not feature.is_numeric and feature.dtype != "string"):
            continue
        if found is None:
            changes.append(f"The column {name} is left out: {schemas[0].field(name).type} is not a feature type.")
            continue
        if name in AUTOMATIC_FEATURES:
            if found.dtype != AUTOMATIC_FEATURES[name].dtype and not _is_precise(name, found):
                features.pop(name, None)
            continue
        if feature is None:
            changes.append(f"{name} becomes a feature: the rows have it as {found.dtype} of shape {found.shape}.")
            features[name] = found
        elif (feature.dtype, math.prod(feature.shape)) != (found.dtype, math.prod(found.shape)):
            changes.append(
                f"{name} is {found.dtype} of shape {found.shape} in the rows; info.json states {feature.dtype} of "
                f"shape {feature.shape}."
            )
            features[name] = DatasetFeature.from_json(
                {**feature.to_json(), "dtype": found.dtype, "shape": list(found.shape)}
            )
        if found.shape == (1,) and pa.types.is_nested(schemas[0].field(name).type):
            changes.append(f"{name} is a list of one value in the rows, and becomes that value.")
    cameras = {path.parent.name for path in videos} | {path.parent.parent.name for path in videos}
    for name, feature in list(features.items()):
        if feature.is_video and name not in cameras and cameras & set(info.video_keys):
            changes.append(f"{name} is left out: the dataset has no video for it.")
            del features[name]
        elif name not in AUTOMATIC_FEATURES and not feature.is_video and any(name not in s.names for s in schemas):
            changes.append(f"{name} is left out: no row has it.")
            del features[name]
        elif feature.names is None and feature.written_names:
            changes.append(f"The names of {name} are left out: they do not match its {feature.shape[0]} elements.")
            features[name] = replace(feature, written_names=None)
    for name, fixed in AUTOMATIC_FEATURES.items():
        own, there = features.get(name), all(name in schema.names for schema in schemas)
        is_right = own is not None and own.shape == fixed.shape and (own.dtype == fixed.dtype or _is_precise(name, own))
        if name in info.unlisted or not there or not is_right:
            changes.append(f"{name} is {fixed.dtype} of shape {fixed.shape}, in each row.")
        features[name] = fixed
    return replace(info, features=features), changes


def _is_precise(name: str, feature: DatasetFeature) -> bool:
    """Whether a feature has float64 timestamps, which LeRobot reads and edits keep."""
    return name == "timestamp" and feature.dtype == "float64"


def _described(tables: Sequence[Path], schemas: Sequence[pa.Schema], name: str) -> DatasetFeature | None:
    """Describe a column as a feature; None if it has neither numbers nor text."""
    kinds = {stored_dtype(schema.field(name).type) for schema in schemas if name in schema.names}
    if len(kinds) > 1:
        raise ExportError(
            f"The data files have {name} as {' and as '.join(sorted(kinds))}: leave it out first (demorec dataset "
            f"drop-features): {tables[0].parent.parent}"
        )
    (dtype,) = kinds
    path = next(path for path, schema in zip(tables, schemas, strict=True) if name in schema.names)
    first = next(table_batches(path, [name], rows=1), None)
    if dtype not in _DTYPES or first is None:
        return None
    shape = np.shape(first.column(0)[0].as_py()) or (1,)
    return DatasetFeature(dtype=dtype, shape=shape)  # type: ignore[arg-type]


def repaired_rate(info: DatasetInfo, table: Path, videos: Sequence[Path]) -> Repaired:
    """Set fps to the rate of timestamps and videos if these agree; ExportError if all three differ."""
    if "timestamp" not in open_table(table).schema_arrow.names:
        return info, []
    seconds = np.concatenate([column_numbers(batch.column(0))[:, 0] for batch in table_batches(table, ["timestamp"])])
    steps = np.diff(seconds.astype(np.float64))
    steps = steps[np.isfinite(steps) & (steps > 0)]
    step = float(np.median(steps)) if len(steps) else 1 / info.fps
    rate = round(1 / step)
    if abs(step * info.fps - 1) <= _MAX_RATE_ERROR or rate < 1:
        return info, []
    video_rate = _video_rate(videos)
    if video_rate is not None and abs(video_rate / info.fps - 1) <= _MAX_VIDEO_ERROR:
        return info, []  # then the timestamps are wrong
    if video_rate is not None and abs(video_rate * step - 1) > _MAX_RATE_ERROR:
        raise ExportError(
            f"The rate is ambiguous: info.json states {info.fps} frames per second, the timestamps {1 / step:.4g}, the "
            f"videos {video_rate:.4g}. Correct fps in meta/info.json: {table}"
        )
    return replace(info, fps=rate), [f"fps is {rate}, by the timestamps; info.json states {info.fps}."]


def _video_rate(videos: Sequence[Path]) -> float | None:
    """Images per second of the first readable video; None if there is none."""
    for path in videos:
        with suppress(ExportError):
            times = np.sort(mp4_index(path)[3])
            if len(times) > 1 and times[-1] > times[0]:
                return float((len(times) - 1) / (times[-1] - times[0]))
    return None


def repaired_cameras(folder: LeRobotFolder, images: Mapping[str, Sequence[tuple[Path, int]]]) -> Repaired:
    """Set size and encoding of each camera by its first video."""
    features = dict(folder.info.features)
    changes: list[str] = []
    for key in folder.info.video_keys:
        file, feature = folder.open_video(images[key][0][0]), features[key]
        size = (file.size[1], file.size[0])
        shape = feature.shape
        if size not in (shape[:2], shape[1:]):
            shape = (*size, 1 if feature.is_depth else 3)
            changes.append(
                f"{key} has images of {size[1]}x{size[0]} pixels; info.json states the shape {feature.shape}."
            )
        info = dict(feature.info or {})
        with suppress(ExportError):  # for a codec that recordings do not support, nothing more is known
            told = file.stream_info()
            wrong = [name for name in _CODING if info.get(name) not in (None, told[name])]
            for name in wrong:
                changes.append(f"{name} of {key} is {told[name]}; info.json states {info[name]}.")
                info[name] = told[name]
        features[key] = replace(feature, shape=shape, info=info or None)
    return replace(folder.info, features=features), changes


def table_changes(
    folder: LeRobotFolder, stated: Mapping[str, Any], stored: Mapping[int, EpisodePlace]
) -> Iterator[str]:
    """Yield a sentence for each kind of difference.

    Args:
        folder: The corrected dataset.
        stated: Its info.json, before the repair.
        stored: Episode index -> location in the table of episodes; empty if it is rewritten from the rows.
    """
    if stored and (wrong := _wrong_entries(folder, stored)):
        yield f"The table of episodes is written from the rows: entries of {shown(sorted(wrong))} are wrong or missing."
    yield from _tasks(folder, stated)
    counts = {"total_episodes": len(folder.listed), "total_frames": sum(place.length for place in folder.listed)}
    if not folder.info.is_old:
        counts |= {name: getattr(folder.info, name) for name in _SIZES}
    for name, count in counts.items():
        if stated.get(name) != count:
            yield f"info.json states {name} {stated.get(name)}; it is {count} now."
    if not kept_splits(folder, stated):
        yield f"info.json states the splits {stated.get('splits')}; train has all episodes now."
    if not folder.info.is_old or (folder.root / OLD_STATS).exists():
        yield from _statistics(folder)


def _wrong_entries(folder: LeRobotFolder, stored: Mapping[int, EpisodePlace]) -> set[int]:
    """Find the episodes whose entry in the table of episodes differs from rows and videos, or which have none."""
    wrong = {episode for _, episode, *_ in range_errors(folder)}
    for place in folder.listed:
        entry = stored.get(place.episode_index)
        if entry is None or replace(entry, tasks=place.tasks) != place or not set(place.tasks) <= set(entry.tasks):
            wrong.add(place.episode_index)
    return wrong | set(stored) - {place.episode_index for place in folder.listed}


def kept_splits(folder: LeRobotFolder, stated: Mapping[str, Any]) -> dict[str, str]:
    """Return the splits of info.json if they are disjoint ranges of the episodes, which keep their numbers; else {}."""
    try:
        splits = {str(name): str(text) for name, text in stated["splits"].items()}
        ranges = sorted(tuple(map(int, text.split(":"))) for text in splits.values())
    except (KeyError, AttributeError, ValueError):
        return {}
    count, ends = len(folder.listed), [0, *(end for each in ranges for end in each)]
    is_numbered = [place.episode_index for place in folder.listed] == list(range(count))
    is_possible = all(len(each) == 2 for each in ranges) and ends == sorted(ends) and ends[-1] <= count
    return splits if is_numbered and is_possible else {}


def _tasks(folder: LeRobotFolder, stated: Mapping[str, Any]) -> Iterator[str]:
    """Find a table of tasks that LeRobot reads wrongly, or not at all."""
    with suppress(ExportError):  # already a change
        count = len(read_tasks(folder.root))
        if not folder.info.is_old:
            table = read_table(folder.root / TASKS_PATH, ["task_index"])
            pandas = (open_table(folder.root / TASKS_PATH).schema_arrow.metadata or {}).get(b"pandas", b"{}")
            if table.column("task_index").to_pylist() != list(range(count)):
                yield "The table of tasks is numbered from 0, in order."
            elif not json.loads(pandas).get("index_columns"):
                yield "The table of tasks has the text as its index, where LeRobot looks for it."
        if stated.get("total_tasks") != count:
            yield f"info.json states total_tasks {stated.get('total_tasks')}; it is {count} now."


def _statistics(folder: LeRobotFolder) -> Iterator[str]:
    """Compare the statistics with the rows."""
    features = folder.info.features
    reader = folder.rows([name for name, feature in features.items() if feature.is_numeric])
    try:
        errors = list(statistic_errors(folder, {n: reader.numbers(place) for n, place in enumerate(folder.listed)}))
        stored = () if folder.info.is_old else tuple(folder.statistics)
    except ExportError as error:
        yield f"{STATS_PATH} is written from the rows: {without_path(error, folder.root)}"
        return
    wrong = dict.fromkeys(error.feature for error in errors)
    if not folder.info.is_old:
        wrong |= dict.fromkeys(name for name, feature in features.items() if feature.is_camera and name not in stored)
    if wrong:
        yield f"The statistics of {', '.join(wrong)} are computed from the rows and images."
