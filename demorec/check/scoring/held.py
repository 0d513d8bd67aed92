"""What a hand holds, as a camera that moves with it sees it: by its colours, whatever it is.

While something is held it stands still in the images of such a camera, where the open hand shows what is behind. So do
the fingers, in all episodes alike. Other cameras see next to nothing that stands still, and are not judged.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from demorec.check.evidence import Flags
from demorec.check.scoring.neighbours import FEWEST
from demorec.core.geometry import Array

_SETTLED_S, _AWAY_S = 0.3, 0.5
"""Seconds after closing and before opening from which on something is held, and before and after which it is not."""
_FEWEST_HELD, _FEWEST_OPEN = 3, 2
"""Images that are needed of both."""
_ALIKE, _STILL, _CHANGED = 35, 0.8, 40
"""Levels, of 255, within which a pixel stands still, in which share of the images; and by which it is another one."""
_LIGHT, _HUE = 6, 14
"""Bins of lightness, and of each of two axes of colour, relative to the lightness."""
_DARK = 30.0
"""Levels added to a colour's brightest channel, so that black has none."""
_AGREED = 0.85
"""Share of the episodes that must show a colour for the others to lack it."""
_MOST, _SAME = 0.7, 0.1
"""Share of the episodes of an instruction that must show a colour, for it to be compared with other instructions; and
what those may lack at most of each other's colours."""
_HARDLY = 0.3
"""Share of what is usual of a colour, below which it is lacking: things differ in size."""
_LEAST = 0.01
"""Share of the image that something has at least, to be seen."""


def held_colors(
    images: NDArray[np.uint8], frames: NDArray[np.int64], grips: Sequence[tuple[int, int]], fps: float
) -> NDArray[np.float32]:
    """(1176,) share of the image that has each colour, of what stands still in it while something is held.

    Args:
        images: (N, H, W, 3).
        frames: (N,) of the images.
        grips: (first, last) frames; of several the largest share of each colour counts.
        fps: Frames per second.
    """
    found: NDArray[np.float32] = np.zeros(_LIGHT * _HUE * _HUE, np.float32)
    near = np.zeros(len(frames), np.bool_)
    for first, last in grips:
        near |= (frames > first - _AWAY_S * fps) & (frames < last + _AWAY_S * fps)
    if (~near).sum() < _FEWEST_OPEN:
        return found
    behind = np.median(images[~near], axis=0)
    for first, last in grips:
        within = images[(frames >= first + _SETTLED_S * fps) & (frames <= last - _SETTLED_S * fps)]
        if len(within) < _FEWEST_HELD:
            continue
        usual = np.median(within, axis=0)
        stands = (np.abs(within - usual).max(axis=3) < _ALIKE).mean(axis=0) >= _STILL
        stands &= np.abs(usual - behind).max(axis=2) > _CHANGED
        counts = np.bincount(_bins(usual[stands]), minlength=len(found))
        found = np.maximum(found, (counts / stands.size).astype(np.float32))
    return found


def _bins(pixels: Array) -> NDArray[np.int64]:
    """(P,) bin of each of (P, 3) pixels; light changes the first axis alone."""
    red, green, blue = pixels.T
    top = pixels.max(axis=1) + _DARK
    light = pixels.mean(axis=1) / 256 * _LIGHT
    across, along = ((axis / top + 1) / 2 * _HUE for axis in (red - green, blue - (red + green) / 2))
    return np.asarray((light.astype(np.int64) * _HUE + across.astype(np.int64)) * _HUE + along.astype(np.int64))


def lacking(colors: NDArray[np.float32], tasks: Sequence[str]) -> Array:
    """(N,) share of what others hold that each hand lacks; nan where hardly anything is seen in it, or few are alike.

    Compared are episodes of one instruction, and of others of which most hold the same. Where fewer than 85 in 100
    agree in a colour nothing lacks it.

    Args:
        colors: (N, 1176) by `held_colors`.
        tasks: Instruction of each.
    """
    shares = _around(colors.reshape(-1, _LIGHT, _HUE, _HUE), np.add)
    own = _around(shares, np.maximum)  # what is beside a usual colour is no other one
    found = np.full(len(colors), np.nan)
    for pool in _pools(shares, tasks, colors.sum(axis=1) >= _LEAST):
        if len(pool) >= FEWEST:
            found[pool] = _lack(np.quantile(shares[pool], 1 - _AGREED, axis=0), own[pool])
    return found


def _pools(shares: NDArray[np.float32], tasks: Sequence[str], seen: Flags) -> list[list[int]]:
    """Numbers of the episodes by what most of their instruction hold; those of which most do not agree are left out."""
    members: dict[str, list[int]] = {}
    for number in np.flatnonzero(seen).tolist():
        members.setdefault(tasks[number], []).append(number)
    pools: list[tuple[NDArray[np.float32], list[int]]] = []
    for numbers in sorted(members.values(), key=len, reverse=True):
        usual = np.quantile(shares[numbers], 1 - _MOST, axis=0)[None].astype(np.float32)
        if usual.max() < _LEAST:
            continue
        around = _around(usual, np.maximum)
        for other, pool in pools:
            if max(_lack(usual[0], _around(other, np.maximum))[0], _lack(other[0], around)[0]) < _SAME:
                pool += numbers
                break
        else:
            pools.append((usual, numbers))
    return [pool for _, pool in pools]


def _lack(usual: Array | NDArray[np.float32], own: NDArray[np.float32]) -> Array:
    """(N,) share of what is usual (...) that each of (N, ...) lacks."""
    if usual.max() < _LEAST:
        return np.zeros(len(own))
    lack = np.maximum(1 - own / np.maximum(_HARDLY * usual, 1e-9), 0.0) * usual
    return np.asarray(lack.sum(axis=(1, 2, 3)) / usual.sum())


def _around(shares: NDArray[np.float32], join: np.ufunc) -> NDArray[np.float32]:
    """(N, ...) joined with the bins beside, along all axes but the first."""
    for axis in range(1, shares.ndim):
        width = [(0, 0)] * shares.ndim
        width[axis] = (1, 1)
        padded = np.moveaxis(np.pad(shares, width), axis, 0)
        shares = np.moveaxis(join(join(padded[:-2], padded[1:-1]), padded[2:]), 0, axis)
    return shares
