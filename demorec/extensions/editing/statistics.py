"""Differences between the statistics of two datasets, overall and by episode, and renamed features."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from demorec.datasets.lerobot.episode_records import episode_statistics
from demorec.datasets.lerobot.folder import LeRobotFolder
from demorec.datasets.lerobot.layout import STATS_PATH
from demorec.datasets.lerobot.stats import NAMES
from demorec.extensions.editing.compare import DiffEntry, Folders
from demorec.extensions.editing.content import TASK, Shared

_PLACES = ("index", "episode_index", "task_index")
_SAME = ("min", "max", "mean", "count")
"""Statistics that identify a renamed feature."""
_TOLERANCE = 1e-6
"""Relative to the larger value or the feature's range: some writers sum in float32, and in episode order."""


def renamed(a: LeRobotFolder, b: LeRobotFolder) -> dict[str, str]:
    """Features of A with another name in B: the same type, shape, elements and statistics."""
    gone = [name for name in a.info.features if name not in b.info.features]
    new = [name for name in b.info.features if name not in a.info.features]
    if not gone or not new:
        return {}
    tables = [_stats(source) for source in (a, b)]
    found: dict[str, str] = {}
    for name in gone:
        item, mine = a.info.features[name], tables[0].get(name)
        for other in new:
            theirs, there = tables[1].get(other), b.info.features[other]
            is_alike = (item.dtype, item.shape, item.names) == (there.dtype, there.shape, there.names)
            if other in found.values() or not is_alike or not isinstance(mine, dict) or not isinstance(theirs, dict):
                continue
            if all(_is_close(mine, theirs, key) for key in _SAME):
                found[name] = other
                break
    return found


def statistics_differences(
    sources: Folders, shared: Shared, found: Sequence[DiffEntry], *, is_reordered: bool
) -> Iterator[DiffEntry]:
    """Differences for features with equal rows and images; for others, different statistics are expected."""
    tables = [_stats(source) for source in sources]
    if any(not table and source.info.is_old for table, source in zip(tables, sources, strict=True)):
        return  # v2.1 has statistics for each episode only
    episodes = [item for item in found if item.level in ("episodes", "rows", "images") and item.episodes is not None]
    if any(item.name in ("missing", "extra", "length") and item.level == "episodes" for item in episodes):
        return
    differing = {item.name for item in episodes if item.level in ("rows", "images")}
    differing |= {item.name.partition(": ")[0] for item in found if item.level == "features"} - set(shared.names)
    tasks = [source.tasks for source in sources]
    if is_reordered:
        differing |= set(_PLACES)
    if tasks[0] != tasks[1] or TASK in differing:
        differing.add("task_index")
    for name in sources[0].info.features:
        other = shared.own(1, name)
        entries = [tables[0].get(name), tables[1].get(other)]
        if name in differing or other not in sources[1].info.features or entries == [None, None]:
            continue
        a, b = (entry if isinstance(entry, dict) else {} for entry in entries)
        wrong = [key for key in dict.fromkeys((*a, *b)) if not _is_close(a, b, key)]
        if wrong:
            yield DiffEntry(level="statistics", name=name, details={"of": wrong},
                             text=f"{name} differs in {', '.join(wrong)}: {_worst(a, b, wrong[0])}")  # fmt: skip


def episode_statistics_differences(
    sources: Folders, shared: Shared, found: Sequence[DiffEntry], pairs: Mapping[int, int]
) -> Iterator[DiffEntry]:
    """Differences for each episode in the table of episodes, for features with equal rows or images."""
    if any(source.info.is_old for source in sources):
        return
    differing = {(item.name, item.episodes) for item in found if item.level in ("rows", "images")}
    cut = {item.episodes for item in found if item.level == "episodes" and item.name == "length"}
    for name in (*shared.columns, *shared.cameras):
        if name in _PLACES:
            continue
        tables = [_of_episodes(source, shared.own(side, name)) for side, source in enumerate(sources)]
        if not tables[0] or not tables[1]:
            if tables[0] or tables[1]:
                text = f"{name} has statistics of all its episodes only in {'B' if tables[1] else 'A'}"
                yield DiffEntry(level="statistics", name=name, text=text)
            continue
        wrong = [
            (n, m, keys)
            for n, m in pairs.items()
            if (name, (n, m)) not in differing and (n, m) not in cut
            if (keys := [key for key in NAMES if not _is_close(tables[0][n], tables[1][m], key)])
        ]
        if wrong:
            n, m, keys = wrong[0]
            shown = _worst(tables[0][n], tables[1][m], keys[0])
            text = f"{name} of {len(wrong)} of {len(pairs)} episodes, in episode {n} {', '.join(keys)}: {shown}"
            of = [key for key in NAMES if any(key in keys for _, _, keys in wrong)]
            yield DiffEntry(level="statistics", name=name, text=text,
                             details={"of": of, "episodes": [[n, m] for n, m, _ in wrong]})  # fmt: skip


def _of_episodes(source: LeRobotFolder, name: str) -> list[Mapping[str, Any]]:
    """Statistics of a feature by episode in order; empty unless each episode has all ten."""
    found = [entry for _, _, entry in episode_statistics(source, [name])]
    return found if len(found) == len(source.places) else []


def _stats(source: LeRobotFolder) -> Mapping[str, Any]:
    return source.statistics if (source.root / STATS_PATH).exists() else {}


def _is_close(a: Mapping[str, Any], b: Mapping[str, Any], key: str) -> bool:
    try:
        x, y = (np.asarray(entry[key], dtype=np.float64).ravel() for entry in (a, b))
        low, high = (np.asarray(a.get(name, 0.0), dtype=np.float64).ravel() for name in ("min", "max"))
        scale = np.maximum(np.maximum(np.abs(x), np.abs(y)), np.abs(high - low))
        near = (np.abs(x - y) <= _TOLERANCE * scale) | (np.isnan(x) & np.isnan(y)) | (x == y)
        return x.shape == y.shape and bool(near.all())
    except (KeyError, ValueError, TypeError):
        return False


def _worst(a: Mapping[str, Any], b: Mapping[str, Any], key: str) -> str:
    """The statistic of the element that differs most, in words."""
    try:
        x, y = (np.asarray(entry[key], dtype=np.float64).ravel() for entry in (a, b))
        place = int(np.nan_to_num(np.abs(x - y), nan=np.inf).argmax())
        return f"{key}{f'[{place}]' if x.size > 1 else ''} is {x[place]:.7g}, in B {y[place]:.7g}"
    except (KeyError, ValueError, TypeError, IndexError):
        shown = ["not there" if key not in entry else str(entry[key])[:80] for entry in (a, b)]
        return f"{key} is {shown[0]}, in B {shown[1]}"
