"""Filmstrips with a size limit, so that a report about a thousand episodes still opens at once."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image

MAX_SHOWN = 1000
"""Maximum episodes that a page shows individually."""
MAX_STRIP_BYTES = 16_000
"""Maximum size of a filmstrip; base64 adds a third, and the page stays below 30 MB."""
_MOMENTS = 8
_HEIGHTS = (120, 104, 88, 72, 56, 40, 28)
"""Heights in pixels; the first one that fits the size limit is used."""
_MAX_ASPECT = 3.0
"""Maximum aspect ratio (width to height); wider images are squeezed."""
_QUALITY = 72


@dataclass(frozen=True, kw_only=True)
class Filmstrip:
    """Images of one camera next to each other, evenly spaced from the first frame to the last.

    Attributes:
        jpeg: The images as one JPEG file.
        camera: Camera name.
        moments: Number of images.
        width, height: Size of the whole strip, pixels.
    """

    jpeg: bytes
    camera: str
    moments: int
    width: int
    height: int


def filmstrip(
    camera: str, num_frames: int, images_at: Callable[[Sequence[int]], Iterable[NDArray[np.uint8]]]
) -> Filmstrip | None:
    """A strip of limited size; None if even the smallest is larger, or the episode is empty.

    Args:
        camera: Camera name.
        num_frames: Number of frames of the episode.
        images_at: Ascending frame numbers -> their images, (H, W, 3) uint8.
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
        if file.tell() <= MAX_STRIP_BYTES:
            return Filmstrip(
                jpeg=file.getvalue(), camera=camera, moments=len(images), width=strip.width, height=strip.height
            )
    return None
