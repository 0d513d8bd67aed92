"""Differences between two LeRobot datasets, level by level.

The position of episodes does not count: their order, files, format version and task numbers. Episodes are matched by
content (`episode_content.py`), and those that are not bit-exact are compared row by row and image by image.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from demorec.core.plain import listed
from demorec.datasets.lerobot.depth import LARGEST_CODE
from demorec.datasets.lerobot.episode_records import episode_columns
from demorec.datasets.lerobot.folder import LeRobotFolder
from demorec.datasets.lerobot.layout import STATS_PATH
from demorec.datasets.options import ProgressCallback
from demorec.extensions.editing.episode_content import (
    TASK,
    ContentReader,
    EpisodeContent,
    matched,
    numbers_in,
    shared_features,
)

Level = Literal["info", "features", "tasks", "episodes", "rows", "images", "statistics"]
LEVELS: tuple[Level, ...] = ("info", "features", "tasks", "episodes", "rows", "images", "statistics")
_OF_CONTENT = ("episodes", "rows", "images")
"""Levels on which a difference makes two episodes different."""
_STORAGE = ("version", "chunks_size", "data_files_size_in_mb", "video_files_size_in_mb", "data_path", "video_path")
_OLD_TOTALS = ("total_chunks", "total_videos")
_COMPARED_ELSEWHERE = frozenset(("episode_index", "num_frames", "length", "duration_s", "task"))
"""Columns of episodes that follow from their rows."""
_OTHER_ROWS = ("missing", "extra", "length")
"""Names of differences between episodes that change the rows of the whole dataset."""
_POSITIONS = frozenset(("index", "episode_index", "task_index"))
_TOLERANCE = 1e-6
"""Of statistics, relative to the larger value or the feature's range: some writers sum in float32, by episode."""
_MAX_TEXT = 120

Pair = tuple[int | None, int | None]
"""Numbers of an episode in A and in B; None if it is missing there."""


@dataclass(frozen=True, kw_only=True)
class DiffEntry:
    """A difference between datasets A and B.

    Attributes:
        level: Level of the difference.
        name: Name of the field, feature or task.
        text: Description of the difference.
        episodes: The episodes that have it; empty if it concerns the whole dataset.
    """

    level: Level
    name: str
    text: str
    episodes: tuple[Pair, ...] = ()

    @property
    def line(self) -> str:
        """The difference as a line of text."""
        if not self.episodes or None in self.episodes[0]:
            return f"{self.level}: {self.text}"
        numbers = [f"{a}{'' if a == b else f' (in B {b})'}" for a, b in self.episodes]
        return f"{self.level}: episode{'s' * (len(numbers) > 1)} {listed(numbers, 8, ', ')}: {self.text}"

    def to_json(self) -> dict[str, Any]:
        """The difference as plain data."""
        episodes = [list(pair) for pair in self.episodes]
        return {"level": self.level, "name": self.name, "text": self.text, "episodes": episodes}


@dataclass(frozen=True, kw_only=True)
class DatasetDiff:
    """Result of a comparison.

    Attributes:
        pairs: Number of an episode in A -> its number in B.
        num_episodes: Number of episodes in A and in B.
        differences: Differences sorted by level.
        notes: Differences that do not count: order, and storage.
    """

    pairs: Mapping[int, int]
    num_episodes: tuple[int, int]
    differences: tuple[DiffEntry, ...]
    notes: tuple[str, ...]

    @property
    def is_same(self) -> bool:
        """Whether nothing differs."""
        return not self.differences

    @property
    def is_reordered(self) -> bool:
        """Whether episodes in both datasets have another order."""
        others = list(self.pairs.values())
        return others != sorted(others)

    @property
    def num_same(self) -> int:
        """Number of pairs with equal rows and images."""
        different = {pair for item in self.differences if item.level in _OF_CONTENT for pair in item.episodes}
        return len(set(self.pairs.items()) - different)

    def to_json(self) -> dict[str, Any]:
        """The result as plain data."""
        return {
            "same": self.is_same,
            "reordered": self.is_reordered,
            "episodes_a": self.num_episodes[0],
            "episodes_b": self.num_episodes[1],
            "episodes_same": self.num_same,
            "pairs": [[a, b] for a, b in self.pairs.items()],
            "differences": [difference.to_json() for difference in self.differences],
            "notes": list(self.notes),
        }


