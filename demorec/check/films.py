"""The decoded images of a camera in one episode, as mean colours of small parts."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import NamedTuple, cast

import av
import numpy as np
from av.video.reformatter import VideoReformatter
from numpy.typing import NDArray

from demorec.core.errors import ExportError, RecordingError
from demorec.core.geometry import Array
from demorec.datasets.lerobot.layout import DatasetInfo
from demorec.datasets.lerobot.reader import EpisodePlace
from demorec.datasets.lerobot.videos import opened_video
from demorec.episode.episode import NO_IMAGE, Table
from demorec.mcap import Recording
from demorec.mcap.video import decode

_PARTS = 16
"""Parts along each side."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Film:
    """N images of one camera in one episode.

    Attributes:
        where: Camera and episode, for people.
        fps: Frames per second.
        cells: (N, 16, 16, 3) mean colours of the parts of each image, 0 to 255.
        frames: (N,) frame that each image belongs to.
    """

    where: str
    fps: float
    cells: NDArray[np.uint8]
    frames: NDArray[np.intp]

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


def film_of_recording(recording: Recording, table: Table, camera: str) -> CameraFilms:
    """Each image once, with the first frame that holds it."""
    cells: list[NDArray[np.uint8]] = []
    error = ""
    reformatter = VideoReformatter()
    try:
        for image in decode(recording.video_settings(camera), recording.packets(camera)):
            cells.append(_parts(av.VideoFrame.from_ndarray(image, "rgb24"), reformatter))
    except RecordingError as problem:
        error = str(problem)
    held, frames = np.unique(table.images[camera], return_index=True)
    shown = (held != NO_IMAGE) & (held < len(cells))
    film = Film(
        where=f"camera {camera}",
        fps=recording.info.fps,
        cells=np.stack(cells)[held[shown]] if cells else np.zeros((0, 1, 1, 3), dtype=np.uint8),
        frames=frames[shown],
    )
    return CameraFilms([film], error)


def films_of_dataset(info: DatasetInfo, places: Iterable[EpisodePlace], key: str) -> CameraFilms:
    """The images of a camera of a dataset in every episode, in order."""
    files: dict[Path, Iterator[NDArray[np.uint8]]] = {}
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
            where = f"{key}, episode {place.episode_index}"
            found.append(Film(where=where, fps=info.fps, cells=np.stack(images), frames=np.arange(place.length)))
    except ExportError as error:
        return CameraFilms(found, str(error))
    return CameraFilms(found, "")


def _decoded(path: Path) -> Iterator[NDArray[np.uint8]]:
    """The parts of every image."""
    reformatter = VideoReformatter()  # a frame's own would be set up again for each
    with opened_video(path) as (container, stream):
        stream.thread_type = "SLICE"
        for frame in container.decode(stream):
            yield _parts(frame, reformatter)


def _parts(image: av.VideoFrame, reformatter: VideoReformatter) -> NDArray[np.uint8]:
    small = reformatter.reformat(image, _PARTS, _PARTS, "rgb24", interpolation="AREA")
    return cast("NDArray[np.uint8]", small.to_ndarray())
