"""Differences between a dataset's tables, counts and statistics and its rows."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any

from demorec.core.errors import ExportError, without_path
from demorec.datasets.lerobot.episode_places import EpisodePlace, read_tasks
from demorec.datasets.lerobot.files import open_table, read_table
from demorec.datasets.lerobot.folder import LeRobotFolder
from demorec.datasets.lerobot.inspect import OLD_STATS, range_errors
from demorec.datasets.lerobot.layout import STATS_PATH, TASKS_PATH, FilePosition
from demorec.datasets.lerobot.statistic_errors import statistic_errors


def table_changes(
    folder: LeRobotFolder, stated: Mapping[str, Any], stored: Mapping[int, EpisodePlace]
) -> Iterator[str]:
    """Yield a sentence for each kind of difference.

    Args:
        folder: The corrected dataset.
        stated: Its info.json, before the repair.
        stored: Episode index -> location in the table of episodes; empty if it is rewritten from the rows.
    """
    if stored:
        yield from _places(folder, stored)
        yield from _ends(folder)
    yield from _paths(folder)
    yield from _tasks(folder, stated)
    yield from _totals(folder, stated)
    yield from _strays(folder)
    if not folder.info.is_old or (folder.root / OLD_STATS).exists():
        yield from _statistics(folder)


def _places(folder: LeRobotFolder, stored: Mapping[int, EpisodePlace]) -> Iterator[str]:
    wrong: dict[str, int] = {}
    for place in folder.listed:
        told = stored.get(place.episode_index)
        if told is None:
            found = {"an entry": True}
        else:
            found = {
                "length": told.length != place.length,
                "the data file": (told.data, told.first_row) != (place.data, place.first_row),
                "dataset_from_index": told.from_index != place.from_index,
                "tasks": set(told.tasks) != set(place.tasks) and bool(place.tasks),
                **{f"the images of {key}": told.videos[key] != place.videos[key] for key in place.videos},
            }
        for name in (name for name, is_wrong in found.items() if is_wrong):
            wrong[name] = wrong.get(name, 0) + 1
    for name, count in wrong.items():
        yield f"The table of episodes gets {name} of {count} of {len(folder.listed)} episodes from the rows."
    if gone := sorted(set(stored) - {place.episode_index for place in folder.listed}):
        yield f"The table of episodes loses {len(gone)} episodes that have no rows, such as episode {gone[0]}."


def _ends(folder: LeRobotFolder) -> Iterator[str]:
    for name, count in Counter(name for name, *_ in range_errors(folder)).items():
        yield f"The table of episodes gets {name} of {count} of {len(folder.listed)} episodes from the rows."


def _paths(folder: LeRobotFolder) -> Iterator[str]:
    """Find path templates of info.json without files; before v3.0, because the repair writes the usual ones."""
    last, info = folder.listed[-1], folder.info
    position = FilePosition(chunk=last.episode_index // int(info.chunks_size), file=last.episode_index)
    paths = {folder.root / position.path(info.data_path): last.data}
    paths |= {folder.root / position.path(info.video_path or "", key): path for key, (path, _) in last.videos.items()}
    if info.is_old and any(path != found for path, found in paths.items()):
        yield "info.json names missing files: the paths are now those of v3.0."


def _tasks(folder: LeRobotFolder, stated: Mapping[str, Any]) -> Iterator[str]:
    try:
        tasks = read_tasks(folder.root)
        numbers = list(range(len(tasks)))
        if not folder.info.is_old:
            numbers = read_table(folder.root / TASKS_PATH, ["task_index"]).column("task_index").to_pylist()
    except ExportError:
        return  # already a change
    if numbers != list(range(len(numbers))):
        yield "The table of tasks is numbered from 0, in order."
    elif not folder.info.is_old:
        pandas = (open_table(folder.root / TASKS_PATH).schema_arrow.metadata or {}).get(b"pandas", b"{}")
        if not json.loads(pandas).get("index_columns"):
            yield "The table of tasks has the text as its index, where LeRobot looks for it."
    total = stated.get("total_tasks")
    if total != len(numbers):
        yield f"info.json states total_tasks {total}; the table of tasks has {len(numbers)}."


def _totals(folder: LeRobotFolder, stated: Mapping[str, Any]) -> Iterator[str]:
    found = {
        "total_episodes": len(folder.listed),
        "total_frames": sum(place.length for place in folder.listed),
    }
    for name, count in found.items():
        if stated.get(name) != count:
            yield f"info.json states {name} {stated.get(name)}; the rows have {count}."
    for name in ("chunks_size", "data_files_size_in_mb", "video_files_size_in_mb"):
        usual = getattr(folder.info, name)
        if not folder.info.is_old and stated.get(name) != usual:
            yield f"info.json states {name} {stated.get(name)}; it is {usual} now."
    if not has_possible_splits(stated.get("splits"), len(folder.listed)):
        yield f"splits of info.json are one, train, of all {len(folder.listed)} episodes."


def has_possible_splits(splits: Any, episodes: int) -> bool:
    """Whether splits are disjoint ranges of the episodes."""
    if not isinstance(splits, dict) or not splits:
        return False
    try:
        ranges = sorted(tuple(int(end) for end in text.split(":")) for text in splits.values())
    except (ValueError, AttributeError):
        return False
    ends = [0, *(end for each in ranges for end in each)]
    return all(len(each) == 2 for each in ranges) and ends == sorted(ends) and ends[-1] <= episodes


def _strays(folder: LeRobotFolder) -> Iterator[str]:
    used = {path for place in folder.listed for path, _ in place.videos.values()}
    for path in sorted(set((folder.root / "videos").rglob("*.mp4")) - used):
        yield f"{path.relative_to(folder.root).as_posix()} is left out: no episode has images in it."


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
    wrong = list(dict.fromkeys(error.feature for error in errors if error.episode is None))
    if not folder.info.is_old:
        wrong += [name for name, feature in features.items() if feature.is_camera and name not in stored]
    if wrong:
        yield f"{STATS_PATH} gets the statistics of {', '.join(wrong)} from the rows and images."
    if own := {error.episode for error in errors if error.episode is not None}:
        yield f"The statistics of {len(own)} episodes are computed from their rows."
    if unknown := [name for name in stored if name not in features]:
        yield f"{STATS_PATH} loses {', '.join(unknown)}, which is not a feature."


def stated_splits(folder: LeRobotFolder, stated: Mapping[str, Any]) -> Mapping[str, str] | None:
    """The splits in info.json, if they are possible and the episodes keep their numbers."""
    splits = stated.get("splits")
    is_kept = [place.episode_index for place in folder.listed] == list(range(len(folder.listed)))
    return splits if is_kept and has_possible_splits(splits, len(folder.listed)) else None
