"""Colour pictures into what video coders take: a plane of brightness, and two of colour with half the rows and columns.

ITU-R BT.601, 16 to 235, in whole numbers of 15 bits; colours are the mean of two columns and, weighted 1:3:3:1, of four
rows. To the bit as libswscale does it with its vector code on x86-64, which PyAV would ask otherwise, but in a third of
the time, and the same on every machine. Compiled by Numba; imported when first used.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

_njit: Any = numba.njit(cache=True)

i4 = np.int32
index = np.uintp  # an unsigned index spares the test for negative ones

# Shares of red, green and blue, times 2^15, in brightness and in both colours.
Y_RED, Y_GREEN, Y_BLUE = 8414, 16519, 3208
U_RED, U_GREEN, U_BLUE = -4865, -9528, 14392
V_RED, V_GREEN, V_BLUE = 14392, -12061, -2332


@_njit  # type: ignore[untyped-decorator]
def yuv420_from_rgb(
    picture: NDArray[np.uint8],
    luma: NDArray[np.uint8],
    blueness: NDArray[np.uint8],
    redness: NDArray[np.uint8],
) -> None:
    """Convert a picture of even height and width, both at least 8.

    Args:
        picture: (H, W, 3) red, green, blue, contiguous.
        luma, blueness, redness: (H, >= W) and twice (H / 2, >= W / 2) results, contiguous.
    """
    height, width, _ = picture.shape
    half = width // 2
    rgb = picture.reshape(-1)
    bright = luma.reshape(-1)
    pitch = luma.shape[1]
    pairs = np.empty(2 * height * half, np.int16)
    for y in range(height):
        start = 3 * y * width
        for x in range(width):
            p = index(start + 3 * x)
            r, g, b = i4(rgb[p]), i4(rgb[p + index(1)]), i4(rgb[p + index(2)])
            value = i4(i4(Y_RED * r + Y_GREEN * g + Y_BLUE * b + 0x80100) >> 9)
            bright[index(y * pitch + x)] = np.uint8(i4(value + 32) >> 6)
        for x in range(half):
            p = index(start + 6 * x)
            r = i4(i4(rgb[p]) + i4(rgb[p + index(3)]))
            g = i4(i4(rgb[p + index(1)]) + i4(rgb[p + index(4)]))
            b = i4(i4(rgb[p + index(2)]) + i4(rgb[p + index(5)]))
            u = i4(i4(U_RED * r + U_GREEN * g + U_BLUE * b + 0x800200) >> 10)
            v = i4(i4(V_RED * r + V_GREEN * g + V_BLUE * b + 0x800200) >> 10)
            q = y * half + x
            pairs[index(q)] = np.int16(min(i4(2 * u), i4(32767)))
            pairs[index(q + height * half)] = np.int16(min(i4(2 * v), i4(32767)))
    for plane in range(2):
        result = blueness if plane == 0 else redness
        colors = result.reshape(-1)
        pitch = result.shape[1]
        for y in range(height // 2):
            # Rows y - 1 to y + 2 of pairs; the shares of those beyond the picture go to its outermost rows.
            first = plane * height * half + 2 * y * half
            out = y * pitch
            if y == height // 2 - 1:
                for x in range(half):
                    q = first + x
                    total = 512 * i4(pairs[index(q - half)]) + 1536 * i4(pairs[index(q)])
                    total += 2048 * i4(pairs[index(q + half)]) + (1 << 18)
                    colors[index(out + x)] = np.uint8(min(i4(i4(total) >> 19), i4(255)))
            else:
                # Every product is cut to its upper half on its own, as vector code does it; 5 makes up for that.
                before = half if y > 0 else 0
                share, middle = (i4(512), i4(1536)) if y > 0 else (i4(0), i4(2048))
                for x in range(half):
                    q = first + x
                    before_it = i4(share * i4(pairs[index(q - before)])) >> 16
                    own = i4(middle * i4(pairs[index(q)])) >> 16
                    next_one = i4(1536 * i4(pairs[index(q + half)])) >> 16
                    last = i4(512 * i4(pairs[index(q + 2 * half)])) >> 16
                    colors[index(out + x)] = np.uint8(min(i4(i4(before_it + own + next_one + last + 5) >> 3), i4(255)))
