"""Differences between two LeRobot datasets: info, features, tasks, episodes, rows, images, statistics.

The position of episodes does not count: their order, files, format version and task numbers. Episodes are matched by
content (`content.py`), and those that are not bit-exact are compared (`compare.py`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from demorec.datasets.lerobot.boxes import SeenByCamera
from demorec.datasets.lerobot.episode_records import episode_columns, episode_facts
from demorec.datasets.lerobot.folder import LeRobotFolder
from demorec.datasets.lerobot.layout import DatasetFeature
from demorec.datasets.options import ProgressCallback
from demorec.extensions.editing.compare import LEVELS, DiffEntry, EpisodeComparer, Folders
from demorec.extensions.editing.content import TASK, ContentReader, EpisodeContent, Shared, matched
from demorec.extensions.editing.statistics import episode_statistics_differences, renamed, statistics_differences

_STORAGE = ("version", "chunks_size", "data_files_size_in_mb", "video_files_size_in_mb", "data_path", "video_path")
_OLD_TOTALS = ("total_chunks", "total_videos")
_FOLLOWS = frozenset(("episode_index", "num_frames", "length", "task", "tasks"))
"""Columns of episodes that are compared elsewhere."""


@dataclass(frozen=True, kw_only=True)
class DatasetDiff:
    """Result of a comparison.

    Attributes:
        pairs: Number of an episode in A -> its number in B.
        num_episodes: Number of episodes in A and in B.
        num_same: Number of pairs with equal rows and images.
        differences: Differences sorted by level.
        notes: Differences that do not count: order, and storage.
    """

    pairs: Mapping[int, int]
    num_episodes: tuple[int, int]
    num_same: int
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
    """Compare two datasets of v3.0 or v2.1; holds one episode in memory, and some numbers for each.

    Raises:
        ExportError: A dataset is damaged.
    """
    sources = (LeRobotFolder(a), LeRobotFolder(b))
    shared = Shared.of(*sources, renamed(*sources))
    readers = (ContentReader(sources[0], shared, side=0), ContentReader(sources[1], shared, side=1))
    contents = _contents(readers, progress)
    pairs = matched(*contents)
    changed = {n: m for n, m in pairs.items() if not contents[0][n].equals(contents[1][m])}
    found: list[DiffEntry] = []
    comparer = EpisodeComparer(sources, readers, shared)
    for n, m in changed.items():
        one, other = contents[0][n].images, contents[1][m].images
        equal = {name: digest is not None and digest == other[name] for name, digest in one.items()}
        found += comparer.differences(n, m, equal)
    unmatched = [(n, None) for n in range(len(contents[0])) if n not in pairs]
    others = set(pairs.values())
    extra = [(None, m) for m in range(len(contents[1])) if m not in others]
    found += [_one_sided(sources, episode) for episode in (*unmatched, *extra)]
    found = [*_tasks(sources, found, [*unmatched, *extra]), *_info(sources), *_features(sources, shared),
             *_facts(sources, pairs, contents), *_boxes(sources, shared, pairs)]  # fmt: skip
    result = DatasetDiff(
        pairs=pairs,
        num_episodes=(len(contents[0]), len(contents[1])),
        num_same=len(pairs) - len({item.episodes for item in found if item.level in ("episodes", "rows", "images")
                                   and item.episodes is not None and None not in item.episodes}),
        differences=(),
        notes=(),
    )  # fmt: skip
    found += [*statistics_differences(sources, shared, found, is_reordered=result.is_reordered),
              *episode_statistics_differences(sources, shared, found, pairs)]  # fmt: skip
    found.sort(key=lambda item: LEVELS.index(item.level))
    read = [f"{side}: {note}" for side, source in zip("AB", sources, strict=True) for note in source.notes]
    return replace(result, differences=tuple(found), notes=(*read, *_notes(sources, result, found)))


def _contents(
    readers: tuple[ContentReader, ContentReader], progress: ProgressCallback | None
) -> list[list[EpisodeContent]]:
    total, done = sum(map(len, readers)), 0
    found: list[list[EpisodeContent]] = []
    for reader in readers:
        found.append([])
        for number in range(len(reader)):
            found[-1].append(reader.read(number))
            done += 1
            if progress is not None:
                progress(done, total)
    return found


def _one_sided(sources: Folders, episode: tuple[int | None, int | None]) -> DiffEntry:
    side = 0 if episode[1] is None else 1
    number = episode[side]
    assert number is not None
    length = sources[side].places[number].length
    name = "missing" if side == 0 else "extra"
    return DiffEntry(level="episodes", name=name, episodes=episode, details={"frames": length},
                      text=f"episode {number} of {'AB'[side]}, {length} frames, is not in {'BA'[side]}")  # fmt: skip


def _tasks(
    sources: Folders,
    found: Sequence[DiffEntry],
    unmatched: Sequence[tuple[int | None, int | None]],
) -> list[DiffEntry]:
    """Differences so far, except those explained by a reworded task, plus differences in the tables of tasks."""
    tables = tuple(set(source.tasks) for source in sources)
    only = (tables[0] - tables[1], tables[1] - tables[0])
    kept: list[DiffEntry] = []
    reworded: dict[tuple[str, str], list[int]] = {}
    for item in found:
        pairs = item.details.get("texts", ()) if item.name == TASK and item.level == "rows" else ()
        if pairs and all(x in only[0] and y in only[1] for x, y in pairs) and item.episodes is not None:
            for pair in pairs:
                reworded.setdefault(pair, []).append(item.episodes[0] or 0)
        else:
            kept.append(item)
    for (x, y), episodes in sorted(reworded.items()):
        kept.append(DiffEntry(level="tasks", name=x, text=f"{x!r} is {y!r} in B", details={"b": y, "of": episodes}))
    for side in (0, 1):
        explained = {pair[side] for pair in reworded}
        for item in kept:
            explained |= {texts[side] for texts in item.details.get("texts", ())}
        for episode in unmatched:
            if (number := episode[side]) is not None:
                explained |= set(sources[side].places[number].tasks)
        for task in sorted(only[side] - explained):
            kept.append(DiffEntry(level="tasks", name=task, text=f"{task!r} is not in {'BA'[side]}"))
    return kept


def _info(sources: Folders) -> Iterator[DiffEntry]:
    a, b = (source.info for source in sources)
    others = [{name: value for name, value in info.other.items() if name not in _OLD_TOTALS} for info in (a, b)]
    values = [{"fps": info.fps, "robot_type": info.robot_type, **other}
              for info, other in zip((a, b), others, strict=True)]  # fmt: skip
    yield from _fields("info", "", values)
    claims = [info.total_tasks for info in (a, b)]
    counts = [len(source.tasks) for source in sources]
    if claims[0] - counts[0] != claims[1] - counts[1]:
        text = f"total_tasks is {claims[0]} for {counts[0]} existing ones, in B {claims[1]} for {counts[1]}"
        yield DiffEntry(level="info", name="total_tasks", text=text, details={"a": claims[0], "b": claims[1]})


def _fields(level: Any, of: str, values: Sequence[Mapping[str, Any]]) -> Iterator[DiffEntry]:
    """Differences between objects with the same names."""
    a, b = values
    for name in dict.fromkeys((*a, *b)):
        if name in a and name in b and _is_equal(a[name], b[name]):
            continue
        shown = [repr(side[name]) if name in side else "not there" for side in (a, b)]
        shown = [text if len(text) <= 120 else f"{text[:120]}..." for text in shown]
        text = f"{of}{name} is {shown[0]}, in B {shown[1]}"
        yield DiffEntry(level=level, name=f"{of}{name}", text=text)


def _is_equal(a: Any, b: Any) -> bool:
    return bool(a == b) or (a != a and b != b)


def _features(sources: Folders, shared: Shared) -> Iterator[DiffEntry]:
    a, b = (source.info.features for source in sources)
    for name, other in shared.names.items():
        yield DiffEntry(level="features", name=name, text=f"{name} is called {other} in B", details={"b": other})
    for name in dict.fromkeys((*a, *(other for other in b if other not in shared.names.values()))):
        own = shared.own(1, name)
        if name not in a or own not in b:
            yield DiffEntry(level="features", name=name, text=f"{name} is not in {'A' if name not in a else 'B'}")
            continue
        is_same_type = a[name].dtype == b[own].dtype
        yield from _fields("features", f"{name}: ", [_described(item, is_same_type) for item in (a[name], b[own])])


def _described(feature: DatasetFeature, with_encoding: bool) -> dict[str, Any]:
    encoding = feature.info or {} if with_encoding else {}
    return {"dtype": feature.dtype, "shape": feature.shape, "names": feature.names, **encoding}


def _facts(
    sources: Folders, pairs: Mapping[int, int], contents: Sequence[Sequence[EpisodeContent]]
) -> Iterator[DiffEntry]:
    """Differences between the same episode's entries in the tables of episodes and demorec's sidecar."""
    rows = [
        [{**row, **facts} for row, facts in zip(episode_columns(source), episode_facts(source), strict=True)]
        for source in sources
    ]
    names = [{name for row in side for name in row} - _FOLLOWS for side in rows]
    for name in sorted(names[0] ^ names[1]):
        side = 0 if name in names[0] else 1
        if any(row.get(name) is not None for row in rows[side]):
            yield DiffEntry(level="episodes", name=name, text=f"the column {name} is not in {'BA'[side]}")
    is_same_rate = sources[0].info.fps == sources[1].info.fps
    for n, m in pairs.items():
        one, other = rows[0][n], rows[1][m]
        if one["tasks"] != other["tasks"] and contents[0][n].rows[TASK] == contents[1][m].rows[TASK]:
            text = f"its tasks are {one['tasks']} in the table of episodes, {other['tasks']} in B"
            yield DiffEntry(level="episodes", name="tasks", text=text, episodes=(n, m))
        is_same_length = one["length"] == other["length"] and is_same_rate
        for name in sorted(names[0] & names[1] - (set() if is_same_length else {"duration_s"})):
            if not _is_equal(one.get(name), other.get(name)):
                text = f"{name} is {one.get(name)!r}, in B {other.get(name)!r}"
                yield DiffEntry(level="episodes", name=name, text=text, episodes=(n, m))


def _boxes(sources: Folders, shared: Shared, pairs: Mapping[int, int]) -> Iterator[DiffEntry]:
    """Differences between boxes of episodes with equal length."""
    for name in shared.cameras:
        one, other = (source.boxes(shared.own(side, name)) for side, source in enumerate(sources))
        if (one is None) != (other is None):
            text = f"boxes of {name} are not in {'AB'[other is None]}"
            yield DiffEntry(level="features", name=f"boxes of {name}", text=text)
        if one is None or other is None:
            continue
        for n, m in pairs.items():
            lengths = [source.places[number].length for source, number in zip(sources, (n, m), strict=True)]
            seen = [one.read(n, 0, lengths[0]), other.read(m, 0, lengths[0])]
            if lengths[0] == lengths[1] and seen[0] != seen[1]:
                frames = [frame for frame in range(lengths[0]) if _seen_at(seen[0], frame) != _seen_at(seen[1], frame)]
                where = f" in {len(frames)} of {lengths[0]} frames, first in frame {frames[0]}" if frames else ""
                yield DiffEntry(level="rows", name=f"boxes of {name}", episodes=(n, m), details={"frames": frames},
                                 text=f"boxes of {name} differ{where}")  # fmt: skip


def _seen_at(seen: SeenByCamera | None, frame: int) -> list[Any]:
    return [] if seen is None else [(noun, values) for row, noun, values in seen[2] if row == frame]


def _notes(sources: Folders, result: DatasetDiff, found: Sequence[DiffEntry]) -> Iterator[str]:
    a, b = (source.info for source in sources)
    if result.is_reordered:
        moved = [f"{n} is {m}" for n, m in result.pairs.items() if n != m]
        more = f" and {len(moved) - 8} more" if len(moved) > 8 else ""
        yield f"The same episodes in another order, A to B: {', '.join(moved[:8])}{more}."
    keys = {key for item in found if item.level == "statistics" for key in item.details.get("of", ("all",))}
    if keys and all(key.startswith("q") for key in keys):
        yield "Only quantiles differ in the statistics: LeRobot estimates them, demorec computes them from the rows."
    tasks = [source.tasks for source in sources]
    if tasks[0] != tasks[1] and set(tasks[0]) == set(tasks[1]):
        yield "The same tasks with other numbers."
    if list(a.features) != list(b.features) and set(a.features) == set(b.features):
        yield "The same features in another order."
    for name in _STORAGE:
        if getattr(a, name) != getattr(b, name):
            yield f"Stored differently: {name} is {getattr(a, name)}, in B {getattr(b, name)}."
