"""The decoded images of a camera in one episode, as mean colours of small parts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby
from typing import NamedTuple, cast

import av
import numpy as np
from av.video.reformatter import VideoReformatter
from numpy.typing import NDArray

from demorec.core.errors import RecordingError
from demorec.core.geometry import Array
from demorec.datasets.lerobot.folder import LeRobotFolder
from demorec.datasets.lerobot.inspect import noted
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
        camera: Name, for people.
        episode: "episode 3", or "" where there is only one.
        fps: Frames per second.
        cells: (N, 16, 16, 3) mean colours of the parts of each image, 0 to 255.
        frames: (N,) frame that each image belongs to.
    """

    camera: str
    episode: str = ""
    fps: float
    cells: NDArray[np.uint8]
    frames: NDArray[np.intp]

    @property
    def where(self) -> str:
        """Camera and episode, for people."""
        return f"{self.camera}, {self.episode}" if self.episode else self.camera

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
        camera=f"camera {camera}",
        fps=recording.info.fps,
        cells=np.stack(cells)[held[shown]] if cells else np.zeros((0, 1, 1, 3), dtype=np.uint8),
        frames=frames[shown],
    )
    return CameraFilms([film], error)


def films_of_dataset(folder: LeRobotFolder, key: str) -> CameraFilms:
    """The images of a camera of a dataset in every episode in which they decode, in order."""
    found: list[Film] = []
    errors: list[str] = []
    reformatter = VideoReformatter()  # a frame's own would be set up again for each
    for path, group in groupby(enumerate(folder.listed), key=lambda item: item[1].videos[key][0]):
        with noted(errors, folder.root), opened_video(path) as opened:
            for number, place in group:
                cells: list[NDArray[np.uint8]] = []
                with noted(errors, folder.root):
                    cells = [_parts(image, reformatter) for image in folder.video(key, place).decoded(opened=opened)]
                if cells:
                    name, frames = f"episode {number}", np.arange(place.length)
                    found.append(
                        Film(camera=key, episode=name, fps=folder.info.fps, cells=np.stack(cells), frames=frames)
                    )
    more = f" (and {len(errors) - 1} more)" if len(errors) > 1 else ""
    return CameraFilms(found, errors[0] + more if errors else "")


def _parts(image: av.VideoFrame, reformatter: VideoReformatter) -> NDArray[np.uint8]:
    small = reformatter.reformat(image, _PARTS, _PARTS, "rgb24", interpolation="AREA")
    return cast("NDArray[np.uint8]", small.to_ndarray())
