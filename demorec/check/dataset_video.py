"""The videos of a dataset, decoded once and summed up episode by episode."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import ExportError, describe_error
from demorec.core.geometry import Array
from demorec.datasets.lerobot.layout import DatasetInfo
from demorec.datasets.lerobot.mp4_index import check_video
from demorec.datasets.lerobot.reader import EpisodePlace

if TYPE_CHECKING:
    import av
    from av.video.reformatter import VideoReformatter

_PARTS = 16
"""Parts along the shorter side, about, whose mean colours stand for an image."""
_FEWEST_PARTS, _MOST_PARTS = 8, 32
"""Where no square part of as many divides both sides, there are `_PARTS` by `_PARTS` that are not square."""


@dataclass(frozen=True, kw_only=True, eq=False)
class EpisodeImages:
    """The colour images of one camera in one episode.

    Attributes:
        count: How many there are.
        mean: (3,) mean red, green and blue, of 1.
        std: (3,) their standard deviations over all pixels, of 1, by some of the images; NaN where these are few.
        cells: (count, rows, columns, 3) mean colours of the parts of each image, 0 to 255.
        detail: (count,) `detail_of` each image.
    """

    count: int
    mean: Array
    std: Array
    cells: NDArray[np.uint8]
    detail: Array


def episode_images(info: DatasetInfo, places: Sequence[EpisodePlace], key: str) -> list[EpisodeImages]:
    """Of every episode, in order, one episode in memory at a time.

    Raises:
        ExportError: A video cannot be decoded, or has too few images.
    """
    files: dict[Path, Iterator[_Decoded]] = {}
    ends: dict[Path, int] = {}
    found = []
    for place in places:
        path, first = place.videos[key]
        if path not in files:
            files[path] = _decoded(path, info.features[key].shape)
        lead, ends[path] = max(0, first - ends.get(path, 0)), first + place.length
        images = list(islice(files[path], lead, lead + place.length))
        if len(images) < place.length or not images:
            raise ExportError(
                f"Episode {place.episode_index} has {place.length} frames, {len(images)} images decode: {path}"
            )
        cells = np.stack([cell for cell, _, _ in images])
        mean = cells.mean(axis=(0, 1, 2), dtype=np.float64) / 255
        moments = [moment for _, _, moment in images if moment is not None]
        colour, squared = np.mean(moments, axis=0) if len(moments) >= _FEWEST else np.full((2, 3), np.nan)
        std = np.sqrt(np.maximum(squared - colour**2, 0.0))
        detail = np.array([one for _, one, _ in images])
        found.append(EpisodeImages(count=len(cells), mean=mean, std=std, cells=cells, detail=detail))
    return found


_Decoded = tuple[NDArray[np.uint8], float, Array | None]
_EVERY, _FEWEST = 8, 8
"""Of so many images one is looked at pixel by pixel, and of how many at least an episode's deviation is told."""


def _decoded(path: Path, shape: tuple[int, ...]) -> Iterator[_Decoded]:
    """(rows, columns, 3) mean colours of the parts of every image, 0 to 255, and `detail_of` it; of some (2, 3) means
    of colours of 1, and of their squares, over all pixels.
    """
    import av
    from av.video.reformatter import VideoReformatter

    check_video(path)
    height, width = shape[:2]
    columns, rows = part_counts(width, height)
    reformatter, in_gray = VideoReformatter(), VideoReformatter()  # a frame's own would be set up anew for each
    try:
        with av.open(str(path), format="mp4") as container:
            for stream in container.streams.video:  # a few bytes can announce images of gigabytes
                stream.codec_context.options = {"max_pixels": str((height + 128) * (width + 128))}
            for number, frame in enumerate(container.decode(video=0)):
                small = reformatter.reformat(frame, columns, rows, "rgb24", interpolation="AREA")
                cells = cast("NDArray[np.uint8]", small.to_ndarray())
                yield cells, _detail(frame, in_gray), None if number % _EVERY else _moments(frame)
    except (OSError, av.FFmpegError) as error:
        raise ExportError(f"The video cannot be decoded ({describe_error(error)}): {path}") from error


def _detail(frame: av.VideoFrame, reformatter: VideoReformatter) -> float:
    """`detail_of` the brightness; of the plane that has it, which is faster, where that is 16 to 235."""
    if frame.format.name == "yuv420p":
        plane = frame.planes[0]
        rows = np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)[:, : frame.width]
        return detail_of(rows) * (255 / 219) ** 2
    return detail_of(cast("NDArray[np.uint8]", reformatter.reformat(frame, format="gray").to_ndarray()))


def _moments(frame: av.VideoFrame) -> Array:
    lines = frame.to_ndarray(format="rgb24").reshape(frame.height, -1)
    # Down first and then across: so NumPy adds many bytes at once.
    sums = [part.sum(axis=0, dtype=np.uint32) for part in (lines, np.square(lines, dtype=np.uint16))]
    return np.asarray(np.stack(sums).reshape(2, -1, 3).mean(axis=1) / frame.height / [[255], [255**2]])


def detail_of(gray: NDArray[np.uint8]) -> float:
    """Mean square of the differences of neighbouring pixels (H, W), of 255: falls with blur and rises with noise.

    Of every second line to either side.
    """
    across = np.subtract(gray[::2, 1:], gray[::2, :-1], dtype=np.int16)
    down = np.subtract(gray[1:, ::2], gray[:-1, ::2], dtype=np.int16)
    return sum(float(np.vdot(step, step)) / max(step.size, 1) for step in (across.astype("f4"), down.astype("f4")))


def part_counts(width: int, height: int) -> tuple[int, int]:
    """(columns, rows) of square parts that cover an image of a size; (16, 16) where there are none."""
    shorter, common = min(width, height), math.gcd(width, height)
    sides = [side for side in range(1, common + 1) if common % side == 0]
    side = min(sides, key=lambda side: abs(math.log(shorter / side / _PARTS)))
    if not _FEWEST_PARTS <= shorter // side <= _MOST_PARTS:
        return _PARTS, _PARTS
    return width // side, height // side
