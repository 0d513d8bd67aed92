"""Checks of a LeRobot dataset's files: tables and videos against each other and against info.json."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from demorec.check.base import Fault, NotApplicableError, Severity, check
from demorec.datasets.lerobot.files import open_table, read_table
from demorec.datasets.lerobot.layout import AUTOMATIC_FEATURES, TASKS_PATH, VIDEO_PATH, DatasetFeature
from demorec.extensions.datasets.folder import LeRobotFolder
from demorec.extensions.datasets.inspect import noted, range_errors, stored_dtype
from demorec.extensions.datasets.videos import opened_video
from demorec.extensions.doctor.evidence import DROP, REPAIR, Evidence

_STATED_TYPES = ("float32", "float64", "int64", "bool", "string")
"""Types of info.json that are compared with the columns."""
_PRECISE = ("timestamp", "float64")
"""A counter that may be more precise than LeRobot's own."""
_BY_HAND = "correct it in meta/info.json"
_RATE_TOLERANCE = 0.01
"""Relative tolerance of rates: concatenated files have slightly different ones."""
_LEAVE_CAMERA_OUT = "restore its videos, or leave it out: demorec dataset drop-features {path} CAMERA --out NEW"


def folder_of(evidence: Evidence) -> LeRobotFolder:
    """Return the open dataset. Raises NotMeasuredError for recordings."""
    if evidence.folder is None:
        raise NotApplicableError("recordings have separate checks of their files' integrity")
    return evidence.folder


@check(
    family="files",
    needs="a LeRobot dataset",
    measures="episodes with unreadable rows",
    unit="episodes",
    why="Training ends with an error, or reads rows of another episode.",
    do="download or record it again, or drop the episode: " + DROP,
)
def unreadable_episodes(evidence: Evidence) -> Iterator[Fault]:
    """Read every row of every episode, and verify by its own numbers that it belongs there."""
    folder = folder_of(evidence)
    remedy = "" if evidence.episodes else "download the tables again"  # nothing would be left
    reasons: dict[str, list[int]] = {}
    for number, reason in evidence.unreadable.items():
        reasons.setdefault(reason, []).append(number)
    for reason, numbers in reasons.items():
        for number in numbers:
            yield Fault(severity="broken", episode=number, message=reason, value="1 episode", do=remedy)
    if evidence.robot_problem:
        yield Fault(severity="broken", message=evidence.robot_problem, do="restore the folder demorec/robots")
    for number, note in enumerate(folder.notes):
        # Without the table of episodes LeRobot opens nothing; with a wrong one it reads other rows.
        severity: Severity = "broken" if number == 0 and folder.is_found_by_rows else "look"
        remedy = REPAIR if "dataset repair" in note else _LEAVE_CAMERA_OUT
        yield Fault(severity=severity, message=note, do=remedy)
    are_all_read = len(evidence.episodes) == folder.info.total_episodes  # then only a counter is wrong
    if (missing := folder.missing) and not are_all_read:
        yield Fault(
            severity="broken", message=missing.partition(": /")[0], do=f"complete it, or keep the intact part: {REPAIR}"
        )
    if not folder.listed:
        yield Fault(
            severity="broken", message="the table of episodes is empty", do="finalize the recording: dataset.finalize()"
        )


@check(
    family="files",
    needs="a LeRobot dataset",
    measures="counters and indices that contradict",
    unit="contradictions",
    why="LeRobot looks up rows and images by these numbers: it finds wrong ones, or none.",
    do=REPAIR,
)
def contradicting_counts(evidence: Evidence) -> Iterator[Fault]:
    """Compare totals with the tables; indices must be consecutive, and tasks must match the episodes' table."""
    folder = folder_of(evidence)
    info = folder.info
    totals = {
        "total_episodes": (info.total_episodes, len(folder.listed)),
        "total_frames": (info.total_frames, sum(place.length for place in folder.listed)),
        "total_tasks": (info.total_tasks, len(folder.tasks)),
    }
    for name, (stated, found) in totals.items():
        if stated != found:
            yield Fault(severity="broken", value=str(found), message=f"info.json states {name} {stated}, found {found}")
    start = 0
    for number, place in enumerate(folder.listed):
        if place.episode_index != number or place.from_index != start:
            yield Fault(
                severity="broken",
                episode=place.episode_index,
                message=f"the table of episodes has it at row {place.from_index}, expected {start}",
            )
        if (episode := evidence.by_number.get(place.episode_index)) is not None:
            absent = [name for name in ("index", "episode_index", "frame_index") if name not in episode.columns]
            if absent:
                yield Fault(severity="look", episode=number, message=f"its rows have no {', '.join(absent)}")
            wrong = _wrong_indices(episode.columns, number, start)
            if wrong:
                yield Fault(severity="broken", episode=number, message=f"its {', '.join(wrong)} does not count up")
            if (fault := _wrong_task(folder, place.tasks, episode.columns, number)) is not None:
                yield fault
        start += place.length
    if not info.is_old:
        numbers = read_table(evidence.path / TASKS_PATH, ["task_index"]).column("task_index").to_pylist()
        if numbers != list(range(len(numbers))):  # LeRobot takes the row at this index, regardless of its number
            yield Fault(severity="broken", message="the tasks' numbers do not count up in meta/tasks.parquet")
        yield from _wrong_ranges(folder)
        yield from _surplus_rows(folder)
    yield from _other_paths(folder)


