"""The loops over pixels and cells, compiled by Numba; imported when first used, since Numba takes a second to start.

They do not check that arrays have the sizes that they are said to have: their callers do. Where a picture is added up
in cells, `rows` (h + 1) and `columns` (w + 1) say where these begin, and where the last one ends.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

_njit: Any = numba.njit(cache=True)


@_njit  # type: ignore[untyped-decorator]
def sum_colors(
    picture: NDArray[np.uint8], rows: NDArray[np.int64], columns: NDArray[np.int64], sums: NDArray[np.float64]
) -> tuple[int, int]:
    """Fill sums (h, w, 3) of a picture (H, W, 3); how many pixels are nearly black (below 12) or white (above 250)."""
    # Down first and then across: so the compiler adds many bytes at once, three times as fast as cell by cell.
    width = picture.shape[1]
    lines = picture.reshape(picture.shape[0], 3 * width)
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


@_njit  # type: ignore[untyped-decorator]
def _bases(drawn: NDArray[np.float32], i: int, j: int, channel: int) -> tuple[float, float, float, float]:
    """How a cell of a picture (h, w, channels) changes when it is shifted right, down, enlarged, or turned."""
    height, width, _ = drawn.shape
    above, below, before, after = max(i - 1, 0), min(i + 1, height - 1), max(j - 1, 0), min(j + 1, width - 1)
    down = (drawn[below, j, channel] - drawn[above, j, channel]) / (below - above)
    right = (drawn[i, after, channel] - drawn[i, before, channel]) / (after - before)
    x, y = j - (width - 1) / 2, i - (height - 1) / 2
    # A picture that is shifted to the right by one cell is drawn(x - 1) = drawn - slope; and so on.
    return -right, -down, -(x * right + y * down), -(x * down - y * right)


@_njit  # type: ignore[untyped-decorator]
def normal_equations(
    seen: NDArray[np.float32],
    drawn: NDArray[np.float32],
    frames: NDArray[np.int64],
    gram: NDArray[np.float64],
    right: NDArray[np.float64],
) -> None:
    """Add gram (4, 4) and right (4,) of the least squares seen - drawn = bases, over some frames of (T, h, w, c)."""
    _, height, width, channels = drawn.shape
    for t in frames:
        for i in range(height):
            for j in range(width):
                for c in range(channels):
                    bases = _bases(drawn[t], i, j, c)
                    error = seen[t, i, j, c] - drawn[t, i, j, c]
                    for m in range(4):
                        right[m] += bases[m] * error
                        for n in range(4):
                            gram[m, n] += bases[m] * bases[n]


@_njit  # type: ignore[untyped-decorator]
def add_bases(drawn: NDArray[np.float32], amounts: NDArray[np.float64], fitted: NDArray[np.float32]) -> None:
    """Fill fitted (T, h, w, c): drawn, but shifted, enlarged and turned by so much."""
    num_frames, height, width, channels = drawn.shape
    for t in range(num_frames):
        for i in range(height):
            for j in range(width):
                for c in range(channels):
                    right, down, larger, turned = _bases(drawn[t], i, j, c)
                    change = amounts[0] * right + amounts[1] * down + amounts[2] * larger + amounts[3] * turned
                    fitted[t, i, j, c] = drawn[t, i, j, c] + change


@_njit  # type: ignore[untyped-decorator]
def squares(
    a: NDArray[np.float32], b: NDArray[np.float32], frames: NDArray[np.int64], late: int, sums: NDArray[np.float64]
) -> None:
    """Fill sums (N,): squared differences of b (T, K) at each frame from a (T, K) so many frames later."""
    for i in range(len(frames)):
        x, y = a[frames[i] + late], b[frames[i]]
        total = 0.0
        for k in range(len(y)):
            difference = x[k] - y[k]
            total += difference * difference
        sums[i] = total


@_njit  # type: ignore[untyped-decorator]
def squares_between(
    rows: NDArray[np.float32],
    before: NDArray[np.int64],
    after: NDArray[np.int64],
    share: NDArray[np.float64],
    sums: NDArray[np.float64],
) -> None:
    """Fill sums (N,): squared differences of each of rows (T, K) from the mean of two others, weighted by share."""
    for t in range(len(sums)):
        weight = np.float32(share[t])
        x, a, b = rows[t], rows[before[t]], rows[after[t]]
        total = 0.0
        for k in range(len(x)):
            difference = x[k] - (a[k] + weight * (b[k] - a[k]))
            total += difference * difference
        sums[t] = total


@_njit  # type: ignore[untyped-decorator]
def compare_steps(
    seen: NDArray[np.float32], drawn: NDArray[np.float32], moved: NDArray[np.float64], shown: NDArray[np.float64]
) -> None:
    """Fill moved (T,) with the squared change of drawn (T, K) from frame to frame, shown (T,) with its product with
    the change of seen (T, K); 0 at the first frame."""
    for t in range(1, len(seen)):
        size = product = 0.0
        for k in range(seen.shape[1]):
            step = drawn[t, k] - drawn[t - 1, k]
            size += step * step
            product += step * (seen[t, k] - seen[t - 1, k])
        moved[t], shown[t] = size, product
