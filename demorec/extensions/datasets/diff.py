"""Differences between two LeRobot datasets: features, episodes, rows and encoded images.

Equal episodes are matched by content, whatever their order, files, format version and task numbers; others by number.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.core.plain import listed
from demorec.datasets.lerobot.layout import AUTOMATIC_FEATURES, DatasetFeature
from demorec.datasets.options import ProgressCallback
from demorec.extensions.datasets.folder import LeRobotFolder

TASK = "task"
"""Name of the instructions, instead of `task_index`."""
_MAX_TEXT = 120

Digests = Mapping[str, bytes]
"""Column or camera -> digest of an episode's values or packets."""


@dataclass(frozen=True, kw_only=True)
class DatasetDiff:
    """Result of a comparison of datasets A and B.

    Attributes:
        num_episodes: Number of episodes in A and in B.
        num_same: Number of pairs with equal rows and packets.
        differences: Description of a difference -> its episodes; none if it concerns the whole dataset.
        notes: Sentences on how the datasets were read.
    """

    num_episodes: tuple[int, int]
    num_same: int
    differences: Mapping[str, Sequence[int]]
    notes: tuple[str, ...] = ()

    def lines(self) -> Iterator[str]:
        """Yield a line for each difference."""
        for text, numbers in self.differences.items():
            noun = f"episode{'s' * (len(numbers) > 1)} {listed([str(number) for number in numbers], 8, ', ')}: "
            yield f"{noun}{text}" if numbers else text


def diff(a: Path, b: Path, progress: ProgressCallback | None = None) -> DatasetDiff:
    """Compare two datasets of v2.0 to v3.0; holds one episode in memory, and some digests for each.

    Raises:
        ExportError: A dataset is damaged.
    """
    folders = LeRobotFolder(a), LeRobotFolder(b)
    shared = [
        name
        for name, feature in folders[0].info.features.items()
        if name not in AUTOMATIC_FEATURES and _kind(feature) == _kind(folders[1].info.features.get(name))
    ]
    readers = [_ContentReader(folder, shared) for folder in folders]
    total = sum(len(folder.places) for folder in folders)
    digests: tuple[list[Digests], list[Digests]] = ([], [])
    for reader, found in zip(readers, digests, strict=True):
        for number in range(len(reader.folder.places)):
            found.append(reader.digests(number))
            if progress is not None:
                progress(len(digests[0]) + len(digests[1]), total)
    pairs = _matched(*digests)
    differences: dict[str, list[int]] = {text: [] for text in _info_differences(*folders)}
    for name, numbers, others in (("A", pairs.keys(), digests[0]), ("B", pairs.values(), digests[1])):
        if alone := [str(number) for number in range(len(others)) if number not in numbers]:
            differences[f"episodes only in {name}: {listed(alone, 8, ', ')}"] = []
    num_same = 0
    for number, match in pairs.items():
        one, other = digests[0][number], digests[1][match]
        num_same += one == other
        if one != other:  # then they have the same number
            for text in _episode_differences(readers, number, [name for name in one if one[name] != other[name]]):
                differences.setdefault(text, []).append(number)
    return DatasetDiff(
        num_episodes=(len(digests[0]), len(digests[1])),
        num_same=num_same,
        differences=differences,
        notes=tuple(f"{side}: {note}" for side, folder in zip("AB", folders, strict=True) for note in folder.notes),
    )


def _kind(feature: DatasetFeature | None) -> tuple[str, tuple[int, ...]] | None:
    return None if feature is None else (feature.dtype, feature.shape)


