"""Inspection of a dataset: missing parts, values of each episode, stored types, and the content digest."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from demorec.core.errors import ExportError, describe_error, resource_error, without_path
from demorec.datasets.lerobot.files import check_tables, open_table, read_table, table_batches
from demorec.datasets.lerobot.layout import (
    AUTOMATIC_FEATURES,
    NUMBER_TYPES,
    STATS_PATH,
    DatasetInfo,
    FeatureType,
    combined_digest,
    episode_digest,
)
from demorec.datasets.lerobot.stats import NAMES, Statistics
from demorec.episode.info import EpisodeInfo
from demorec.episode.validity import read_episode_info
from demorec.extensions.datasets.episode_places import EpisodePlace, read_json_lines
from demorec.extensions.datasets.folder import LeRobotFolder
from demorec.extensions.datasets.rows import DataRows

OLD_STATS = "meta/episodes_stats.jsonl"
"""Statistics of each episode before v3.0."""
_SIDECAR = (
    "source", "success", "failure_phase", "failure_reason", "num_retries", "attempt", "run_episode_index", "root_seed",
)  # fmt: skip
"""Columns of the sidecar for selecting episodes."""
_DTYPE_NAMES = {"halffloat": "float16", "float": "float32", "double": "float64", "large_string": "string"}
"""Arrow's type names -> LeRobot's, if different."""


def recorded_info(row: Mapping[str, Any], root: Path) -> EpisodeInfo:
    """Parse the description of a simulated episode in its row of the sidecar; ExportError if it is damaged."""
    try:
        return read_episode_info(row["episode_info"])
    except (ValueError, KeyError, TypeError) as error:
        raise ExportError(f"The sidecar's episode_info cannot be used ({describe_error(error)}): {root}") from error


def dataset_problems(folder: LeRobotFolder) -> list[str]:
    """List missing, empty and truncated files, one sentence each; reads only the ends of files, which is fast. `demorec
    check` reads their whole content.
    """
    from demorec.extensions.datasets.mp4_index import check_video  # loads libav

    problems: list[str] = []
    places: Sequence[EpisodePlace] = ()
    with noted(problems, folder.root):
        places = folder.places
        problems += folder.notes
    for file, listed in folder.num_rows.items() if places else ():
        with noted(problems, folder.root):
            if (there := open_table(file).metadata.num_rows) != listed:
                raise ExportError(f"The data file has {there} rows, its episodes have {listed}: {file}")
    with noted(problems, folder.root):
        folder.tasks  # noqa: B018
    if not folder.info.is_old and not (folder.root / STATS_PATH).exists():
        problems.append(f"The statistics are missing: {STATS_PATH}")
    with noted(problems, folder.root):
        check_tables(folder.root)
    for video in sorted({video for place in places for video, _ in place.videos.values()}):
        with noted(problems, folder.root):
            check_video(video)
    return list(dict.fromkeys(problems))


def range_errors(folder: LeRobotFolder) -> Iterator[tuple[str, int, int, float | None]]:
    """Yield each range of rows or images in the table of episodes that does not fit the episode's length.

    Yields:
        Column of the range's end, number and length of the episode, and surplus frames; None for a missing column.
    """
    ranges = [("dataset_from_index", "dataset_to_index", 1)]
    for key in folder.info.video_keys:
        ranges.append((f"videos/{key}/from_timestamp", f"videos/{key}/to_timestamp", folder.info.fps))
    for path in folder.episode_tables:
        columns = open_table(path).schema_arrow.names
        for begin, end, unit in ranges:
            names = [begin, end] if end in columns else []
            for row in read_table(path, ["episode_index", "length", *names]).to_pylist():
                surplus = None if row.get(end) is None else (row[end] - row[begin]) * unit - row["length"]
                if surplus is None or not abs(surplus) < 0.5:
                    yield end, row["episode_index"], row["length"], surplus


@contextmanager
def noted(problems: list[str], root: Path) -> Iterator[None]:
    """Add an ExportError to the problems, without the dataset's own path. Lack of memory is not a problem of the
    dataset and is raised.
    """
    try:
        yield
    except ExportError as error:
        if (lack := resource_error(error)) is not None:
            raise lack from error
        problems.append(without_path(error, root))


def usable_numbers(folder: LeRobotFolder, rows: DataRows, place: EpisodePlace) -> dict[str, NDArray[Any]]:
    """Read feature -> (T, D) of an episode. Raises ExportError if it has no frames, or lacks integers."""
    if place.length == 0:
        raise ExportError(f"Episode {place.episode_index} has no frames: {folder.root}")
    columns = rows.numbers(place)
    for name, values in columns.items():
        if folder.info.features[name].dtype in ("int64", "bool") and values.dtype.kind not in "iub":
            raise ExportError(f"Episode {place.episode_index} lacks values of {name}: {folder.root}")
    return columns


def without_digest(info: DatasetInfo) -> list[str]:
    """Features without a content digest: all except video, numbers and text, including text in language columns."""
    return [name for name, feature in info.features.items() if feature.dtype == "image"]


def dataset_digest(path: Path) -> str:
    """SHA-256 (hex) of the content, read back from all files; equals `ExportReport.digest` of a new dataset. Raises
    ExportError if the dataset is damaged.
    """
    folder = LeRobotFolder(path)
    return combined_digest(folder.info, episode_digests(folder))


def episode_digests(folder: LeRobotFolder) -> list[str]:
    """Compute the digests of all episodes, in order, from all files."""
    rows = folder.rows(folder.columns)
    return [content_digest(folder, rows, place) for place in folder.places]


def content_digest(folder: LeRobotFolder, rows: DataRows, place: EpisodePlace) -> str:
    """Compute the digest of an episode from all columns and videos."""
    if unknown := without_digest(folder.info):
        raise ExportError(
            f"The content of {', '.join(unknown)} has no digest, because it is neither video nor numbers: {folder.root}"
        )
    columns = rows.numbers(place)
    task_index = columns["task_index"][0, 0] if len(columns["task_index"]) else -1
    if not 0 <= task_index < len(folder.tasks):  # NaN, the value of a null, is neither
        raise ExportError(f"Episode {place.episode_index} has no task: {folder.root}")
    return episode_digest(folder.tasks[int(task_index)], columns, video_digests(folder, place))


def video_digests(folder: LeRobotFolder, place: EpisodePlace) -> dict[str, str]:
    """SHA-256 (hex) of an episode's encoded images for each camera feature."""
    return {key: folder.video(key, place).digest() for key in folder.info.video_keys}


