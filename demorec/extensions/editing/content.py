"""Content digests of episodes, which identify an episode of one dataset in another.

Positions do not count: `index` and `episode_index` are relative to the episode's first row, and `task_index` is
replaced by its text. An episode thus has the same digests in any position, file size and format.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import ExportError
from demorec.datasets.lerobot.episode_table import EpisodePlace
from demorec.datasets.lerobot.folder import LeRobotFolder
from demorec.datasets.lerobot.layout import AUTOMATIC_FEATURES

TASK = "task"
"""Column of the instructions, instead of `task_index`."""
_SKETCH = 16
"""Number of rows per feature in a sketch: those with the smallest hashes (Broder 1997), in any frame."""
_LEAST_ALIKE = 0.3
"""Minimum share of common rows for one episode to count as a changed version of another."""
_IMAGES_ALIKE = 0.5
"""Weight of equal videos relative to the rows."""
_WORDS = np.random.default_rng(0).integers(1, 2**63, size=4096, dtype=np.uint64) * np.uint64(2) + np.uint64(1)


@dataclass(frozen=True, kw_only=True, eq=False)
class Shared:
    """Features that two datasets share and whose values can be compared.

    Attributes:
        columns: Columns of the data table, without images; feature -> whether both have the same type.
        cameras: Feature -> whether both store its images in the same form, so that equal bytes mean equal images.
        names: Feature -> its name in the second dataset, if different.
    """

    columns: Mapping[str, bool]
    cameras: Mapping[str, bool]
    names: Mapping[str, str]

    def own(self, side: int, name: str) -> str:
        """Name of a feature in the first (0) or second (1) dataset."""
        return self.names.get(name, name) if side else name

    @classmethod
    def of(cls, a: LeRobotFolder, b: LeRobotFolder, names: Mapping[str, str]) -> Shared:
        """Find the shared features of two datasets."""
        pairs = {name: (item, b.info.features[own]) for name, item in a.info.features.items()
                 if (own := names.get(name, name)) in b.info.features}  # fmt: skip
        columns, cameras = {}, {}
        for name, (one, other) in pairs.items():
            if one.is_camera and other.is_camera:
                if one.shape == other.shape:
                    cameras[name] = one.dtype == other.dtype
            elif one.shape == other.shape and (one.dtype == other.dtype or (one.is_numeric and other.is_numeric)):
                columns[name] = one.dtype == other.dtype
        return cls(columns=columns, cameras=cameras, names=names)


@dataclass(frozen=True, kw_only=True, eq=False)
class EpisodeContent:
    """Content of one episode.

    Attributes:
        length: Number of frames.
        rows: Column -> digest of its values.
        images: Camera feature -> digest of its encoded images; None if only their pixels can be compared.
        sketch: (N,) hashes of some rows, the same ones in every episode with these rows.
    """

    length: int
    rows: Mapping[str, bytes]
    images: Mapping[str, bytes | None]
    sketch: NDArray[np.uint64]

    def equals(self, other: EpisodeContent) -> bool:
        """Whether every bit of both is known to be equal."""
        return self._key() == other._key() and None not in self.images.values()

    def _key(self) -> tuple[Any, ...]:
        return self.length, tuple(self.rows.values()), tuple(self.images.values())


class ContentReader:
    """Columns of a dataset's episodes, and their digests.

    Args:
        source: The dataset.
        shared: Shared features to compare.
        side: Whether it is the first (0) or the second (1) dataset.
    """

    def __init__(self, source: LeRobotFolder, shared: Shared, *, side: int) -> None:
        self._source, self._shared = source, shared
        self._own = {name: shared.own(side, name) for name in (*shared.columns, *shared.cameras)}
        features = source.info.features
        self._stored = [name for name in shared.cameras if not features[self._own[name]].is_video]
        columns = [self._own[name] for name in (*shared.columns, *self._stored)]
        self._rows = source.rows(columns)

    def __len__(self) -> int:
        return len(self._source.places)

    def columns(self, number: int) -> dict[str, NDArray[Any]]:
        """Column -> (T, D) numbers, or (T, 1) texts; for language and stored images, digests of each row."""
        place = self._source.places[number]
        rows, found = self._rows.numbers(place), {}
        for name in (*self._shared.columns, *self._stored):
            values = rows[self._own[name]]
            if name == "index":
                values = values - place.from_index
            elif name == "episode_index":
                values = values - place.episode_index
            found[TASK if name == "task_index" else name] = self._texts(values) if name == "task_index" else values
        return found

    def _texts(self, indices: NDArray[Any]) -> NDArray[np.str_]:
        tasks = self._source.tasks
        texts = [
            tasks[int(index)] if np.isfinite(index) and 0 <= index < len(tasks) else f"no task {index}"
            for index in indices.ravel()
        ]
        return np.array(texts, dtype=np.str_).reshape(-1, 1)

    def read(self, number: int) -> EpisodeContent:
        """Digests of an episode; ExportError if it cannot be read."""
        place, columns = self._source.places[number], self.columns(number)
        stored = {name: columns.pop(name) for name in self._stored}
        rows = {}
        for name, values in columns.items():
            is_text = values.dtype.kind not in "fiub"
            kept = values if self._shared.columns.get(name, True) or is_text else values.astype(np.float64)
            rows[name] = _digest(kept)
        images: dict[str, bytes | None] = {}
        for name, is_same_kind in self._shared.cameras.items():
            images[name] = None
            if is_same_kind:
                images[name] = _digest(stored[name]) if name in stored else self._packets(name, place)
        return EpisodeContent(length=place.length, rows=rows, images=images, sketch=_sketch(columns))

    def _packets(self, name: str, place: EpisodePlace) -> bytes | None:
        try:
            video = self._source.video(self._own[name], place).cut()
            sets = video.parameter_sets()
        except ExportError:  # packets that cannot be assigned to episodes; decoding shows whether they exist
            return None
        head = (
            f"{video.codec} {video.width} {video.height} {video.lead} {video.tail} {video.sizes.tolist()} {len(sets)}"
        )
        return hashlib.sha256(b"".join((head.encode(), sets, video.read()))).digest()


def _digest(values: NDArray[Any]) -> bytes:
    is_text = values.dtype.kind not in "fiub"
    data = repr(values.tolist()).encode() if is_text else np.ascontiguousarray(values).tobytes()
    return hashlib.sha256(f"{values.shape}{'' if is_text else values.dtype}".encode() + data).digest()


def row_hashes(values: NDArray[Any]) -> NDArray[np.uint64]:
    """(T,) hash of each row of (T, D) numbers; equal numbers have equal hashes for any type."""
    words = np.ascontiguousarray(values.astype(np.float64) + 0.0).view(np.uint64)
    found: NDArray[np.uint64] = (words * _WORDS[np.arange(words.shape[1]) % len(_WORDS)]).sum(axis=1, dtype=np.uint64)
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):  # splitmix64 (Steele et al. 2014)
        found = (found ^ (found >> np.uint64(shift))) * np.uint64(factor)
    return found ^ (found >> np.uint64(31))


def moving_columns(columns: Mapping[str, NDArray[Any]]) -> list[str]:
    """Numeric columns with content of an episode rather than its position."""
    return [name for name, values in columns.items() if name not in AUTOMATIC_FEATURES and values.dtype.kind in "fiub"]


def _sketch(columns: Mapping[str, NDArray[Any]]) -> NDArray[np.uint64]:
    found: list[NDArray[np.uint64]] = [np.zeros(0, np.uint64)]
    for name in moving_columns(columns):
        salt = int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "little")
        found.append(np.unique(row_hashes(columns[name]))[:_SKETCH] ^ np.uint64(salt))
    return np.concatenate(found)


def matched(a: Sequence[EpisodeContent], b: Sequence[EpisodeContent]) -> dict[int, int]:
    """Number of an episode -> number of the equal or changed one in the other dataset.

    Equal episodes are matched first, then those with the most in common. Among equals the one at the same position is
    matched.
    """
    found: dict[int, int] = {}
    equal: dict[tuple[Any, ...], list[int]] = {}
    for number, content in enumerate(b):
        equal.setdefault(content._key(), []).append(number)
    for by_place in (True, False):
        for number, content in enumerate(a):
            others = equal.get(content._key(), [])
            if number not in found and (number in others if by_place else others):
                found[number] = others.pop(others.index(number) if by_place else 0)
    taken = set(found.values())
    rest_a = [number for number in range(len(a)) if number not in found]
    rest_b = [number for number in range(len(b)) if number not in taken]
    for _, one, other in sorted(_alike(a, b, rest_a, rest_b)):
        if one not in found and other not in taken:
            found[one] = other
            taken.add(other)
    return dict(sorted(found.items()))


def _alike(
    a: Sequence[EpisodeContent], b: Sequence[EpisodeContent], rest_a: Sequence[int], rest_b: Sequence[int]
) -> Iterator[tuple[tuple[float, int], int, int]]:
    """((smaller for more similar, distance in position), episode of a, episode of b)."""
    holders: dict[Any, list[int]] = {}
    for number in rest_b:
        for value in (*b[number].sketch.tolist(), *_image_keys(b[number])):
            holders.setdefault(value, []).append(number)
    for number in rest_a:
        one = a[number]
        common = Counter(other for value in one.sketch.tolist() for other in holders.get(value, ()))
        same_pictures = Counter(other for key in _image_keys(one) for other in holders.get(key, ()))
        for other in {*common, *same_pictures}:
            most = max(len(one.sketch), len(b[other].sketch), 1)
            alike = common[other] / most + _IMAGES_ALIKE * same_pictures[other] / max(len(one.images), 1)
            if alike >= _LEAST_ALIKE:
                yield (-alike, abs(number - other)), number, other


def _image_keys(content: EpisodeContent) -> list[tuple[str, bytes]]:
    return [(name, digest) for name, digest in content.images.items() if digest is not None]
