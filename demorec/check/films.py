"""The colour images of a camera in one episode beside what the robot does, whoever recorded them.

Nothing is drawn: laws of images over time hold where neither scene nor calibration is known.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from demorec.check.base import NotMeasured
from demorec.check.cells import correlation
from demorec.check.dataset_video import detail_of, part_counts
from demorec.check.evidence import course_of
from demorec.core.geometry import Array
from demorec.episode.episode import NO_IMAGE, Columns
from demorec.episode.features import STATE
from demorec.mcap import Recording
from demorec.mcap.video import decode


@dataclass(frozen=True, kw_only=True, eq=False)
class Film:
    """N images of one camera.

    Attributes:
        where: Camera and episode, for people.
        fps: Frames per second.
        cells: (N, rows, columns, 3) mean colours of the parts of each image, 0 to 255.
        detail: (N,) `detail_of` each image.
        frames: (N,) frame that each image belongs to.
        state: (N, D) observation.state in these frames by `course_of`, None where there is none.
    """

    where: str
    fps: float
    cells: NDArray[np.uint8]
    detail: Array
    frames: NDArray[np.intp]
    state: Array | None

    @cached_property
    def step(self) -> Array:
        """(N - 1,) mean difference of each image from the one before, of 255."""
        return difference(self.cells[1:], self.cells[:-1])

    @cached_property
    def speed(self) -> Array | None:
        """(N - 1,) how far the state goes from image to image, in standard deviations of its elements."""
        if self.state is None:
            return None
        return np.asarray(np.linalg.norm(np.diff(self.state / (self.state.std(axis=0) + 1e-3), axis=0), axis=1))

    @cached_property
    def flat(self) -> NDArray[np.bool_]:
        """(N,) images of one colour."""
        return np.asarray(self.cells.std(axis=(1, 2)).max(axis=1, initial=0.0) < _BLANK_LEVELS)

    @property
    def is_blank(self) -> bool:
        """Whether most of the images are of one colour."""
        return bool(np.mean(self.flat) > 0.5) if len(self.cells) else False

    @cached_property
    def first_view(self) -> Array:
        """(rows, columns, 3) median of the first fifth of the images, 0 to 255."""
        return np.asarray(np.median(self.cells[: max(len(self.cells) // 5, 1)], axis=0))

    @property
    def stands(self) -> bool:
        """Whether it is of a camera that stands still, as far as that can be told."""
        return not isinstance(self.gains, NotMeasured)

    @cached_property
    def gains(self) -> Array | NotMeasured:
        """(3, N) of each image, against the median one of a camera that stands still, by colour.

        The gain of an image is the median over its parts; where half of them do not stay what they are but for that
        gain, the camera moves.
        """
        found, unrest = self._gains
        if math.isnan(unrest):
            return NotMeasured(why=f"most of what {self.where} shows is black or white")
        return found if unrest <= STANDS else NotMeasured(why=f"{self.where} moves")

    @property
    def unrest(self) -> float:
        """Share by which half of an image's parts change but for the gain of all, in nine of ten images at most; NaN
        where most of what it shows is black or white."""
        return self._gains[1]

    @cached_property
    def _gains(self) -> tuple[Array, float]:
        usual = np.median(self.cells, axis=0)
        lit = (usual > 20) & (usual < 235)  # (rows, columns, 3)
        if (lit.mean(axis=(0, 1)) < 0.3).any():
            return np.ones((3, len(self.cells))), math.nan
        gains, stays = [], []
        for channel in range(3):
            ratio = self.cells[..., channel][:, lit[..., channel]] / usual[..., channel][lit[..., channel]]
            gain = np.median(ratio, axis=1)
            gains.append(gain)
            stays.append(np.median(np.abs(ratio / np.maximum(gain, 1e-3)[:, None] - 1), axis=1))
        return np.array(gains), float(np.quantile(np.max(stays, axis=0), 0.9))


STANDS = 0.02
"""Share by which half of a fixed camera's parts stay what they are, but for the gain of all."""
_DIFFERENT, _ALIKE = 0.9, 0.98
"""Correlations of two cameras that show different things, and of one whose images were encoded twice."""
_BLANK_LEVELS = 1.0
"""Of 255, standard deviation over an image's parts below which it is of one colour: black, green or otherwise empty."""


