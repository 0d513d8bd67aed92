"""Images of a camera, decoded once and kept as grey thumbnails with the change between consecutive ones."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

import av
import numpy as np
from av.video.reformatter import VideoReformatter
from numpy.typing import NDArray

from demorec.core.geometry import Array

SIDE = 16
"""Pixels along each side of a thumbnail."""
_MAX_SAMPLES = 96
"""Maximum number of pixels along each side for the comparison of consecutive images."""


@dataclass(frozen=True, kw_only=True, eq=False)
class EpisodeThumbnails:
    """The N images of one camera in one episode.

    Attributes:
        thumbnails: (N, 16, 16) grey, 0 to 255.
        change: (N,) mean difference of each image's pixels from the previous one, of 255; 0 for the first.
        colour: (3,) mean red, green and blue, 0 to 1.
        frames: (N,) frame of each image.
    """

    thumbnails: NDArray[np.uint8]
    change: NDArray[np.float32]
    colour: Array
    frames: NDArray[np.intp]

    def taken(self, numbers: NDArray[np.intp], frames: NDArray[np.intp]) -> EpisodeThumbnails:
        """Select some of the images, for these frames."""
        return EpisodeThumbnails(
            thumbnails=self.thumbnails[numbers],
            change=self.change[numbers],
            colour=self.colour,
            frames=frames,
        )

    @property
    def steps(self) -> Array:
        """Mean difference (N - 1,) of each thumbnail from the previous one, of 255."""
        later, earlier = self.thumbnails[1:].astype(np.int16), self.thumbnails[:-1].astype(np.int16)
        return np.asarray(np.abs(later - earlier).mean(axis=(1, 2), dtype=np.float64))

    @property
    def mean(self) -> Array:
        """Mean thumbnail (16, 16)."""
        return np.asarray(self.thumbnails.mean(axis=0, dtype=np.float64))


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraThumbnails:
    """The images of one camera.

    Attributes:
        episodes: Number of an episode -> its images, if they decode.
        errors: Number of an episode -> reason why its images do not decode.
    """

    episodes: dict[int, EpisodeThumbnails] = field(default_factory=dict)
    errors: dict[int, str] = field(default_factory=dict)


class Shrinker:
    """Shrinks the images of one camera with a shared converter; a frame's own would be set up again each time."""

    def __init__(self) -> None:
        self._reformatter = VideoReformatter()
        self._colours = VideoReformatter()

    def shrink(self, images: Iterable[av.VideoFrame], frames: NDArray[np.intp] | None = None) -> EpisodeThumbnails:
        """Read all images of an episode; `frames` are the frames of the images, by default consecutive."""
        thumbnails: list[NDArray[np.uint8]] = []
        changes: list[float] = []
        colours: list[Array] = []
        before: NDArray[np.int16] | None = None
        for number, image in enumerate(images):
            small = self._reformatter.reformat(image, SIDE, SIDE, "gray", interpolation="AREA")
            thumbnails.append(_brightness(small).copy())
            sampled = _sampled(image)
            changes.append(0.0 if before is None else _mean_size(sampled - before))
            before = sampled
            if number % 8 == 0:
                tiny = self._colours.reformat(image, SIDE, SIDE, "rgb24", interpolation="AREA")
                colours.append(tiny.to_ndarray().mean(axis=(0, 1)) / 255)
        count = len(thumbnails)
        return EpisodeThumbnails(
            thumbnails=np.stack(thumbnails) if count else np.zeros((0, SIDE, SIDE), dtype=np.uint8),
            change=np.array(changes, dtype=np.float32),
            colour=np.mean(colours, axis=0) if colours else np.zeros(3),
            frames=np.arange(count) if frames is None else frames,
        )


def _sampled(image: av.VideoFrame) -> NDArray[np.int16]:
    """Take every n-th pixel of the brightness of an image."""
    pixels = image.to_ndarray()[:, :, 1] if image.format.name == "rgb24" else _brightness(image)
    stride = max(1, -(-max(pixels.shape) // _MAX_SAMPLES))
    return pixels[::stride, ::stride].astype(np.int16)


def _brightness(image: av.VideoFrame) -> NDArray[np.uint8]:
    """View the first plane of an image, (H, W)."""
    plane = image.planes[0]
    return np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)[: image.height, : image.width]


def _mean_size(differences: NDArray[np.int16]) -> float:
    """Compute the mean of the magnitudes; a sum of integers is faster than `mean`."""
    return int(np.abs(differences).sum(dtype=np.int32)) / max(differences.size, 1)


def frames_of(arrays: Iterable[NDArray[np.uint8]]) -> Iterator[av.VideoFrame]:
    """Yield (H, W, 3) arrays as frames."""
    for array in arrays:
        yield av.VideoFrame.from_ndarray(np.ascontiguousarray(array), "rgb24")