def diff(a: Path, b: Path, progress: ProgressCallback | None = None) -> DatasetDiff:
    """Compare two datasets of v2.0 to v3.0; holds one episode in memory, and some numbers for each.

    Raises:
        ExportError: A dataset is damaged.
    """
    sources = (LeRobotFolder(a), LeRobotFolder(b))
    readers = [ContentReader(source, shared_features(*sources)) for source in sources]
    contents: list[list[EpisodeContent]] = [[], []]
    total = sum(len(source.places) for source in sources)
    for found, reader in zip(contents, readers, strict=True):
        for number in range(len(reader.source.places)):
            found.append(reader.content(number))
            if progress is not None:
                progress(sum(map(len, contents)), total)
    pairs = matched(contents, readers)
    entries = [*_info(*sources), *_features(*sources), *_unmatched(contents, pairs), *_unused_tasks(*sources)]
    for n, m in pairs.items():
        one, other = contents[0][n], contents[1][m]
        if one != other or not one.is_known:
            entries += _episode(readers, (n, m), (one, other))
    entries += _episode_columns(sources, pairs, contents)
    entries += _statistics(sources, entries)
    entries.sort(key=lambda item: LEVELS.index(item.level))
    result = DatasetDiff(
        pairs=pairs, num_episodes=(len(contents[0]), len(contents[1])), differences=tuple(_joined(entries)), notes=()
    )
    return replace(result, notes=tuple(_notes(sources, result)))


def _joined(entries: Sequence[DiffEntry]) -> Iterator[DiffEntry]:
    """Join the entries about several episodes with the same text."""
    groups: dict[tuple[str, str, str], list[DiffEntry]] = {}
    for item in entries:
        groups.setdefault((item.level, item.name, item.text), []).append(item)
    for group in groups.values():
        yield replace(group[0], episodes=tuple(pair for item in group for pair in item.episodes))


def _fields(level: Level, begin: str, a: Mapping[str, Any], b: Mapping[str, Any]) -> Iterator[DiffEntry]:
    """Yield the differences between objects with the same names."""
    for name in dict.fromkeys((*a, *b)):
        if name not in a or name not in b or not _is_equal(a[name], b[name]):
            shown = [repr(side[name])[:_MAX_TEXT] if name in side else "missing" for side in (a, b)]
            yield DiffEntry(level=level, name=f"{begin}{name}", text=f"{begin}{name} is {shown[0]}, in B {shown[1]}")


def _is_equal(a: Any, b: Any) -> bool:
    return bool(a == b) or (a != a and b != b)


def _info(a: LeRobotFolder, b: LeRobotFolder) -> Iterator[DiffEntry]:
    fields = [
        {"fps": info.fps, "robot_type": info.robot_type}
        | {name: value for name, value in info.other.items() if name not in _OLD_TOTALS}
        for info in (a.info, b.info)
    ]
    yield from _fields("info", "", *fields)


def _features(a: LeRobotFolder, b: LeRobotFolder) -> Iterator[DiffEntry]:
    for name in dict.fromkeys((*a.info.features, *b.info.features)):
        one, other = a.info.features.get(name), b.info.features.get(name)
        if one is None or other is None:
            yield DiffEntry(level="features", name=name, text=f"{name} is not in {'A' if one is None else 'B'}")
            continue
        described = [{"dtype": item.dtype, "shape": item.shape, "names": item.names} for item in (one, other)]
        if one.dtype == other.dtype:
            described = [entry | (item.info or {}) for entry, item in zip(described, (one, other), strict=True)]
        yield from _fields("features", f"{name}: ", *described)


def _unmatched(contents: Sequence[Sequence[EpisodeContent]], pairs: Mapping[int, int]) -> Iterator[DiffEntry]:
    for side, known in enumerate((set(pairs), set(pairs.values()))):
        for number, content in enumerate(contents[side]):
            if number not in known:
                pair = (number, None) if side == 0 else (None, number)
                text = f"episode {number} of {'AB'[side]}, {content.length} frames, is not in {'BA'[side]}"
                yield DiffEntry(level="episodes", name=("missing", "extra")[side], text=text, episodes=(pair,))


def _unused_tasks(a: LeRobotFolder, b: LeRobotFolder) -> Iterator[DiffEntry]:
    """Yield the tasks of one dataset that none of its episodes has; the others are compared by episode."""
    for side, (source, other) in enumerate(((a, b), (b, a))):
        used = {task for place in source.places for task in place.tasks}
        for task in sorted(set(source.tasks) - set(other.tasks) - used):
            yield DiffEntry(level="tasks", name=task, text=f"{task!r} is not in {'BA'[side]}")


