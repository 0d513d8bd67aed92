"""The colour images of a camera in one episode beside what the robot does, whoever recorded them.

Nothing is drawn: laws of images over time hold where neither scene nor calibration is known.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from demorec.check.cells import correlation
from demorec.check.dataset_video import part_counts
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
        frames: (N,) frame that each image belongs to.
        state: (N, D) observation.state in these frames, None where there is none.
    """

    where: str
    fps: float
    cells: NDArray[np.uint8]
    frames: NDArray[np.intp]
    state: Array | None

    @cached_property
    def step(self) -> Array:
        """(N - 1,) mean difference of each image from the one before, of 255."""
        return difference(self.cells[1:], self.cells[:-1])

    @cached_property
    def first_view(self) -> Array:
        """(rows, columns, 3) median of the first fifth of the images, 0 to 255."""
        return np.asarray(np.median(self.cells[: max(len(self.cells) // 5, 1)], axis=0))


_BLANK_LEVELS = 1.0
"""Of 255, standard deviation over an image's parts below which it is of one colour: black, green or otherwise empty."""


def flat_images(film: Film) -> NDArray[np.bool_]:
    """(N,) images of one colour."""
    return np.asarray(film.cells.std(axis=(1, 2)).max(axis=1, initial=0.0) < _BLANK_LEVELS)


def is_blank(film: Film) -> bool:
    """Whether most of its images are of one colour."""
    return bool(np.mean(flat_images(film)) > 0.5) if len(film.cells) else False


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


def films_of_recording(recording: Recording, columns: Columns) -> Films:
    """Of a recording that demorec did not simulate: each image once, beside the first frame that holds it."""
    state = columns.features[STATE].astype(np.float64) if STATE in columns.features else None
    found = {}
    for camera in recording.cameras:
        cells = cells_of(decode(recording.video_settings(camera), recording.packets(camera)))
        held, frames = np.unique(columns.images[camera], return_index=True)
        shown = (held != NO_IMAGE) & (held < len(cells))
        rows = frames[shown]
        film = Film(
            where=f"camera {camera}",
            fps=recording.info.fps,
            cells=cells[held[shown]],
            frames=rows,
            state=None if state is None else state[rows],
        )
        found[camera] = [film]
    return found


_MOST_LINES = 257
"""Of bytes, whose sum 16 bits hold."""


def cells_of(images: Iterable[NDArray[np.uint8]]) -> NDArray[np.uint8]:
    """Images (H, W, 3) of one size in parts, as `Film.cells` has them; what no whole part covers is left out."""
    found = []
    for image in images:
        (height, width), counts = image.shape[:2], part_counts(image.shape[1], image.shape[0])
        columns, rows = min(counts[0], width), min(counts[1], height)
        down, across = height // rows, width // columns
        # Down first and then across, in few bytes: so NumPy adds many numbers at once.
        lines = image[: rows * down, : columns * across].reshape(rows, down, -1)
        sums = lines.sum(axis=1, dtype=np.uint16 if down <= _MOST_LINES else np.uint32)
        sums = sums.reshape(rows, columns, across, 3).sum(axis=2, dtype=np.uint32)
        found.append(np.rint(sums / (down * across)).astype(np.uint8))
    return np.stack(found) if found else np.zeros((0, 1, 1, 3), dtype=np.uint8)


def likeness_of_films(films: Films) -> Iterator[tuple[str, float]]:
    """(two cameras and the episode, correlation of their images), of the first three episodes."""
    for one, other in combinations(films, 2):
        for a, b in zip(films[one][:3], films[other][:3], strict=False):
            count = min(len(a.cells), len(b.cells))
            if count and a.cells.shape[1:] == b.cells.shape[1:]:
                yield f"{a.where} and {other}", correlation(a.cells[:count], b.cells[:count])
