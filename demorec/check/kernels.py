"""The loops over pixels and cells, compiled by Numba; imported when first used, since Numba takes a second to start.

They do not check that arrays have the sizes that they are said to have: their callers do. Where an image is added up
in cells, `rows` (h + 1) and `columns` (w + 1) say where these begin, and where the last one ends.
"""

from __future__ import annotations

import math
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


@_njit  # type: ignore[untyped-decorator]
def _bases(drawn: NDArray[np.float32], i: int, j: int, channel: int) -> tuple[float, float, float, float]:
    """How a cell of an image (h, w, channels) changes when it is shifted right, down, enlarged, or turned."""
    height, width, _ = drawn.shape
    above, below, before, after = max(i - 1, 0), min(i + 1, height - 1), max(j - 1, 0), min(j + 1, width - 1)
    down = (drawn[below, j, channel] - drawn[above, j, channel]) / (below - above)
    right = (drawn[i, after, channel] - drawn[i, before, channel]) / (after - before)
    x, y = j - (width - 1) / 2, i - (height - 1) / 2
    # An image that is shifted to the right by one cell is drawn(x - 1) = drawn - slope; and so on.
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


@_njit  # type: ignore[untyped-decorator]
def amount_of_detail(image: NDArray[np.uint8]) -> float:
    """The mean second difference along every fourth row of an image (H, W, 3), of green: noise, and sharp edges."""
    height, width, _ = image.shape
    total = count = 0
    for y in range(2, height, 4):
        for x in range(1, width - 1):
            total += abs(2 * np.int32(image[y, x, 1]) - image[y, x - 1, 1] - image[y, x + 1, 1])
        count += width - 2
    return total / max(count, 1)


@_njit  # type: ignore[untyped-decorator]
def _brightness(image: NDArray[np.uint8], y: int, x: int) -> float:
    """BT.601."""
    return float(0.299 * image[y, x, 0] + 0.587 * image[y, x, 1] + 0.114 * image[y, x, 2])


@_njit  # type: ignore[untyped-decorator]
def full_size_equations(
    seen: NDArray[np.uint8],
    expected: NDArray[np.uint8],
    drawn: NDArray[np.uint8],
    gram: NDArray[np.float64],
) -> int:
    """Add gram (8, 8) of the bases of the least squares seen - expected = bases, and of seen - expected, over images
    (N, H, W, 3); how many pixels were added.

    The bases are what the brightness of drawn changes by when it is shifted right and down (pixels), when x and y grow
    with x and y (four shares), and when it is blurred (half the variance, pixels squared).
    """
    count, height, width, _ = drawn.shape
    bases, used = np.empty(8), 0
    lines = np.empty((height, width))
    for n in range(count):
        for y in range(height):
            for x in range(width):
                lines[y, x] = _brightness(drawn[n], y, x)
        for i in range(1, height - 1):
            below = i - (height - 1) / 2
            for j in range(1, width - 1):
                beside = j - (width - 1) / 2
                across, down = (lines[i, j + 1] - lines[i, j - 1]) / 2, (lines[i + 1, j] - lines[i - 1, j]) / 2
                if across == 0.0 and down == 0.0:
                    continue
                around = lines[i, j + 1] + lines[i, j - 1] + lines[i + 1, j] + lines[i - 1, j]
                bases[0], bases[1], bases[2], bases[3] = -across, -down, -beside * across, -below * across
                bases[4], bases[5], bases[6] = -beside * down, -below * down, around - 4 * lines[i, j]
                bases[7] = _brightness(seen[n], i, j) - _brightness(expected[n], i, j)
                for a in range(8):
                    for b in range(8):
                        gram[a, b] += bases[a] * bases[b]
                used += 1
    return used


@_njit  # type: ignore[untyped-decorator]
def sum_colors_off(
    seen: NDArray[np.uint8], expected: NDArray[np.uint8], drawn: NDArray[np.uint8], sums: NDArray[np.float64]
) -> None:
    """Add to sums (N, 64, 7) of each drawn colour, four steps a channel: its pixels, how far red, green and blue of
    seen are from expected, and the squares of how far those of expected are from drawn; images (N, H, W, 3)."""
    count, height, width, _ = drawn.shape
    for n in range(count):
        for y in range(height):
            for x in range(width):
                color = (drawn[n, y, x, 0] // 64) * 16 + (drawn[n, y, x, 1] // 64) * 4 + drawn[n, y, x, 2] // 64
                sums[n, color, 0] += 1
                for c in range(3):
                    own = np.float64(expected[n, y, x, c]) - drawn[n, y, x, c]
                    sums[n, color, 1 + c] += np.float64(seen[n, y, x, c]) - expected[n, y, x, c]
                    sums[n, color, 4 + c] += own * own


CODED = 3.0
"""Levels, of 255, by which coding moves such a mix of two pixels."""


@_njit  # type: ignore[untyped-decorator]
def block_errors(
    seen: NDArray[np.uint8],
    expected: NDArray[np.uint8],
    drawn: NDArray[np.uint8],
    size: int,
    off: NDArray[np.float64],
    own: NDArray[np.float64],
) -> None:
    """Fill off and own (N, h, w): root mean square differences of seen and of expected from drawn, block by block.

    Smooth edges are drawn by 2x2 samples. Along an edge that lies on some of them, one sample of each pixel may fall to
    the other side by the last bit of a pose: a quarter of what two pixels differ by is no error, give or take `CODED`
    levels.
    """
    count, rows, columns = off.shape
    height, width = drawn.shape[1:3]
    for n in range(count):
        for i in range(rows):
            for j in range(columns):
                far = coder = 0.0
                for y in range(i * size, (i + 1) * size):
                    for x in range(j * size, (j + 1) * size):
                        for c in range(3):
                            true = np.float64(drawn[n, y, x, c])
                            contrast = max(
                                abs(drawn[n, max(y - 1, 0), x, c] - true),
                                abs(drawn[n, min(y + 1, height - 1), x, c] - true),
                                abs(drawn[n, y, max(x - 1, 0), c] - true),
                                abs(drawn[n, y, min(x + 1, width - 1), c] - true),
                            )
                            error = abs(seen[n, y, x, c] - true)
                            if error <= contrast / 4 + CODED:
                                error = max(error - contrast / 4, 0.0)
                            far += error**2
                            coder += (expected[n, y, x, c] - true) ** 2
                off[n, i, j] = math.sqrt(far / (3 * size * size))
                own[n, i, j] = math.sqrt(coder / (3 * size * size))