def _episode(
    readers: Sequence[ContentReader], pair: tuple[int, int], contents: tuple[EpisodeContent, EpisodeContent]
) -> Iterator[DiffEntry]:
    """Yield the differences of rows and images; ExportError if data cannot be read."""
    a, b = (reader.columns(number) for reader, number in zip(readers, pair, strict=True))
    lengths, begins, count = [content.length for content in contents], (0, 0), contents[0].length
    cameras = readers[0].cameras
    if lengths[0] != lengths[1]:
        where, begins, count = _common_part(a, b)
        text = f"{lengths[0]} frames, {lengths[1]} in B: {where}"
        yield DiffEntry(level="episodes", name="length", text=text, episodes=(pair,))
    for name in a if lengths[0] == lengths[1] else ():
        if name not in cameras and (found := _row_entry(name, a[name], b[name], pair, readers[0].source)):
            yield found
    one, other = (content.parts for content in contents)
    for name in cameras if count else ():
        if one[name] is None or one[name] != other[name]:
            yield from _images(readers, name, pair, begins, count)


def _common_part(a: Mapping[str, NDArray[Any]], b: Mapping[str, NDArray[Any]]) -> tuple[str, tuple[int, int], int]:
    """Find the rows of the shorter episode in the longer one: a sentence, their first frames in A and B, and count."""
    rows = [np.hstack([np.zeros((len(c[TASK]), 0)), *numbers_in(c).values()]) for c in (a, b)]
    is_cut = len(rows[1]) < len(rows[0])
    long, short = rows if is_cut else rows[::-1]
    if not short.size:
        return "they have no rows to compare", (0, 0), 0
    for start in np.flatnonzero((long[: len(long) - len(short) + 1] == short[0]).all(axis=1)).tolist():
        if np.array_equal(long[start : start + len(short)], short):
            names = "BA" if is_cut else "AB"
            where = f"{names[0]} has frames {start} to {start + len(short) - 1} of {names[1]}"
            return where, (start, 0) if is_cut else (0, start), len(short)
    return "their rows differ", (0, 0), 0


def _row_entry(name: str, a: NDArray[Any], b: NDArray[Any], pair: Pair, source: LeRobotFolder) -> DiffEntry | None:
    """Describe the difference between the values of a column, None if they are equal."""
    is_number = a.dtype.kind in "fiub" and b.dtype.kind in "fiub"
    unequal = a != b
    if is_number:
        unequal &= ~(np.isnan(a.astype(np.float64)) & np.isnan(b.astype(np.float64)))
    frames = np.flatnonzero(unequal.any(axis=1))
    if not len(frames):
        return None
    if name == TASK and len(np.unique(a)) == len(np.unique(b)) == 1:
        text = f"{str(a[0, 0])!r} is {str(b[0, 0])!r} in B"
        return DiffEntry(level="tasks", name=str(a[0, 0]), text=text, episodes=(pair,))
    first = int(frames[0])
    text = f"{name} differs in {len(frames)} of {len(a)} frames, first in frame {first}"
    if name == TASK:
        text += f": {str(a[first, 0])!r} and {str(b[first, 0])!r}"
    elif is_number:
        error = np.abs(a.astype(np.float64) - b.astype(np.float64))
        error = np.where(unequal, np.nan_to_num(error, nan=np.inf, posinf=np.inf), -1.0)
        frame, element = (int(place) for place in np.unravel_index(error.argmax(), error.shape))
        names = source.info.features[name].names or ()
        called = f" ({names[element] if len(names) == a.shape[1] else element})" if a.shape[1] > 1 else ""
        text += f", most in frame {frame}{called}: {a[frame, element].item()!r} and {b[frame, element].item()!r}"
    return DiffEntry(level="rows", name=name, text=text, episodes=(pair,))


def _images(
    readers: Sequence[ContentReader], name: str, pair: tuple[int, int], begins: tuple[int, int], count: int
) -> Iterator[DiffEntry]:
    """Yield the difference between the decoded images of a camera, from the frames `begins` on."""
    is_depth = [reader.source.info.features[name].is_depth for reader in readers]
    if is_depth[0] != is_depth[1]:
        return  # reported on the level of features
    decoded = [reader.images(name, *place) for reader, *place in zip(readers, pair, begins, strict=True)]
    found: list[tuple[float, int]] = []
    for frame, (a, b) in enumerate(islice(zip(*decoded, strict=False), count), start=begins[0]):
        if a.shape != b.shape:
            text = f"{name} has {a.shape[1]}x{a.shape[0]} pixels, {b.shape[1]}x{b.shape[0]} in B"
            yield DiffEntry(level="images", name=name, text=text, episodes=(pair,))
            return
        if not np.array_equal(a, b):
            found.append((_psnr_db(a, b, LARGEST_CODE if is_depth[0] else 255), frame))
    if found:
        (psnr_db, worst), first = min(found), found[0][1]
        text = f"{name} differs in {len(found)} of {count} images, first in frame {first}"
        text += f", most in frame {worst} (PSNR {psnr_db:.1f} dB)"
        yield DiffEntry(level="images", name=name, text=text, episodes=(pair,))


