"""Pictures as means over small areas: what the checks keep of every picture, recorded or drawn."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from demorec.errors import RecordingError

Cells = NDArray[np.float32]
"""(T, h, w, channels), 0..255."""
ImageKind = Literal["color", "depth", "labels"]

CELLS = 28
"""Cells along the longer side, where so many fit."""
FEWEST_CELLS, MOST_CELLS = 20, 36
"""The same where other numbers make all cells equal squares: unequal ones shift what they show by a part of a pixel."""
DEPTH_RANGE = 3.0
"""Metres that are brightness 255; what is farther is not told apart."""
CHANNELS: dict[ImageKind, int] = {"color": 3, "depth": 1, "labels": 2}
"""Brightnesses that stand for a pixel: red, green and blue; how far it is; two for what it belongs to."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PictureCells:
    """One picture in cells.

    Attributes:
        cells: (h, w, channels) means, 0..255.
        mean: (channels,) of the whole picture.
        dark, bright: Share of the pixels that are nearly black or nearly white; 0 for depth and labels.
    """

    cells: Cells
    mean: NDArray[np.float64]
    dark: float
    bright: float


class CellGrid:
    """Means over a grid of (nearly) equal areas, for pictures of one size.

    Args:
        width, height: Of the pictures, pixels.
        counts: (columns, rows) of the grid; default: those for pictures of this size.
    """

    def __init__(self, width: int, height: int, counts: tuple[int, int] | None = None) -> None:
        columns, rows = counts or cell_counts(width, height)
        # Rounded, halves to even: with cells that all begin early, everything would lie farther right and down.
        self._columns, self._rows = (
            np.rint(np.arange(count + 1) * (size / count)).astype(np.int64)
            for count, size in ((columns, width), (rows, height))
        )
        self._areas = np.outer(np.diff(self._rows), np.diff(self._columns))[:, :, None]
        self._num_pixels = width * height
        size = (height, width)
        self._shapes: dict[ImageKind, tuple[int, ...]] = {"color": (*size, 3), "depth": size, "labels": size}

    def shape(self, kind: ImageKind) -> tuple[int, int, int]:
        """Of the cells of a picture: (h, w, channels)."""
        return (len(self._rows) - 1, len(self._columns) - 1, CHANNELS[kind])

    def read(self, kind: ImageKind, picture: NDArray[Any]) -> PictureCells:
        """A picture (H, W, 3) uint8 of colours, (H, W) float32 metres or (H, W) int32 labels, as brightnesses.

        Raises:
            RecordingError: The picture has another size.
        """
        from demorec.check import kernels

        if picture.shape != self._shapes[kind]:
            raise RecordingError(
                f"A picture ({kind}) has the shape {picture.shape}, those of its camera {self._shapes[kind]}."
            )
        grid = self._rows, self._columns
        sums = np.empty(self.shape(kind))
        dark = bright = 0
        if kind == "color":
            dark, bright = kernels.sum_colors(np.ascontiguousarray(picture), *grid, sums)
        elif kind == "depth":
            kernels.sum_depths(np.ascontiguousarray(picture, dtype=np.float32), *grid, DEPTH_RANGE, sums)
            sums *= 255 / DEPTH_RANGE
        else:
            kernels.sum_labels(np.ascontiguousarray(picture, dtype=np.int32), *grid, sums)
        return PictureCells(
            cells=(sums / self._areas).astype(np.float32),
            mean=sums.sum(axis=(0, 1)) / self._num_pixels,
            dark=dark / self._num_pixels,
            bright=bright / self._num_pixels,
        )


def cell_counts(width: int, height: int) -> tuple[int, int]:
    """(columns, rows) of the grid for pictures of a size: equal squares, at least two pixels wide, where it allows."""
    longer, shared = max(width, height), math.gcd(width, height)
    sides = [side for side in range(2, shared + 1) if shared % side == 0]
    fitting = [side for side in sides if FEWEST_CELLS <= longer // side <= MOST_CELLS]
    if fitting:
        side = min(fitting, key=lambda side: abs(longer // side - CELLS))
        return width // side, height // side
    count = min(CELLS, longer // 2)
    return max(round(count * width / longer), 2), max(round(count * height / longer), 2)