def _other_paths(folder: LeRobotFolder) -> Iterator[Fault]:
    """Find files that demorec finds by their names, but not where info.json states them."""
    info = folder.info
    stated = dict.fromkeys(info.video_keys, info.video_path or VIDEO_PATH) | {"": info.data_path}
    for key, template in stated.items():
        expected = re.compile(re.sub(r"\\{.*?\\}", ".+", re.escape(template)))
        paths = [place.videos[key][0] if key else place.data for place in folder.listed]
        names = [path.relative_to(folder.root).as_posix() for path in dict.fromkeys(paths) if path.exists()]
        if other := [name for name in names if not expected.fullmatch(name)]:
            yield Fault(
                severity="broken",
                value=f"{len(other)} files",
                message=f"info.json has {key or 'the rows'} in {template}, found {other[0]}",
                do=_BY_HAND,
            )


def _wrong_indices(columns: Mapping[str, Any], number: int, start: int) -> list[str]:
    length = len(next(iter(columns.values())))
    count = np.arange(length)
    expected = {"index": start + count, "episode_index": np.full(length, number), "frame_index": count}
    return [
        name
        for name, values in expected.items()
        if name in columns and not np.array_equal(columns[name].reshape(-1), values)
    ]


def _wrong_task(folder: LeRobotFolder, tasks: tuple[str, ...], columns: Mapping[str, Any], number: int) -> Fault | None:
    """Compare tasks; the table of episodes may also list those to which GR00T's annotations refer."""
    if "task_index" not in columns:
        return Fault(severity="broken", episode=number, message="its rows have no task_index")
    names = _task_names(folder, columns["task_index"])
    annotations = [values for name, values in columns.items() if name.startswith("annotation.")]
    numbers = [values for values in annotations if values.dtype.kind in "iu"]
    if names <= set(tasks) <= names.union(*(_task_names(folder, values) for values in numbers)):
        return None
    stated, found = (", ".join(map(repr, sorted(each))) for each in (tasks, names))
    return Fault(
        severity="broken",
        episode=number,
        message=f"its rows have the task {found[:120]}, the table of episodes {stated[:120]}",
    )


def _task_names(folder: LeRobotFolder, numbers: NDArray[np.integer[Any]]) -> set[str]:
    tasks = folder.tasks
    return {tasks[index] if 0 <= index < len(tasks) else f"number {index}" for index in np.unique(numbers).tolist()}


def _wrong_ranges(folder: LeRobotFolder) -> Iterator[Fault]:
    last_frames = Counter[str]()
    for end, episode, length, surplus in range_errors(folder):
        if end != "dataset_to_index" and surplus is not None and -1.5 < surplus < -0.5:
            last_frames[end] += 1
        elif surplus is not None:
            yield Fault(
                severity="broken",
                episode=episode,
                message=f"{end} of the table of episodes does not fit its {length} frames",
            )
    for end, count in last_frames.items():  # training looks up images from the start of an episode alone
        yield Fault(
            severity="look",
            value=f"{count} episodes",
            message=f"{end} of {count} episodes is the time of the last frame; LeRobot's edits would lose this frame",
            do=REPAIR,
        )


def _surplus_rows(folder: LeRobotFolder) -> Iterator[Fault]:
    """Find rows that belong to no episode in the episodes' files."""
    for file, listed in folder.num_rows.items():
        found = open_table(file).metadata.num_rows if file.exists() else listed
        if listed != found:
            yield Fault(
                severity="broken",
                value=f"{found - listed} rows",
                message=f"{file.name} has {found} rows, {listed} of them belong to episodes",
            )


