"""Pixel loops compiled by Numba; imported at first use, since Numba takes a second to start."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.core.compiled import njit

_njit: Any = njit(cache=True)


@_njit  # type: ignore[untyped-decorator]
def _put(words: NDArray[np.uint32], groups: int, value: Any) -> Any:
    """Append one number at position `groups` (in groups of four bits) and return the next position."""
    while True:
        group = value & 7
        value >>= 3
        if value:
            group |= 8
        words[groups >> 3] |= np.uint32(group << (28 - 4 * (groups & 7)))
        groups += 1
        if value == 0:
            return groups


@_njit  # type: ignore[untyped-decorator]
def rvl_encode(pixels: NDArray[np.uint16], words: NDArray[np.uint32]) -> int:
    """Encode pixels (see `depth`) into zeroed words; return the number of words used."""
    position, groups, previous = 0, 0, np.int64(0)
    while position < len(pixels):
        start = position
        while position < len(pixels) and pixels[position] == 0:
            position += 1
        groups = _put(words, groups, position - start)
        start = position
        while position < len(pixels) and pixels[position] != 0:
            position += 1
        groups = _put(words, groups, position - start)
        for index in range(start, position):
            current = np.int64(pixels[index])
            delta = current - previous
            groups = _put(words, groups, (delta << 1) ^ (delta >> 63))
            previous = current
    return (groups + 7) >> 3


@_njit  # type: ignore[untyped-decorator]
def _get(words: NDArray[np.uint32], groups: int) -> tuple[Any, Any]:
    """Return the number at position `groups` and the next position; position -1 at the end of the data."""
    value, shift = np.int64(0), 0
    while groups >> 3 < len(words) and shift < 60:
        group = np.int64(words[groups >> 3] >> (28 - 4 * (groups & 7))) & 15
        groups += 1
        value |= (group & 7) << shift
        if group < 8:
            return value, groups
        shift += 3
    return np.int64(0), -1


@_njit  # type: ignore[untyped-decorator]
def rvl_decode(words: NDArray[np.uint32], pixels: NDArray[np.uint16]) -> bool:
    """Decode words into zeroed pixels; False if they do not fit."""
    position, groups, previous = 0, 0, 0
    while position < len(pixels):
        zeros, groups = _get(words, groups)
        if groups < 0 or position + zeros > len(pixels):
            return False
        position += zeros
        measured, groups = _get(words, groups)
        if groups < 0 or position + measured > len(pixels) or (zeros == 0 and measured == 0):
            return False
        for index in range(position, position + measured):
            coded, groups = _get(words, groups)
            if groups < 0:
                return False
            previous += (coded >> 1) ^ -(coded & 1)
            if not 0 < previous < 65536:
                return False
            pixels[index] = previous
        position += measured
    return True