def _psnr_db(a: NDArray[Any], b: NDArray[Any], peak: int) -> float:
    """PSNR of two images that differ."""
    error = a.astype(np.float64) - b.astype(np.float64)
    return float(10 * np.log10(peak**2 / np.mean(error * error)))


def _episode_columns(
    sources: Sequence[LeRobotFolder], pairs: Mapping[int, int], contents: Sequence[Sequence[EpisodeContent]]
) -> Iterator[DiffEntry]:
    """Yield the differences between the entries of the same episode in the table of episodes and the sidecar."""
    a, b = (episode_columns(source) for source in sources)
    names = [{name for row in rows for name in row} - _COMPARED_ELSEWHERE for rows in (a, b)]
    for name in sorted(names[0] ^ names[1]):
        side = 0 if name in names[0] else 1
        if any(row.get(name) is not None for row in (a, b)[side]):
            yield DiffEntry(level="episodes", name=name, text=f"the column {name} is not in {'BA'[side]}")
    for n, m in pairs.items():
        shared = names[0] & names[1]
        if contents[0][n].parts.get(TASK) != contents[1][m].parts.get(TASK):
            shared -= {"tasks"}
        one, other = ({name: row.get(name) for name in sorted(shared)} for row in (a[n], b[m]))
        for item in _fields("episodes", "", one, other):
            yield DiffEntry(level="episodes", name=item.name, text=item.text, episodes=((n, m),))


def _statistics(sources: Sequence[LeRobotFolder], entries: Sequence[DiffEntry]) -> Iterator[DiffEntry]:
    """Yield the differences of statistics for features with equal content; for others they are expected."""
    a, b = (source.statistics if (source.root / STATS_PATH).exists() else {} for source in sources)
    if any(source.info.is_old for source in sources) or any(item.name in _OTHER_ROWS for item in entries):
        return
    changed = {item.name.partition(":")[0] for item in entries if item.level in ("features", "rows", "images")}
    for name in sources[0].info.features:
        if name in sources[1].info.features and name not in (*_POSITIONS, *changed):
            one, other = a.get(name, {}), b.get(name, {})
            if wrong := _unequal(one, other):
                text = f"{name} differs in {', '.join(wrong)}: {_worst(one, other, wrong[0])}"
                yield DiffEntry(level="statistics", name=name, text=text)


def _unequal(a: Mapping[str, Any], b: Mapping[str, Any]) -> list[str]:
    """List the statistics that differ by more than the rounding of a writer."""
    low, high = _flat(a, "min"), _flat(a, "max")
    wrong = []
    for key in dict.fromkeys((*a, *b)):
        x, y = _flat(a, key), _flat(b, key)
        slack = _TOLERANCE * np.abs(high - low) if low.shape == high.shape == x.shape else 0.0
        if x.shape != y.shape or not np.isclose(x, y, rtol=_TOLERANCE, atol=slack, equal_nan=True).all():
            wrong.append(key)
    return wrong


def _flat(entry: Mapping[str, Any], key: str) -> NDArray[np.float64]:
    """(N,) numbers of a statistic; (0,) if it is missing or not numeric."""
    try:
        return np.asarray(entry.get(key, ()), dtype=np.float64).ravel()
    except (ValueError, TypeError):
        return np.zeros(0)


def _worst(a: Mapping[str, Any], b: Mapping[str, Any], key: str) -> str:
    """Describe the element of a statistic that differs most."""
    x, y = _flat(a, key), _flat(b, key)
    if x.shape != y.shape or not len(x):
        shown = [str(entry[key])[:_MAX_TEXT] if key in entry else "missing" for entry in (a, b)]
        return f"{key} is {shown[0]}, in B {shown[1]}"
    place = int(np.nan_to_num(np.abs(x - y), nan=np.inf).argmax())
    return f"{key}{f'[{place}]' if x.size > 1 else ''} is {x[place]:.7g}, in B {y[place]:.7g}"


def _notes(sources: Sequence[LeRobotFolder], result: DatasetDiff) -> Iterator[str]:
    a, b = (source.info for source in sources)
    for side, source in zip("AB", sources, strict=True):
        yield from (f"{side}: {note}" for note in source.notes)
    if result.is_reordered:
        moved = [f"{n} is {m}" for n, m in result.pairs.items() if n != m]
        yield f"The same episodes in another order, A to B: {listed(moved, 8, ', ')}."
    for name in _STORAGE:
        if getattr(a, name) != getattr(b, name):
            yield f"Stored differently: {name} is {getattr(a, name)}, in B {getattr(b, name)}."
