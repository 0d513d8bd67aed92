"""Images as means over small areas: what the checks keep of every image, recorded or drawn."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import RecordingError

Cells = NDArray[np.float32]
"""(T, h, w, channels), 0..255."""
ImageKind = Literal["color", "depth", "labels"]

CELLS = 28
"""Cells along the longer side, about."""
FEWEST_CELLS, MOST_CELLS = 20, 36
"""The same at least and at most: all cells of a grid are equal squares, since unequal ones would show things shifted by
a part of a pixel, and few sizes can be cut into 28."""
DEPTH_RANGE = 3.0
"""Metres that are brightness 255; what is farther is not told apart."""
CHANNELS: dict[ImageKind, int] = {"color": 3, "depth": 1, "labels": 2}
"""Brightnesses that stand for a pixel: red, green and blue; how far it is; two for what it belongs to."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ImageCells:
    """One image in cells.

    Attributes:
        cells: (h, w, channels) means, 0..255.
        mean: (channels,) of the whole image.
        dark, bright: Share of the pixels that are nearly black or nearly white; 0 for depth and labels.
    """

    cells: Cells
    mean: NDArray[np.float64]
    dark: float
    bright: float


class CellGrid:
    """Means over a grid of equal squares in the middle of images of one size, but for a narrow border of some sizes.

    Args:
        width, height: Of the images, pixels.
        counts: (columns, rows) of the grid; default: those for images of this size.
    """

    def __init__(self, width: int, height: int, counts: tuple[int, int] | None = None) -> None:
        columns, rows = counts = counts or cell_counts(width, height)
        side = cell_side(width, height, counts)
        self._shape = rows, columns
        self._area = side * side
        # The border's cells are added up, too, for what is measured of the whole image.
        self._columns, self._rows = (_lines(count, side, size) for count, size in ((columns, width), (rows, height)))
        self._num_pixels = width * height
        size = (height, width)
        self._shapes: dict[ImageKind, tuple[int, ...]] = {"color": (*size, 3), "depth": size, "labels": size}

    def shape(self, kind: ImageKind) -> tuple[int, int, int]:
        """Of the cells of an image: (h, w, channels)."""
        return (*self._shape, CHANNELS[kind])

    def read(self, kind: ImageKind, image: NDArray[Any]) -> ImageCells:
        """An image (H, W, 3) uint8 of colours, (H, W) float32 metres or (H, W) int32 labels, as brightnesses.

        Raises:
            RecordingError: The image has another size.
        """
        from demorec.check import kernels

        if image.shape != self._shapes[kind]:
            raise RecordingError(
                f"An image ({kind}) has the shape {image.shape}, those of its camera {self._shapes[kind]}."
            )
        grid = self._rows, self._columns
        sums = np.empty((len(self._rows) - 1, len(self._columns) - 1, CHANNELS[kind]))
        dark = bright = 0
        if kind == "color":
            dark, bright = kernels.sum_colors(np.ascontiguousarray(image), *grid, sums)
        elif kind == "depth":
            kernels.sum_depths(np.ascontiguousarray(image, dtype=np.float32), *grid, DEPTH_RANGE, sums)
            sums *= 255 / DEPTH_RANGE
        else:
            kernels.sum_labels(np.ascontiguousarray(image, dtype=np.int32), *grid, sums)
        return ImageCells(
            cells=(sums[1:-1, 1:-1] / self._area).astype(np.float32),
            mean=sums.reshape(-1, CHANNELS[kind]).sum(axis=0) / self._num_pixels,
            dark=dark / self._num_pixels,
            bright=bright / self._num_pixels,
        )


def _lines(count: int, side: int, size: int) -> NDArray[np.int64]:
    """(count + 3,) where the border before, the cells and the border after begin, and where that ends."""
    inner = (size - count * side) // 2 + side * np.arange(count + 1)
    return np.concatenate([[0], inner, [size]])


def cell_counts(width: int, height: int) -> tuple[int, int]:
    """(columns, rows) of the grid for images of a size: it leaves out as little of them as possible.

    What it leaves out is even where that can be, so that it lies in the middle.
    """
    longer, shorter = max(width, height), min(width, height)
    sides = range(max(-(-longer // MOST_CELLS), 2), min(longer // FEWEST_CELLS, shorter // 2) + 1)

    def badness(side: int) -> tuple[bool, int, int]:
        columns, rows = width // side, height // side
        true_side = cell_side(width, height, (columns, rows))
        left = width - columns * true_side, height - rows * true_side
        return left[0] % 2 + left[1] % 2 > 0, -columns * rows * true_side**2, abs(longer // side - CELLS)

    side = min(sides, key=badness, default=max(min(longer // CELLS, shorter // 2), min(2, shorter // 2), 1))
    return width // side, height // side


def cell_side(width: int, height: int, counts: tuple[int, int]) -> int:
    """Pixels along the side of each cell of a grid with so many columns and rows."""
    return min(width // counts[0], height // counts[1])


def correlation(a: NDArray[Any], b: NDArray[Any]) -> float:
    """Of two tables of the same shape; 0 where one does not change."""
    x, y = (np.asarray(values, dtype=np.float32).reshape(-1) for values in (a, b))
    x, y = x - x.mean(), y - y.mean()
    # No BLAS: its threads wait for each other on a busy machine.
    size = math.sqrt(float(np.einsum("i,i->", x, x)) * float(np.einsum("i,i->", y, y)))
    return float(np.einsum("i,i->", x, y)) / size if size > 0 else 0.0