@check(
    family="files",
    needs="a LeRobot dataset",
    measures="columns that differ from info.json",
    unit="columns",
    why="Readers convert or refuse other types: numbers lose digits, or training does not start.",
    do=REPAIR,
)
def table_schema(evidence: Evidence) -> Iterator[Fault]:
    """Compare columns, types and shapes of the data files with info.json, and the counters with LeRobot's own."""
    folder = folder_of(evidence)
    features = {name: feature for name, feature in folder.info.features.items() if not feature.is_video}
    for name, fixed in AUTOMATIC_FEATURES.items():
        found = features.get(name)
        if found is None:
            yield Fault(severity="look", message=f"{name} is not in info.json, where LeRobot expects it")
        elif found.shape != fixed.shape or (found.dtype != fixed.dtype and (name, found.dtype) != _PRECISE):
            yield Fault(severity="broken", message=f"{name} is not stated as {fixed.dtype} of shape {fixed.shape}")
    seen: set[str] = set()
    unlisted = folder.info.unlisted
    for path in filter(Path.exists, folder.num_rows):
        for severity, message in _column_faults(path, features, unlisted):
            if message not in seen:
                seen.add(message)
                yield Fault(severity=severity, message=f"{message} ({path.name})")  # type: ignore[arg-type]


def _column_faults(
    path: Path, features: Mapping[str, DatasetFeature], unlisted: Sequence[str]
) -> Iterator[tuple[str, str]]:
    schema = open_table(path).schema_arrow
    columns = set(schema.names)
    may_lack = {"frame_index"} & set(unlisted)  # LeRobot never reads it
    if missing := sorted(features.keys() - columns - may_lack):
        yield "broken", f"info.json has {', '.join(missing)}, the table does not"
    if surplus := sorted(columns - features.keys()):
        yield "look", f"the table has {', '.join(surplus)}, info.json does not"
    for name in sorted(columns & features.keys()):
        kind, feature = schema.field(name).type, features[name]
        fit = _fits(kind, feature)
        if name in AUTOMATIC_FEATURES and pa.types.is_floating(kind):
            fit = "equal" if fit == "equal" else "converts"  # only whole numbers can be read
        if fit != "equal":
            severity = "look" if fit == "converts" else "broken"
            yield severity, f"{name} is {kind}, and info.json states {feature.dtype} of shape {feature.shape}"


def _fits(found: pa.DataType, feature: DatasetFeature) -> str:
    """Return "equal", "converts" if readers convert it without loss of meaning, or "other"."""
    if feature.dtype not in _STATED_TYPES:
        return "equal"  # images in tables, as other writers store them
    column, size = found, 1
    while pa.types.is_fixed_size_list(column):
        column, size = column.value_type, size * column.list_size
    if column != found and size != math.prod(feature.shape):
        return "other"
    stored = stored_dtype(found)
    if stored == feature.dtype:
        return "equal"
    kinds = {name.lstrip("u").rstrip("0123456789") for name in (stored, feature.dtype)}
    return "converts" if kinds in ({"float"}, {"int"}) else "other"


@check(
    family="files",
    needs="videos",
    measures="videos that differ from info.json",
    unit="files",
    why="Readers expect the stated size and rate: images are resized, shifted, or refused.",
    do=REPAIR,
)
def video_format(evidence: Evidence) -> Iterator[Fault]:
    """Compare size, rate, codec and sound of each video file with info.json, and info.json with itself."""
    folder = folder_of(evidence)
    if not folder.info.video_keys:
        raise NotApplicableError("the dataset has no videos")
    for key in folder.info.video_keys:
        feature = folder.info.features[key]
        stated = _stated_format(feature)
        found: dict[tuple[str, Any], list[str]] = {}
        for path in dict.fromkeys(place.videos[key][0] for place in folder.listed):
            for quantity, value in _found_format(path, folder).items():
                found.setdefault((quantity, value), []).append(path.name)
        for (quantity, value), names in found.items():
            files = names[0] + (f" and {len(names) - 1} more" if len(names) > 1 else "")
            if quantity == "fps" and abs(value - folder.info.fps) > _RATE_TOLERANCE * folder.info.fps:
                yield Fault(
                    severity="broken",
                    message=f"{key}: the rate of {files} is {value:.4g} fps, info.json states {folder.info.fps}",
                    do="set fps of meta/info.json to the recorded rate, or encode the video again",
                )
            elif quantity in stated and stated[quantity] != value:
                yield Fault(
                    severity="broken" if quantity in ("height", "width") else "look",
                    message=f"{key}: {quantity} of {files} is {value}, info.json states {stated[quantity]}",
                    do=_BY_HAND if quantity == "sound" else "",
                )
        yield from _info_against_itself(key, feature, folder)


