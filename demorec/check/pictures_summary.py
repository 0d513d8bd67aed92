"""One pass over a camera's pictures: all that any check needs of them, so that they are decoded once."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.check.drawn import CellGrid, Cells, Kind, planes_of
from demorec.errors import RecordingError
from demorec.geometry import Array
from demorec.recording import Recording
from demorec.scene.scene import Camera

_BATCH = 16


@dataclass(frozen=True, kw_only=True, eq=False)
class PictureSummary:
    """What is known of N pictures of a camera after decoding them.

    Attributes:
        error: Why decoding ended early, or "".
        mean: (N, 3) mean colour, 0..255; empty rows for depth and labels.
        dark, bright: (N,) share of pixels that are nearly black or nearly white.
        cells: (N, h, w, channels) means over small areas, 0..255.
    """

    error: str
    mean: Array
    dark: Array
    bright: Array
    cells: Cells

    @property
    def num_pictures(self) -> int:
        """N: how many could be decoded."""
        return len(self.cells)


def summarise(recording: Recording, camera: Camera, kind: Kind) -> PictureSummary:
    """Decode all pictures of a camera once."""
    read: dict[Kind, Callable[[str], Iterator[NDArray[Any]]]] = {
        "color": recording.images,
        "depth": recording.depth,
        "labels": recording.segmentation,
    }
    grid = CellGrid(camera.width, camera.height)
    means, dark, bright, cells = [], [], [], []
    error = ""
    try:
        for batch in _batches(read[kind](camera.name)):
            planes = planes_of(kind, batch)
            cells.append(grid.means(planes))
            means.append(np.stack([plane.mean(axis=(1, 2)) for plane in planes], axis=1))
            grey = sum(planes[1:], planes[0]) * np.float32(1 / len(planes))
            dark.append((grey < 12).mean(axis=(1, 2)))
            bright.append((grey > 250).mean(axis=(1, 2)))
    except RecordingError as problem:
        error = str(problem)
    return PictureSummary(
        error=error,
        mean=np.concatenate(means) if means else np.empty((0, 3)),
        dark=np.concatenate(dark) if dark else np.empty(0),
        bright=np.concatenate(bright) if bright else np.empty(0),
        cells=np.concatenate(cells) if cells else np.empty((0, 2, 2, 1), dtype=np.float32),
    )


def _batches(pictures: Iterable[NDArray[Any]]) -> Iterator[NDArray[Any]]:
    batch: list[NDArray[Any]] = []
    try:
        for picture in pictures:
            batch.append(picture)
            if len(batch) == _BATCH:
                yield np.stack(batch)
                batch = []
    except Exception:
        if batch:  # what came before the damage counts
            yield np.stack(batch)
        raise
    if batch:
        yield np.stack(batch)
