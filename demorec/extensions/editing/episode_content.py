"""Content of episodes, by which an episode of one dataset is found in another.

Positions do not count: `index` and `episode_index` are relative to the episode's first row, and `task_index` is
replaced by its text.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import ExportError
from demorec.datasets.lerobot.folder import LeRobotFolder
from demorec.datasets.lerobot.layout import AUTOMATIC_FEATURES

TASK = "task"
"""Column of the instructions, instead of `task_index`."""
_SKETCH_ROWS = 16
"""Number of rows of a feature in a sketch: those with the smallest hashes (Broder 1997), in any frame."""
_MIN_COMMON_RATIO = 0.3
"""Minimum ratio of common rows and videos for one episode to count as a changed version of another."""


def shared_features(a: LeRobotFolder, b: LeRobotFolder) -> list[str]:
    """List the features whose values can be compared: both numbers, texts or images, of the same shape."""
    found = []
    for name, one in a.info.features.items():
        other = b.info.features.get(name)
        if other is not None and one.shape == other.shape:
            kinds = [(feature.is_camera, feature.is_numeric) for feature in (one, other)]
            if one.dtype == other.dtype or (kinds[0] == kinds[1] and any(kinds[0])):
                found.append(name)
    return found


@dataclass(frozen=True, kw_only=True)
class EpisodeContent:
    """Digests of one episode.

    Attributes:
        length: Number of frames.
        parts: Column or camera -> digest of its values or encoded images; None if only pixels can be compared.
    """

    length: int
    parts: Mapping[str, bytes | None]

    @property
    def is_known(self) -> bool:
        """Whether an episode with equal digests is equal in every bit."""
        return None not in self.parts.values()


class ContentReader:
    """Columns and images of a dataset's episodes.

    Args:
        source: The dataset.
        features: Features to compare.
    """

    def __init__(self, source: LeRobotFolder, features: Sequence[str]) -> None:
        self.source = source
        self.cameras = [name for name in features if source.info.features[name].is_camera]
        self._columns = [name for name in features if not source.info.features[name].is_video]
        self._rows = source.rows(self._columns)

    def columns(self, number: int) -> dict[str, NDArray[Any]]:
        """Column -> (T, D) numbers, or (T, 1) texts; for language and stored images, digests of each row."""
        place = self.source.places[number]
        found = self._rows.numbers(place)
        for name, first in (("index", place.from_index), ("episode_index", place.episode_index)):
            if name in found:
                found[name] = found[name] - first
        if "task_index" in found:
            found[TASK] = self._texts(found.pop("task_index"))
        return found

    def _texts(self, indices: NDArray[Any]) -> NDArray[np.str_]:
        tasks = dict(enumerate(self.source.tasks))
        texts = [tasks.get(index, f"no task {index}") for index in indices.ravel().tolist()]
        return np.array(texts, dtype=np.str_).reshape(-1, 1)

    def content(self, number: int) -> EpisodeContent:
        """Compute the digests of an episode; ExportError if it cannot be read."""
        parts: dict[str, bytes | None] = {name: _digest(values) for name, values in self.columns(number).items()}
        parts |= {name: self._packets(name, number) for name in self.cameras if name not in parts}
        return EpisodeContent(length=self.source.places[number].length, parts=parts)

    def _packets(self, name: str, number: int) -> bytes | None:
        try:
            video = self.source.video(name, self.source.places[number]).cut()
            sets = video.parameter_sets()
        except ExportError:  # packets that cannot be assigned to episodes; decoding shows whether they exist
            return None
        head = f"{video.codec} {video.width} {video.height} {video.lead} {video.tail} {video.sizes.tolist()}"
        return hashlib.sha256(b"".join((head.encode(), sets, video.read()))).digest()

    def sketch(self, number: int) -> list[int]:
        """Hashes of some rows of each feature, the same ones in every episode with these rows."""
        found: list[int] = []
        for name, values in numbers_in(self.columns(number)).items():
            found += sorted({hash((name, row.tobytes())) for row in values})[:_SKETCH_ROWS]
        return found

    def images(self, name: str, number: int, begin: int) -> Iterator[NDArray[Any]]:
        """Yield the decoded images of a camera from a frame on, or its depth codes."""
        place, feature = self.source.places[number], self.source.info.features[name]
        if not feature.is_video:
            return islice(self.source.stored_images[name].read(place), begin, None)
        video = self.source.video(name, place)
        return video.codes(begin) if feature.is_depth else video.images(begin)


def _digest(values: NDArray[Any]) -> bytes:
    is_text = values.dtype.kind not in "fiub"
    data = repr(values.tolist()).encode() if is_text else np.ascontiguousarray(values).tobytes()
    return hashlib.sha256(f"{values.shape}{'' if is_text else values.dtype}".encode() + data).digest()


def numbers_in(columns: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[np.float64]]:
    """Numeric columns with content of an episode rather than its position; equal numbers of any type are equal."""
    return {
        name: values.astype(np.float64) + 0.0  # -0.0 equals 0.0
        for name, values in columns.items()
        if name not in AUTOMATIC_FEATURES and values.dtype.kind in "fiub"
    }


def matched(contents: Sequence[Sequence[EpisodeContent]], readers: Sequence[ContentReader]) -> dict[int, int]:
    """Find the equal or changed episode of the second dataset for each episode of the first one.

    Equal episodes are matched first, then those with the most in common; among equals the one at the same position.
    """
    a, b = contents
    found: dict[int, int] = {}
    equal: dict[tuple[Any, ...], list[int]] = {}
    for number, content in enumerate(b):
        equal.setdefault(tuple(content.parts.items()), []).append(number)
    for number, content in enumerate(a):
        if others := equal.get(tuple(content.parts.items())):
            found[number] = others.pop(others.index(number) if number in others else 0)
    taken = set(found.values())
    rest = [[n for n in range(len(a)) if n not in found], [m for m in range(len(b)) if m not in taken]]
    for _, _, number, other in sorted(_similar(contents, readers, rest) if all(rest) else ()):
        if number not in found and other not in taken:
            found[number] = other
            taken.add(other)
    return dict(sorted(found.items()))


def _similar(
    contents: Sequence[Sequence[EpisodeContent]], readers: Sequence[ContentReader], rest: Sequence[Sequence[int]]
) -> Iterator[tuple[float, int, int, int]]:
    """Yield (smaller for more similar, distance in position, episode of A, episode of B)."""
    others = {number: readers[1].sketch(number) for number in rest[1]}
    holders: dict[int, list[int]] = {}
    for number, sketch in others.items():
        for value in sketch:
            holders.setdefault(value, []).append(number)
    cameras = readers[0].cameras
    for number in rest[0]:
        sketch, parts = readers[0].sketch(number), contents[0][number].parts
        common = Counter(other for value in sketch for other in holders.get(value, ()))
        for other in rest[1]:
            theirs = contents[1][other].parts
            videos = sum(parts[name] is not None and parts[name] == theirs[name] for name in cameras)
            similarity = common[other] / max(len(sketch), len(others[other]), 1)
            similarity += videos / max(len(cameras), 1) / 2
            if similarity >= _MIN_COMMON_RATIO:
                yield -similarity, abs(number - other), number, other