def episode_columns(folder: LeRobotFolder) -> list[dict[str, Any]]:
    """Read the values for selecting and sorting: name -> value, for each episode in order."""
    found = [
        {
            "episode_index": place.episode_index,
            "num_frames": place.length,
            "length": place.length,
            "duration_s": place.length / folder.info.fps,
            "task": "; ".join(place.tasks),
            "tasks": list(place.tasks),
        }
        for place in folder.places
    ]
    sidecar = {row["episode_index"]: row for row in folder.sidecar(_SIDECAR)}
    return [{**row, **sidecar.get(row["episode_index"], {})} for row in found]


def episode_statistics(folder: LeRobotFolder, features: Sequence[str]) -> Iterator[tuple[int, str, Mapping[str, Any]]]:
    """Yield (episode_index, feature, its available statistics in LeRobot's form)."""
    if folder.info.is_old:
        path = folder.root / OLD_STATS
        for line in read_json_lines(path) if path.exists() else ():
            stats, number = line.get("stats"), line.get("episode_index")
            if isinstance(stats, dict) and isinstance(number, int):
                yield from ((number, name, stats[name]) for name in features if isinstance(stats.get(name), dict))
        return
    for path in folder.episode_tables:
        there = open_table(path).schema_arrow.names
        quantities = {name: [key for key in NAMES if f"stats/{name}/{key}" in there] for name in features}
        columns = [f"stats/{name}/{key}" for name, keys in quantities.items() for key in keys]
        for batch in table_batches(path, ["episode_index", *columns]):
            for row in batch.to_pylist():
                for name, keys in quantities.items():
                    if keys:
                        yield row["episode_index"], name, {key: row[f"stats/{name}/{key}"] for key in keys}


def statistics_from_json(entry: Mapping[str, Any]) -> Statistics | None:
    """Inverse of `Statistics.to_json`; None if one of the ten is missing. Raises ValueError or TypeError if they are
    not numbers.
    """
    if any(name not in entry for name in NAMES):
        return None
    try:
        values = {name: np.asarray(entry[name], dtype=np.float64).reshape(-1) for name in NAMES if name != "count"}
        count = int(np.asarray(entry["count"]).reshape(-1)[0])
    except (IndexError, OverflowError) as error:
        raise ValueError("statistics that are not numbers") from error
    return Statistics(values=values, count=count, is_camera=np.asarray(entry["mean"]).ndim == 3)


def mistyped_features(source: LeRobotFolder) -> dict[str, FeatureType]:
    """Find numeric features whose type in the data files differs from info.json -> the files' type. If files differ, it
    is the type that holds all their numbers.
    """
    numeric = {name: feature for name, feature in source.info.features.items() if feature.is_numeric}
    stored: dict[str, set[str]] = {}
    for path in source.data_tables:
        schema = open_table(path).schema_arrow
        for name in numeric:
            if name in schema.names:
                stored.setdefault(name, set()).add(stored_dtype(schema.field(name).type))
    found: dict[str, FeatureType] = {}
    for name, dtypes in stored.items():
        if name in AUTOMATIC_FEATURES and name != "timestamp":
            continue
        if dtypes <= set(NUMBER_TYPES) and dtypes != {numeric[name].dtype}:
            found[name] = str(np.result_type(*dtypes))  # type: ignore[assignment]
    return found


def stored_dtype(column: pa.DataType) -> str:
    """Return LeRobot's name of the type in a column of numbers, texts, lists or arrays."""
    if isinstance(column, pa.BaseExtensionType):
        column = column.storage_type
    while pa.types.is_list(column) or pa.types.is_fixed_size_list(column) or pa.types.is_large_list(column):
        column = column.value_type
    return _DTYPE_NAMES.get(str(column), str(column))
