"""What is seen of one episode: a few images of each camera, evenly over it and at its grasp.

What a hand holds is seen by its colours, whatever it is: while something is held it stands still in the images of a
camera that moves with the hand, where the open hand shows what is behind. So do the fingers, in all episodes alike.
Other cameras see next to nothing that stands still, and are not judged.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from demorec.core.geometry import Array

_SAMPLED_S, _MOST_SAMPLED = 0.25, 48
"""Seconds from one image that is decoded to the next, and how many are decoded of an episode at most."""
_CELLS = (16, 12)
"""Parts of an image, across and down, by whose mean colours it is compared with the next."""
_WIDEST = 160
"""Pixels across to which an image is reduced before its sharpness is measured."""
_HUES = 12
_CHANGED = 40
"""Levels, of 255, by which a pixel differs that shows something else."""
_SATURATED = 0.25
"""Saturation from which a colour counts as one."""
_SETTLED_S, _AWAY_S = 0.3, 0.5
"""Seconds after closing and before opening from which on something is held, and before and after which it is not."""
_FEWEST_HELD, _FEWEST_OPEN = 3, 2
"""Images that are needed of both."""
_ALIKE, _STILL = 35, 0.8
"""Levels, of 255, within which a pixel stands still, and in which share of the images."""
LIGHT, HUE = 6, 14
"""Bins of lightness, and of each of two axes of colour, relative to the lightness."""
_DARK = 30.0
"""Levels added to a colour's brightest channel, so that black has none."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Sight:
    """Of one camera in one episode.

    Attributes:
        frames: (N,) that were decoded evenly over it.
        changes, most_changes: (N - 1,) levels, of 255, by which the parts of an image differ from those of the one
            before: their mean, and the part that differs most.
        quantities: "brightness" in levels and "sharpness", its logarithm, of the middle one of the images; "blank",
            share of the images that show nothing.
        look: (C,) shares of colours: what is in the image at the grasp, and what comes and goes over the episode.
        held: (1176,) share of the image that has each colour, of what stands still while something is held.
    """

    frames: NDArray[np.int64]
    changes: Array
    most_changes: Array
    quantities: Mapping[str, float]
    look: Array
    held: NDArray[np.float32]


def sight(
    images_at: Callable[[Sequence[int]], Iterator[NDArray[np.uint8]]],
    length: int,
    fps: float,
    grips: Sequence[tuple[int, int]],
) -> Sight:
    """Look at an episode.

    Args:
        images_at: Gives (H, W, 3) images of frames in rising order.
        length, fps: Of the episode.
        grips: (first, last) frames between which something is held.
    """
    count = min(_MOST_SAMPLED, max(2, round(length / fps / _SAMPLED_S)), length)
    even = np.unique(np.linspace(0, length - 1, count).astype(int))
    grasp = sum(grips[0]) // 2 if grips else length // 2
    wanted = sorted({*even.tolist(), grasp, length - 1})
    cells, small = [], {}
    for frame, image in zip(wanted, images_at(wanted), strict=True):
        small[frame] = _reduced(image)
        if frame in even:
            cells.append(np.asarray(Image.fromarray(image).resize(_CELLS, Image.Resampling.BOX), dtype=np.float32))
    differences = np.abs(np.diff(np.stack(cells), axis=0)).astype(np.float64)
    first, last = small[0], small[length - 1]
    changed = np.abs(first.astype(np.int16) - last).max(axis=2) > _CHANGED
    reduced = np.stack([small[frame] for frame in even.tolist()])
    brightness, contrast, sharpness = np.array([_quality(image) for image in reduced]).T
    return Sight(
        frames=even,
        changes=differences.mean(axis=(1, 2, 3)),
        most_changes=differences.max(axis=(1, 2, 3)),
        quantities={
            "brightness": float(np.median(brightness)),
            "sharpness": math.log(float(np.median(sharpness)) + 0.1),
            "blank": float((contrast < 2).mean()),
        },
        look=np.concatenate([_colors(small[grasp]), _colors(first, changed), _colors(last, changed)]),
        held=_held_colors(reduced, even, grips, fps),
    )


def _reduced(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    height, width = image.shape[:2]
    if width <= _WIDEST:
        return image
    size = (_WIDEST, max(1, round(height * _WIDEST / width)))
    return np.asarray(Image.fromarray(image).resize(size, Image.Resampling.BOX))


def _quality(image: NDArray[np.uint8]) -> tuple[float, float, float]:
    """Brightness, contrast and sharpness."""
    grey = image.astype(np.float32).mean(axis=2)
    inner = grey[1:-1, 1:-1]
    if not inner.size:
        return float(grey.mean()), float(grey.std()), 0.0
    edges = np.abs(4 * inner - grey[:-2, 1:-1] - grey[2:, 1:-1] - grey[1:-1, :-2] - grey[1:-1, 2:])
    return float(grey.mean()), float(grey.std()), float(edges.mean())


def _colors(image: NDArray[np.uint8], mask: NDArray[np.bool_] | None = None) -> Array:
    """(12,) share of the image that has each hue, of what is coloured and within a mask."""
    pixels = image.reshape(-1, 3).astype(np.float64)
    high, low = pixels.max(axis=1), pixels.min(axis=1)
    spread = np.maximum(high - low, 1e-9)
    r, g, b = pixels.T
    sector = np.where(high == r, (g - b) / spread % 6, np.where(high == g, (b - r) / spread + 2, (r - g) / spread + 4))
    weight = np.where((spread > _SATURATED * np.maximum(high, 1)) & (high > 30), 1.0, 0.0)
    if mask is not None:
        weight *= mask.reshape(-1)
    hue = np.floor(sector / 6 * _HUES + 0.5).astype(int) % _HUES
    return np.bincount(hue, weights=weight, minlength=_HUES)[:_HUES] / len(pixels)


def _held_colors(
    images: NDArray[np.uint8], frames: NDArray[np.int64], grips: Sequence[tuple[int, int]], fps: float
) -> NDArray[np.float32]:
    """`Sight.held` by images (N, H, W, 3) of frames (N,); of several grips the largest share of each colour counts."""
    found: NDArray[np.float32] = np.zeros(LIGHT * HUE * HUE, np.float32)
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
    light = pixels.mean(axis=1) / 256 * LIGHT
    across, along = ((axis / top + 1) / 2 * HUE for axis in (red - green, blue - (red + green) / 2))
    return np.asarray((light.astype(np.int64) * HUE + across.astype(np.int64)) * HUE + along.astype(np.int64))