def _stated_format(feature: DatasetFeature) -> dict[str, Any]:
    info = feature.info or {}
    width, height = feature.image_size
    found: dict[str, Any] = {"height": height, "width": width}
    found |= {name: info[f"video.{name}"] for name in ("codec", "pix_fmt") if info.get(f"video.{name}")}
    return found | ({"sound": info["has_audio"]} if isinstance(info.get("has_audio"), bool) else {})


def _found_format(path: Path, folder: LeRobotFolder) -> dict[str, Any]:
    """Read quantity -> value of a video file; empty if it is unreadable, which `undecodable_images` finds."""
    found: dict[str, Any] = {}
    with noted([], folder.root), opened_video(path) as (container, stream):
        context = stream.codec_context
        codec = {"libdav1d": "av1"}.get(context.name, context.name)
        found = {"height": context.height, "width": context.width, "pix_fmt": context.pix_fmt, "codec": codec}
        found["sound"] = bool(container.streams.audio)
        found["fps"] = float(stream.average_rate or 0)
    return found


def _info_against_itself(key: str, feature: DatasetFeature, folder: LeRobotFolder) -> Iterator[Fault]:
    info, (width, height) = feature.info or {}, feature.image_size
    if feature.is_depth and feature.num_channels != 1:
        message = f"{key} is a depth map of {feature.num_channels} channels in info.json"
        yield Fault(severity="broken", message=message, do=_BY_HAND)
    for quantity, value in (("height", height), ("width", width), ("channels", feature.num_channels)):
        if info.get(f"video.{quantity}", value) != value:
            yield Fault(
                severity="look",
                message=f"{key}: info.json has video.{quantity} {info[f'video.{quantity}']} and the shape {value}",
                do=_BY_HAND if quantity == "channels" else "",
            )
    if info.get("video.fps", folder.info.fps) != folder.info.fps:
        yield Fault(
            severity="look", message=f"{key}: info.json has video.fps {info['video.fps']}, fps {folder.info.fps}"
        )


@check(
    family="files",
    needs="videos",
    measures="images before, between or after episodes",
    unit="images",
    why="Row and image counts disagree: one of the two is shifted against the other.",
    do="encode the videos of the episodes again from their images",
)
def video_places(evidence: Evidence) -> Iterator[Fault]:
    """Check that every episode's encoded images are consecutive in every camera's file.

    An episode may be preceded by images since the keyframe that its first one needs.
    """
    folder = folder_of(evidence)
    if not folder.info.video_keys:
        raise NotApplicableError("the dataset has no videos")
    for key in folder.info.video_keys:
        if evidence.cameras and key not in evidence.cameras and not folder.info.features[key].is_depth:
            yield Fault(severity="look", message=f"the videos of {key} are missing", do="download it")
            continue
        ends: dict[Path, int] = {}
        is_here = any(place.videos[key][0].exists() for place in folder.listed)
        for place in folder.listed:
            path, first = place.videos[key]
            end, ends[path] = ends.get(path, 0), first + place.length
            problems: list[str] = []
            with noted(problems, evidence.path):
                if first not in (end, end + folder.video(key, place).lead):
                    yield Fault(
                        severity="broken",
                        episode=place.episode_index,
                        value=f"{first - end:+d} images",
                        message=f"{key} starts at image {first} of {path.name}, the episode before ends at {end}",
                    )
            if problems and not evidence.cameras and is_here:
                yield Fault(severity="broken", episode=place.episode_index, message=f"{key}: {problems[0]}")


@check(
    family="files",
    needs="a LeRobot dataset",
    measures="files that nothing refers to",
    unit="files",
    why="They enlarge the disk usage and the download; merges, deleted episodes and renamed cameras leave them behind.",
    do=REPAIR,
)
def unused_files(evidence: Evidence) -> Iterator[Fault]:
    """Find video and data files that no episode uses."""
    folder = folder_of(evidence)
    used = {path for place in folder.listed for path, _ in place.videos.values()}
    videos = set((evidence.path / "videos").rglob("*.mp4")) - used
    tables = set((evidence.path / "data").rglob("*.parquet")) - set(folder.num_rows)
    if videos:
        yield Fault(severity="look", value=f"{len(videos)} files", message=_unused(evidence.path, videos))
    if tables:
        message = f"{_unused(evidence.path, tables)}; LeRobot reads all tables in data, and then finds other rows"
        yield Fault(severity="broken", value=f"{len(tables)} files", message=message)


def _unused(root: Path, files: Collection[Path]) -> str:
    more = f" and {len(files) - 1} more" if len(files) > 1 else ""
    return f"no episode uses {min(files).relative_to(root).as_posix()}{more}"
