"""Images as means over small areas: what the checks keep of every image, recorded or drawn."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import RecordingError
from demorec.core.geometry import Array

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

_AT_ONCE = 256
"""Frames that are compared at once, so that what is computed of them stays small."""


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


def amount_of_detail(image: NDArray[np.uint8]) -> float:
    """The mean second difference along every fourth row of an image (H, W, 3), of green: noise, and sharp edges."""
    rows = image[2::4, :, 1].astype(np.int16)
    off = np.abs(2 * rows[:, 1:-1] - rows[:, :-2] - rows[:, 2:])
    return float(off.sum() / max(off.size, 1))


def correlation(a: NDArray[Any], b: NDArray[Any]) -> float:
    """Of two tables of the same shape; 0 where one does not change."""
    x, y = (np.asarray(values, dtype=np.float32).reshape(-1) for values in (a, b))
    x, y = x - x.mean(), y - y.mean()
    # No BLAS: its threads wait for each other on a busy machine.
    size = math.sqrt(float(np.einsum("i,i->", x, x)) * float(np.einsum("i,i->", y, y)))
    return float(np.einsum("i,i->", x, y)) / size if size > 0 else 0.0


def _blocks(frames: NDArray[np.int64]) -> Iterator[NDArray[np.int64]]:
    """Some frames at a time."""
    yield from (frames[first : first + _AT_ONCE] for first in range(0, len(frames), _AT_ONCE))


def _bases(drawn: Cells) -> tuple[Cells, Cells, NDArray[Any], NDArray[Any]]:
    """How images (N, h, w, c) change that are shifted right and down by a cell; x (w, 1) and y (h, 1, 1) of cells."""
    x, y = (np.asarray(np.arange(size) - (size - 1) / 2) for size in (drawn.shape[2], drawn.shape[1]))
    # An image that is shifted to the right by one cell is drawn(x - 1) = drawn - slope; and so on.
    right, down = (np.asarray(-np.gradient(drawn, axis=axis), dtype=np.float32) for axis in (2, 1))
    return right, down, x[:, None], y[:, None, None]


def normal_equations(seen: Cells, drawn: Cells, frames: NDArray[np.int64]) -> tuple[Array, Array]:
    """(4, 4) and (4,) of the least squares seen - drawn = bases, over some frames of (T, h, w, c): how these change
    when they are shifted right, down, enlarged, or turned."""
    gram, product = np.zeros((4, 4)), np.zeros(4)
    for some in _blocks(frames):
        right, down, x, y = _bases(drawn[some])
        bases = np.stack([right, down, x * right + y * down, x * down - y * right]).reshape(4, -1)
        gram += np.einsum("mk,nk->mn", bases, bases)
        product += np.einsum("mk,k->m", bases, (seen[some] - drawn[some]).reshape(-1))
    return gram, product


def moved(drawn: Cells, amounts: Array) -> Cells:
    """(T, h, w, c) drawn, but shifted right and down, enlarged and turned by so much."""
    found = np.empty_like(drawn)
    for some in _blocks(np.arange(len(drawn))):
        right, down, x, y = _bases(drawn[some])
        along_x, along_y = amounts[0] + amounts[2] * x - amounts[3] * y, amounts[1] + amounts[2] * y + amounts[3] * x
        found[some] = drawn[some] + along_x * right + along_y * down
    return found


def squares(a: Cells, b: Cells, frames: NDArray[np.int64], late: int = 0) -> Array:
    """(N,) squared differences of b (T, K) at each frame from a (T, K) so many frames later."""
    return _sums(frames, lambda some: [a[some + late] - b[some]] * 2)


def squares_between(rows: Cells, before: NDArray[np.int64], after: NDArray[np.int64], share: Array) -> Array:
    """(N,) squared differences of each of the first rows (T, K) from the mean of two others, weighted by share."""
    weight = share.astype(np.float32)[:, None]
    return _sums(
        np.arange(len(share)),
        lambda n: [rows[n] - (rows[before[n]] + weight[n] * (rows[after[n]] - rows[before[n]]))] * 2,
    )


def compare_steps(seen: Cells, drawn: Cells) -> tuple[Array, Array]:
    """(T,) squared change of drawn (T, K) since the frame before, and its product with that of seen; 0 at the first."""

    def step(cells: Cells, frames: NDArray[np.int64]) -> Cells:
        return np.asarray(cells[frames] - cells[np.maximum(frames - 1, 0)])

    frames = np.arange(len(seen))
    return (
        _sums(frames, lambda some: [step(drawn, some)] * 2),
        _sums(frames, lambda some: [step(drawn, some), step(seen, some)]),
    )


def _sums(frames: NDArray[np.int64], factors: Callable[[NDArray[np.int64]], Sequence[Cells]]) -> Array:
    """(N,) sum of the products of two tables (N, K), some frames at a time."""
    found = [np.einsum("tk,tk->t", *factors(some), dtype=np.float64) for some in _blocks(frames)]
    return np.concatenate(found) if found else np.zeros(0)