Films = Mapping[str, Sequence[Film]]
"""Camera -> its film in each episode."""


class Filmed(Protocol):
    """What has cameras."""

    @property
    def films(self) -> Films:
        """Of all its cameras that show colours."""
        ...

    def distances(self) -> Iterable[tuple[str, Iterable[NDArray[Any]]]]:
        """(camera, its images (H, W) in metres) of the depth cameras whose distances can be read here."""
        ...


def difference(one: NDArray[Any], other: NDArray[Any]) -> Array:
    """(N,) mean difference of images in parts."""
    return np.asarray(np.abs(one.astype(np.float32) - other).mean(axis=(1, 2, 3), dtype=np.float64))


def turned(view: Array) -> Iterator[Array]:
    """What a wrong line of a converter, or a camera on its head, makes of a view (rows, columns, 3)."""
    yield from (view[:, ::-1], view[::-1], view[::-1, ::-1])
    yield view[..., ::-1]  # red for blue
    yield np.repeat(view.mean(axis=-1, keepdims=True), 3, axis=-1)  # gray
    if len(view) == len(view[0]):
        across = np.swapaxes(view, 0, 1)
        yield from (across, across[::-1], across[:, ::-1], across[::-1, ::-1])


def films_of_recording(recording: Recording, columns: Columns) -> Films:
    """Of a recording that demorec did not simulate: each image once, beside the first frame that holds it."""
    names = next((feature.names for feature in recording.info.features if feature.name == STATE), ())
    state = course_of(columns.features[STATE], names) if STATE in columns.features else None
    found = {}
    for camera in recording.cameras:
        cells, detail = parts_of(decode(recording.video_settings(camera), recording.packets(camera)))
        held, frames = np.unique(columns.images[camera], return_index=True)
        shown = (held != NO_IMAGE) & (held < len(cells))
        rows = frames[shown]
        film = Film(
            where=f"camera {camera}",
            fps=recording.info.fps,
            cells=cells[held[shown]],
            detail=detail[held[shown]],
            frames=rows,
            state=None if state is None else state[rows],
        )
        found[camera] = [film]
    return found


_MOST_LINES = 257
"""Of bytes, whose sum 16 bits hold."""


def parts_of(images: Iterable[NDArray[np.uint8]]) -> tuple[NDArray[np.uint8], Array]:
    """Images (H, W, 3) of one size in parts, and their detail, as `Film.cells` and `Film.detail`.

    What no whole part covers is left out.
    """
    found, detail = [], []
    for image in images:
        (height, width), counts = image.shape[:2], part_counts(image.shape[1], image.shape[0])
        columns, rows = min(counts[0], width), min(counts[1], height)
        down, across = height // rows, width // columns
        # Down first and then across, in few bytes: so NumPy adds many numbers at once.
        lines = image[: rows * down, : columns * across].reshape(rows, down, -1)
        sums = lines.sum(axis=1, dtype=np.uint16 if down <= _MOST_LINES else np.uint32)
        sums = sums.reshape(rows, columns, across, 3).sum(axis=2, dtype=np.uint32)
        found.append(np.rint(sums / (down * across)).astype(np.uint8))
        detail.append(detail_of(image[..., 1]))
    return np.stack(found) if found else np.zeros((0, 1, 1, 3), dtype=np.uint8), np.array(detail)


def likeness_of_films(films: Films) -> Iterator[tuple[str, float]]:
    """(two cameras and the episode, correlation of their images); 1 where they are alike in one episode alone."""
    for one, other in combinations(films, 2):
        found = dict[str, float]()
        for a, b in zip(films[one], films[other], strict=False):
            count = min(len(a.cells), len(b.cells))
            if count and a.cells.shape[1:] == b.cells.shape[1:]:
                found[f"{a.where} and {other}"] = correlation(a.cells[:count], b.cells[:count])
        differ = len(found) > 1 and np.median(list(found.values())) < _DIFFERENT
        yield from ((names, 1.0 if differ and value > _ALIKE else value) for names, value in found.items())