class _ContentReader:
    """Reader of the content of a dataset's episodes."""

    def __init__(self, folder: LeRobotFolder, features: Sequence[str]) -> None:
        self.folder = folder
        self._videos = [name for name in features if folder.info.features[name].is_video]
        columns = [name for name in features if name not in self._videos]
        self._rows = folder.rows([*columns, "timestamp", "task_index"])
        self._tasks = dict(enumerate(folder.tasks))

    def columns(self, number: int) -> dict[str, NDArray[Any]]:
        """Column -> (T, D) integers or bits of floats, or (T, 1) texts; digests of language and stored images."""
        found = self._rows.numbers(self.folder.places[number])
        for name, values in found.items():
            if values.dtype.kind == "f":
                found[name] = np.ascontiguousarray(values).view(f"u{values.itemsize}")
        indices = found.pop("task_index").ravel().tolist()
        texts = [self._tasks.get(index, f"no task {index}") for index in indices]
        return {**found, TASK: np.array(texts, dtype=np.str_).reshape(-1, 1)}

    def digests(self, number: int) -> Digests:
        """Digests of the columns and packets of an episode; ExportError if it cannot be read."""
        columns = {name: _digest(values) for name, values in self.columns(number).items()}
        return columns | {name: self._packets(name, number) for name in self._videos}

    def _packets(self, name: str, number: int) -> bytes:
        video = self.folder.video(name, self.folder.places[number]).cut()
        head = f"{video.codec} {video.lead} {video.tail} {video.sizes.tolist()}"
        return hashlib.sha256(b"".join((head.encode(), video.parameter_sets(), video.read()))).digest()


def _digest(values: NDArray[Any]) -> bytes:
    is_number = values.dtype.kind in "fiub"
    data = np.ascontiguousarray(values).tobytes() if is_number else repr(values.tolist()).encode()
    return hashlib.sha256(f"{values.shape}".encode() + data).digest()


def _matched(a: Sequence[Digests], b: Sequence[Digests]) -> dict[int, int]:
    """Match equal episodes, then the others by number."""
    found: dict[int, int] = {}
    equal: dict[tuple[bytes, ...], list[int]] = {}
    for number, digests in enumerate(b):
        equal.setdefault(tuple(digests.values()), []).append(number)
    for number, digests in enumerate(a):
        if others := equal.get(tuple(digests.values())):
            found[number] = others.pop(others.index(number) if number in others else 0)
    taken = set(found.values())
    found |= {number: number for number in range(min(len(a), len(b))) if number not in found and number not in taken}
    return dict(sorted(found.items()))


def _info_differences(a: LeRobotFolder, b: LeRobotFolder) -> Iterator[str]:
    for name in ("fps", "robot_type"):
        if getattr(a.info, name) != getattr(b.info, name):
            yield f"{name} is {getattr(a.info, name)!r}, in B {getattr(b.info, name)!r}"
    for name in dict.fromkeys((*a.info.features, *b.info.features)):
        one, other = a.info.features.get(name), b.info.features.get(name)
        if one is None or other is None:
            yield f"the feature {name} is not in {'A' if one is None else 'B'}"
            continue
        for what in ("dtype", "shape", "names"):
            shown = [repr(getattr(feature, what))[:_MAX_TEXT] for feature in (one, other)]
            if getattr(one, what) != getattr(other, what):
                yield f"the feature {name} has the {what} {shown[0]}, in B {shown[1]}"


def _episode_differences(readers: Sequence[_ContentReader], number: int, names: Sequence[str]) -> Iterator[str]:
    """Describe the differences of an episode in these columns and cameras."""
    a, b = (reader.columns(number) for reader in readers)
    lengths = len(a[TASK]), len(b[TASK])
    if lengths[0] != lengths[1]:
        yield f"{lengths[0]} frames, {lengths[1]} in B"
        return
    for name in names:
        if name not in a:
            yield f"the encoded images of {name} differ"
            continue
        frames = np.flatnonzero((a[name] != b[name]).any(axis=1))
        first = frames[0]
        if name == TASK:
            yield f"the task {str(a[TASK][first, 0])!r} is {str(b[TASK][first, 0])!r} in B"
        else:
            yield f"{name} differs in {len(frames)} of {lengths[0]} frames, first in frame {first}"
