"""The decoded images of a camera in one episode, as mean colours of small parts."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import ExportError, RecordingError
from demorec.core.geometry import Array
from demorec.datasets.lerobot.layout import DatasetInfo
from demorec.datasets.lerobot.reader import EpisodePlace
from demorec.datasets.lerobot.videos import opened_video
from demorec.episode.episode import NO_IMAGE, Columns
from demorec.mcap import Recording
from demorec.mcap.video import decode

_PARTS = 16
"""Parts along each side."""
_SAMPLE_EVERY = 8
"""Of so many images one is read pixel by pixel for the deviation of its colours."""
_MIN_SAMPLES = 8
"""Such images below which the deviation of an episode is not known."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Film:
    """N images of one camera in one episode.

    Attributes:
        where: Camera and episode, for people.
        fps: Frames per second.
        cells: (N, 16, 16, 3) mean colours of the parts of each image, 0 to 255.
        frames: (N,) frame that each image belongs to.
        deviation: (3,) standard deviation of each colour over all pixels, of 1; NaN where it is not known.
    """

    where: str
    fps: float
    cells: NDArray[np.uint8]
    frames: NDArray[np.intp]
    deviation: Array

    @cached_property
    def steps(self) -> Array:
        """(N - 1,) mean difference of each image from the one before, of 255."""
        later, earlier = self.cells[1:].astype(np.int16), self.cells[:-1].astype(np.int16)
        return np.asarray(np.abs(later - earlier).mean(axis=(1, 2, 3), dtype=np.float64))

    @property
    def mean(self) -> Array:
        """(3,) mean of each colour, of 1."""
        return np.asarray(self.cells.mean(axis=(0, 1, 2), dtype=np.float64) / 255)


class CameraFilms(NamedTuple):
    """The images of a camera in each episode, as far as they decode, and why they decode no further ("")."""

    films: Sequence[Film]
    error: str


_UNKNOWN = np.full(3, np.nan)


def film_of_recording(recording: Recording, columns: Columns, camera: str) -> CameraFilms:
    """Each image once, with the first frame that holds it."""
    cells: list[NDArray[np.uint8]] = []
    error = ""
    try:
        for image in decode(recording.video_settings(camera), recording.packets(camera)):
            cells.append(_cells_of(image))
    except RecordingError as problem:
        error = str(problem)
    held, frames = np.unique(columns.images[camera], return_index=True)
    shown = (held != NO_IMAGE) & (held < len(cells))
    film = Film(
        where=f"camera {camera}",
        fps=recording.info.fps,
        cells=np.stack(cells)[held[shown]] if cells else np.zeros((0, 1, 1, 3), dtype=np.uint8),
        frames=frames[shown],
        deviation=_UNKNOWN,
    )
    return CameraFilms([film], error)


def _cells_of(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Means of the parts of an image (H, W, 3); pixels beyond the last whole part are left out."""
    rows, columns = min(_PARTS, image.shape[0]), min(_PARTS, image.shape[1])
    height, width = image.shape[0] // rows, image.shape[1] // columns
    # Rows first: NumPy adds long lines fastest.
    lines = image[: rows * height, : columns * width].reshape(rows, height, -1).sum(axis=1, dtype=np.uint32)
    sums = lines.reshape(rows, columns, width, 3).sum(axis=2)
    return np.rint(sums / (height * width)).astype(np.uint8)


def films_of_dataset(info: DatasetInfo, places: Iterable[EpisodePlace], key: str) -> CameraFilms:
    """The images of a camera of a dataset in every episode, in order."""
    files: dict[Path, Iterator[_Decoded]] = {}
    ends: dict[Path, int] = {}
    found: list[Film] = []
    try:
        for place in places:
            path, first = place.videos[key]
            if path not in files:
                files[path] = _decoded(path)
            lead = max(0, first - ends.get(path, 0))
            ends[path] = first + place.length
            images = list(islice(files[path], lead, lead + place.length))
            if len(images) < place.length or not images:
                raise ExportError(
                    f"Episode {place.episode_index} has {place.length} frames, {len(images)} images decode: {path}"
                )
            found.append(_film(f"{key}, episode {place.episode_index}", info.fps, images))
    except ExportError as error:
        return CameraFilms(found, str(error))
    return CameraFilms(found, "")


class _Decoded(NamedTuple):
    """Parts of an image; of some, (2, 3) means of its colours, of 1, and of their squares, over all pixels."""

    cells: NDArray[np.uint8]
    moments: Array | None


def _film(where: str, fps: float, images: Sequence[_Decoded]) -> Film:
    samples = [image.moments for image in images if image.moments is not None]
    deviation = _UNKNOWN
    if len(samples) >= _MIN_SAMPLES:
        mean, square = np.mean(samples, axis=0)
        deviation = np.sqrt(np.maximum(square - mean**2, 0.0))
    cells = np.stack([image.cells for image in images])
    return Film(where=where, fps=fps, cells=cells, frames=np.arange(len(cells)), deviation=deviation)


def _decoded(path: Path) -> Iterator[_Decoded]:
    from av.video.reformatter import VideoReformatter

    reformatter = VideoReformatter()  # a frame's own would be set up again for each
    with opened_video(path) as (container, stream):
        stream.thread_type = "SLICE"
        for number, frame in enumerate(container.decode(stream)):
            small = reformatter.reformat(frame, _PARTS, _PARTS, "rgb24", interpolation="AREA")
            moments = None
            if number % _SAMPLE_EVERY == 0:
                pixels = frame.to_ndarray(format="rgb24").reshape(-1, 3)
                moments = np.stack(
                    [pixels.mean(axis=0) / 255, np.square(pixels, dtype=np.float32).mean(axis=0) / 255**2]
                )
            yield _Decoded(cast("NDArray[np.uint8]", small.to_ndarray()), moments)
