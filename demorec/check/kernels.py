"""Images added up in cells, by loops that Numba compiles: imported when first used, since it takes a second to start.

They do not check that arrays have the sizes that they are said to have: their callers do. `rows` (h + 1) and `columns`
(w + 1) say where cells begin, and where the last one ends.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.core.compiled import njit

_njit: Any = njit(cache=True)


@_njit  # type: ignore[untyped-decorator]
def sum_colors(
    image: NDArray[np.uint8], rows: NDArray[np.int64], columns: NDArray[np.int64], sums: NDArray[np.float64]
) -> tuple[int, int]:
    """Fill sums (h, w, 3) of an image (H, W, 3); how many pixels are nearly black (below 12) or white (above 250)."""
    # Down first and then across: so the compiler adds many bytes at once, three times as fast as cell by cell.
    width = image.shape[1]
    lines = image.reshape(image.shape[0], 3 * width)
    down = np.empty(3 * width, dtype=np.uint32)
    dark = bright = 0
    for i in range(len(rows) - 1):
        down[:] = 0
        for y in range(rows[i], rows[i + 1]):
            line = lines[y]
            for k in range(len(line)):
                down[k] += line[k]
            for x in range(width):
                total = np.int32(line[3 * x]) + np.int32(line[3 * x + 1]) + np.int32(line[3 * x + 2])
                dark += int(total < 3 * 12)
                bright += int(total > 3 * 250)
        for j in range(len(columns) - 1):
            red = green = blue = 0
            for x in range(columns[j], columns[j + 1]):
                red += down[3 * x]
                green += down[3 * x + 1]
                blue += down[3 * x + 2]
            sums[i, j, 0], sums[i, j, 1], sums[i, j, 2] = red, green, blue
    return dark, bright


@_njit  # type: ignore[untyped-decorator]
def sum_depths(
    metres: NDArray[np.float32],
    rows: NDArray[np.int64],
    columns: NDArray[np.int64],
    farthest: float,
    sums: NDArray[np.float64],
) -> None:
    """Fill sums (h, w, 1) of depths (H, W); what was not hit, or lies farther, counts as `farthest`."""
    for i in range(len(rows) - 1):
        for j in range(len(columns) - 1):
            total = 0.0
            for y in range(rows[i], rows[i + 1]):
                for x in range(columns[j], columns[j + 1]):
                    depth = metres[y, x]
                    total += depth if 0.0 < depth < farthest else farthest
            sums[i, j, 0] = total


@_njit  # type: ignore[untyped-decorator]
def sum_labels(
    labels: NDArray[np.int32], rows: NDArray[np.int64], columns: NDArray[np.int64], sums: NDArray[np.float64]
) -> None:
    """Fill sums (h, w, 2) of two brightnesses for each label (H, W), far apart for neighbouring labels."""
    for i in range(len(rows) - 1):
        for j in range(len(columns) - 1):
            first = second = 0
            for y in range(rows[i], rows[i + 1]):
                for x in range(columns[j], columns[j + 1]):
                    label = np.int64(labels[y, x])
                    # Body and link; of the products the upper bits are scattered best (Knuth's hash).
                    number = (label & 0xFFFFFF) + 1009 * (label >> 24) + 2
                    first += int(((number * 2654435761) >> 16) & 255)
                    second += int(((number * 2246822519) >> 16) & 255)
            sums[i, j, 0], sums[i, j, 1] = first, second
