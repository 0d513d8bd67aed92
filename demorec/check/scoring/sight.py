"""What is seen of one episode: a few images of each camera, evenly over it and at its grasp."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from demorec.check.scoring.held import held_colors
from demorec.core.geometry import Array

SAMPLED_S, MOST_SAMPLED = 0.25, 48
"""Seconds from one image that is decoded to the next, and how many are decoded of an episode at most."""
_CELLS = (16, 12)
"""Parts of an image, across and down, by whose mean colours it is compared with the next."""
_WIDEST = 160
"""Pixels across to which an image is reduced before its sharpness is measured."""
_HUES = 12
_CHANGED = 40
"""Levels, of 255, by which a pixel differs that shows something else at the end than at the beginning."""
_SATURATED = 0.25
"""Saturation from which a colour counts as one."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Sight:
    """Of one camera in one episode.

    Attributes:
        frames: (N,) that were decoded evenly over it.
        changes, most_changes: (N - 1,) levels, of 255, by which the parts of an image differ from those of the one
            before: their mean, and the part that differs most.
        brightness, contrast, sharpness: Of the middle one of the images, in levels.
        blank: Share of the images that show nothing.
        look: (C,) shares of colours: what is in the image at the grasp, and what comes and goes over the episode.
        held: (1176,) of `held_colors`.
    """

    frames: NDArray[np.int64]
    changes: Array
    most_changes: Array
    brightness: float
    contrast: float
    sharpness: float
    blank: float
    look: Array
    held: NDArray[np.float32]


def sampled_frames(length: int, fps: float) -> list[int]:
    """Which frames are decoded."""
    count = min(MOST_SAMPLED, max(2, round(length / fps / SAMPLED_S)), length)
    return sorted(set(np.linspace(0, length - 1, count).astype(int).tolist()))


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
    even = sampled_frames(length, fps)
    grasp = sum(grips[0]) // 2 if grips else length // 2
    wanted = sorted({*even, grasp, length - 1})
    cells, levels, reduced = [], [], []
    blank: NDArray[np.uint8] = np.zeros((1, 1, 3), np.uint8)
    first = held = last = blank
    for frame, image in zip(wanted, images_at(wanted), strict=True):
        small = _reduced(image)
        first = small if frame == 0 else first
        held = small if frame == grasp else held
        last = small if frame == length - 1 else last
        if frame in even:
            cells.append(np.asarray(Image.fromarray(image).resize(_CELLS, Image.Resampling.BOX), dtype=np.float32))
            levels.append(_quality(small))
            reduced.append(small)
    parts = np.stack(cells)
    quality = np.array(levels)
    differences = np.abs(np.diff(parts, axis=0)).astype(np.float64)
    changed = np.abs(first.astype(np.int16) - last).max(axis=2) > _CHANGED
    return Sight(
        frames=np.array(even),
        changes=differences.mean(axis=(1, 2, 3)),
        most_changes=differences.max(axis=(1, 2, 3)),
        brightness=float(np.median(quality[:, 0])),
        contrast=float(np.median(quality[:, 1])),
        sharpness=float(np.median(quality[:, 2])),
        blank=float((quality[:, 1] < 2).mean()),
        look=np.concatenate([_colors(held), _colors(first, changed), _colors(last, changed)]),
        held=held_colors(np.stack(reduced), np.array(even), grips, fps),
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
