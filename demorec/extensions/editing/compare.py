"""Row by row and image by image comparison of two versions of one episode."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import islice
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from demorec.datasets.lerobot.depth import LARGEST_CODE
from demorec.datasets.lerobot.folder import LeRobotFolder
from demorec.extensions.editing.content import TASK, ContentReader, Shared, moving_columns, row_hashes

Level = Literal["info", "features", "tasks", "episodes", "rows", "images", "statistics"]
LEVELS: tuple[Level, ...] = ("info", "features", "tasks", "episodes", "rows", "images", "statistics")
Folders = tuple[LeRobotFolder, LeRobotFolder]
"""Datasets A and B."""
_WORST = 3
"""Maximum images listed."""


@dataclass(frozen=True, kw_only=True)
class DiffEntry:
    """A difference between datasets A and B.

    Attributes:
        level: Level of the difference.
        name: Name of the field, feature or task.
        text: Description of the difference.
        episodes: Numbers in A and in B, None if the episode is missing there; None if it concerns no episode.
        details: Values for programs.
    """

    level: Level
    name: str
    text: str
    episodes: tuple[int | None, int | None] | None = None
    details: Mapping[str, Any] = field(default_factory=dict)

    @property
    def line(self) -> str:
        """The difference as a line of text."""
        if self.episodes is None or None in self.episodes:
            return f"{self.level}: {self.text}"
        a, b = self.episodes
        return f"{self.level}: episode {a}{'' if a == b else f' (in B {b})'}: {self.text}"

    def to_json(self) -> dict[str, Any]:
        """The difference as plain data."""
        a, b = self.episodes or (None, None)
        return {"level": self.level, "name": self.name, "episode_a": a, "episode_b": b, "text": self.text,
                **self.details}  # fmt: skip


class EpisodeComparer:
    """Compares pairs of episodes of two datasets, A and B."""

    def __init__(self, sources: Folders, readers: tuple[ContentReader, ContentReader], shared: Shared) -> None:
        self._sources, self._readers, self._shared = sources, readers, shared

    def differences(self, a: int, b: int, images_equal: Mapping[str, bool]) -> Iterator[DiffEntry]:
        """Differences between episode `a` of A and `b` of B; ExportError if data cannot be read.

        `images_equal` records for each camera feature whether its encoded images are known to be equal.
        """
        one, other = self._readers[0].columns(a), self._readers[1].columns(b)
        stored = [name for name in self._shared.cameras if name in one and name in other]
        lengths = tuple(source.places[n].length for source, n in zip(self._sources, (a, b), strict=True))
        starts, count = (0, 0), lengths[0]
        if lengths[0] != lengths[1]:
            difference, starts, count = _lengths(one, other, lengths)
            yield DiffEntry(level="episodes", name="length", text=difference, episodes=(a, b),
                             details={"frames_a": lengths[0], "frames_b": lengths[1]})  # fmt: skip
        else:
            for name in one:
                if name not in self._shared.cameras and (found := self._rows(name, one[name], other[name], (a, b))):
                    yield found
        for name in self._shared.cameras if count else ():
            if images_equal[name] or (name in stored and starts == (0, 0) and np.array_equal(one[name], other[name])):
                continue
            if found := self._images(name, (a, b), starts, count):
                yield found

    def _rows(self, name: str, a: NDArray[Any], b: NDArray[Any], episodes: tuple[int, int]) -> DiffEntry | None:
        is_number = a.dtype.kind in "fiub" and b.dtype.kind in "fiub"
        unequal = a != b
        if is_number:
            unequal &= ~(np.isnan(a.astype(np.float64)) & np.isnan(b.astype(np.float64)))
        frames = np.flatnonzero(unequal.any(axis=1))
        if not len(frames):
            return None
        first = int(frames[0])
        details: dict[str, Any] = {"num_frames": len(frames), "first_frame": first}
        text = f"{name} differs in {len(frames)} of {len(a)} frames, first in frame {first}"
        if name == TASK:
            pairs = sorted({(str(x), str(y)) for x, y in zip(a.ravel(), b.ravel(), strict=True) if x != y})
            return DiffEntry(level="rows", name=name, episodes=episodes, details={**details, "texts": pairs},
                              text=f"{text}: {pairs[0][0]!r} and {pairs[0][1]!r}")  # fmt: skip
        if is_number:
            size = np.abs(a.astype(np.float64) - b.astype(np.float64))
            size = np.where(unequal, np.nan_to_num(size, nan=np.inf, posinf=np.inf), -1.0)
            frame, element = (int(place) for place in np.unravel_index(size.argmax(), size.shape))
            names = self._sources[0].info.features[name].names
            called = names[element] if names is not None and len(names) == a.shape[1] else str(element)
            values = a[frame, element].item(), b[frame, element].item()
            details |= {"largest_frame": frame, "element": called, "a": _plain(values[0]), "b": _plain(values[1])}
            text += (
                f", most in frame {frame}{f' ({called})' if a.shape[1] > 1 else ''}: {values[0]!r} and {values[1]!r}"
            )
        return DiffEntry(level="rows", name=name, text=text, episodes=episodes, details=details)

    def _images(self, name: str, episodes: tuple[int, int], starts: tuple[int, int], count: int) -> DiffEntry | None:
        """Difference between decoded images; those of a cut episode are aligned by `starts`."""
        is_depth = [
            source.info.features[self._shared.own(side, name)].is_depth for side, source in enumerate(self._sources)
        ]
        if is_depth[0] != is_depth[1]:
            return None  # reported on the level of features
        one, other = (self._decoded(side, name, episodes[side], starts[side]) for side in (0, 1))
        found: list[tuple[float, int]] = []
        for frame, (a, b) in enumerate(islice(zip(one, other, strict=False), count), start=starts[0]):
            if a.shape != b.shape:
                text = f"{name} has {a.shape[1]}x{a.shape[0]} pixels, {b.shape[1]}x{b.shape[0]} in B"
                return DiffEntry(level="images", name=name, text=text, episodes=episodes)
            if not np.array_equal(a, b):
                found.append((_psnr(a, b, LARGEST_CODE if is_depth[0] else 255), frame))
        if not found:
            return None
        first = found[0][1]
        worst = sorted(found)[:_WORST]
        named = ", ".join(f"frame {frame} ({psnr:.1f} dB)" for psnr, frame in worst)
        return DiffEntry(
            level="images",
            name=name,
            text=f"{name} differs in {len(found)} of {count} images, first in frame {first}, worst by PSNR: {named}",
            episodes=episodes,
            details={
                "num_frames": len(found),
                "first_frame": first,
                "worst": [{"frame": frame, "psnr_db": round(psnr, 2)} for psnr, frame in worst],
            },
        )

    def _decoded(self, side: int, name: str, number: int, start: int) -> Iterator[NDArray[Any]]:
        source, own = self._sources[side], self._shared.own(side, name)
        place, feature = source.places[number], source.info.features[own]
        if not feature.is_video:
            return islice(source.stored_images[own].read(place), start, None)
        video = source.video(own, place)
        return video.codes(start) if feature.is_depth else video.images(start)


def _lengths(
    a: Mapping[str, NDArray[Any]], b: Mapping[str, NDArray[Any]], lengths: tuple[int, ...]
) -> tuple[str, tuple[int, int], int]:
    """Describe episodes of different lengths; starts of the shorter one in the longer one, and its length or 0."""
    text = f"{lengths[0]} frames, {lengths[1]} in B"
    names = moving_columns(a)
    if not names:
        return text, (0, 0), 0
    rows = [np.stack([row_hashes(columns[name]) for name in names], axis=1) for columns in (a, b)]
    is_cut = len(rows[1]) < len(rows[0])
    long, short = (rows[0], rows[1]) if is_cut else (rows[1], rows[0])
    for start in range(len(long) - len(short) + 1):
        if np.array_equal(long[start : start + len(short)], short):
            last = start + len(short) - 1
            which = f"B has frames {start} to {last} of A" if is_cut else f"A has frames {start} to {last} of B"
            return f"{text}: {which}", (start, 0) if is_cut else (0, start), len(short)
    unequal = np.flatnonzero((long[: len(short)] != short).any(axis=1))
    return f"{text}, its rows differ from frame {int(unequal[0])} on", (0, 0), 0


def _psnr(a: NDArray[Any], b: NDArray[Any], peak: int) -> float:
    """PSNR of two images that differ, dB."""
    error = a.astype(np.float64) - b.astype(np.float64)
    return float(10 * np.log10(peak**2 / np.mean(error * error)))


def _plain(value: Any) -> Any:
    """Convert a number for JSON."""
    return value if not isinstance(value, float) or np.isfinite(value) else str(value)
