"""Filmstrips within a budget of bytes, so that a report on a thousand episodes still opens at once."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from demorec.report.content import Filmstrip

_ALL_BYTES = 13_500_000
"""Of all filmstrips of a page together; as text they take a third more, and a page stays below 30 MB."""
_MOST_BYTES = 16_000
"""Of one filmstrip."""
_MOMENTS = 8
_HEIGHTS = (120, 104, 88, 72, 56, 40, 28)
"""Pixels; the first at which the strip is within its budget is taken."""
_WIDEST = 3.0
"""Ratio of width to height up to which pictures are shown as they are; beyond it they are squeezed."""
_QUALITY = 72


def strip_budget(num_strips: int) -> int:
    """How many bytes each of so many filmstrips on one page may have."""
    return min(_MOST_BYTES, _ALL_BYTES // max(num_strips, 1))


def filmstrip(
    camera: str,
    num_frames: int,
    pictures: Callable[[Sequence[int]], Iterable[NDArray[np.uint8]]],
    *,
    most_bytes: int,
) -> Filmstrip | None:
    """A strip of at most `most_bytes`; None where not even the smallest one is that small, or there is no frame.

    Args:
        camera: Its name.
        num_frames: Of the episode.
        pictures: Frames in rising order -> their pictures, (H, W, 3) uint8.
        most_bytes: Of the JPEG file.
    """
    if num_frames == 0:
        return None
    frames = np.unique(np.linspace(0, num_frames - 1, _MOMENTS).round().astype(int)).tolist()
    images = [Image.fromarray(picture) for picture in pictures(frames)]
    ratio = min(images[0].width / images[0].height, _WIDEST)
    for height in _HEIGHTS:
        width = max(1, round(height * ratio))
        strip = Image.new("RGB", (width * len(images), height))
        for number, image in enumerate(images):
            strip.paste(image.resize((width, height), reducing_gap=2.0), (number * width, 0))
        file = io.BytesIO()
        strip.save(file, "JPEG", quality=_QUALITY, optimize=True)
        if file.tell() <= most_bytes:
            return Filmstrip(
                jpeg=file.getvalue(), camera=camera, moments=len(images), width=strip.width, height=strip.height
            )
    return None
