"""Filmstrips within a budget of bytes, so that a report on a thousand episodes still opens at once."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image

MAX_SHOWN = 4000
"""Episodes that a page shows one by one."""
_TOTAL_BYTES = 13_500_000
"""Of all filmstrips of a page together; as base64 they take a third more, and a page stays below 30 MB."""
_MAX_BYTES = 16_000
"""Of one filmstrip."""
_MOMENTS = 8
_HEIGHTS = (120, 104, 88, 72, 56, 40, 28)
"""Pixels; the first at which the strip is within its budget is taken."""
_MAX_ASPECT = 3.0
"""Ratio of width to height up to which images keep their shape; wider ones are squeezed."""
_QUALITY = 72


@dataclass(frozen=True, kw_only=True)
class Filmstrip:
    """Images of one camera side by side, evenly spaced from the first frame to the last.

    Attributes:
        jpeg: All of them as one JPEG file.
        camera: Name.
        moments: Number of images.
        width, height: Of the whole strip, pixels.
    """

    jpeg: bytes
    camera: str
    moments: int
    width: int
    height: int


def strip_budget(num_episodes: int) -> int:
    """Size limit, in bytes, of each filmstrip on a page about that many episodes."""
    return min(_MAX_BYTES, _TOTAL_BYTES // max(1, min(num_episodes, MAX_SHOWN)))


def filmstrip(
    camera: str,
    num_frames: int,
    images_at: Callable[[Sequence[int]], Iterable[NDArray[np.uint8]]],
    *,
    max_bytes: int,
) -> Filmstrip | None:
    """A strip of at most `max_bytes`; None if even the smallest is larger, or there is no frame.

    Args:
        camera: Its name.
        num_frames: Of the episode.
        images_at: Rising frame numbers -> their images, (H, W, 3) uint8.
        max_bytes: Of the JPEG file.
    """
    if num_frames == 0:
        return None
    frames = np.unique(np.linspace(0, num_frames - 1, _MOMENTS).round().astype(int)).tolist()
    images = [Image.fromarray(image) for image in images_at(frames)]
    aspect = min(images[0].width / images[0].height, _MAX_ASPECT)
    for height in _HEIGHTS:
        width = max(1, round(height * aspect))
        strip = Image.new("RGB", (width * len(images), height))
        for number, image in enumerate(images):
            strip.paste(image.resize((width, height), reducing_gap=2.0), (number * width, 0))
        file = io.BytesIO()
        strip.save(file, "JPEG", quality=_QUALITY, optimize=True)
        if file.tell() <= max_bytes:
            return Filmstrip(
                jpeg=file.getvalue(), camera=camera, moments=len(images), width=strip.width, height=strip.height
            )
    return None
