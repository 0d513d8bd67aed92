"""The colour images of a camera in one episode beside what the robot does, whoever recorded them.

Nothing is drawn: laws of images over time hold where neither scene nor calibration is known.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray

from demorec.check.base import NotMeasured
from demorec.check.cells import correlation
from demorec.check.evidence import course_of
from demorec.core.errors import ExportError
from demorec.core.geometry import Array
from demorec.datasets.lerobot.layout import DatasetInfo
from demorec.datasets.lerobot.reader import EpisodePlace
from demorec.datasets.lerobot.videos import opened_video
from demorec.episode.episode import NO_IMAGE, Columns
from demorec.episode.features import STATE
from demorec.mcap import Recording
from demorec.mcap.video import decode

if TYPE_CHECKING:
    import av
    from av.video.reformatter import VideoReformatter


@dataclass(frozen=True, kw_only=True, eq=False)
class Film:
    """N images of one camera.

    Attributes:
        where: Camera and episode, for people.
        fps: Frames per second.
        cells: (N, rows, columns, 3) mean colours of the parts of each image, 0 to 255.
        detail: (N,) `detail_of` each image.
        frames: (N,) frame that each image belongs to.
        state: (N, D) observation.state in these frames by `course_of`, None where there is none.
        deviation: (3,) standard deviations of red, green and blue over all pixels, of 1, by some of the images; NaN
            where these are few; None where nobody asks.
    """

    where: str
    fps: float
    cells: NDArray[np.uint8]
    detail: Array
    frames: NDArray[np.intp]
    state: Array | None
    deviation: Array | None = None

    @cached_property
    def step(self) -> Array:
        """(N - 1,) mean difference of each image from the one before, of 255."""
        return difference(self.cells[1:], self.cells[:-1])

    @cached_property
    def speed(self) -> Array | None:
        """(N - 1,) how far the state goes from image to image, in standard deviations of its elements."""
        if self.state is None:
            return None
        return np.asarray(np.linalg.norm(np.diff(self.state / (self.state.std(axis=0) + 1e-3), axis=0), axis=1))

    @cached_property
    def moves(self) -> NDArray[np.bool_]:
        """(N - 1,) from which image to the next the robot moves, by how far its state goes; all, where that is not
        known."""
        if self.speed is None:
            return np.ones(len(self.step), dtype=np.bool_)
        return np.asarray(self.speed > MOVING * float(np.sqrt((self.speed**2).sum() / max(len(self.speed), 1))))

    @cached_property
    def flat(self) -> NDArray[np.bool_]:
        """(N,) images of one colour."""
        return np.asarray(self.cells.std(axis=(1, 2)).max(axis=1, initial=0.0) < _BLANK_LEVELS)

    @property
    def is_blank(self) -> bool:
        """Whether most of the images are of one colour."""
        return bool(np.mean(self.flat) > 0.5) if len(self.cells) else False

    @cached_property
    def first_view(self) -> Array:
        """(rows, columns, 3) median of the first fifth of the images, 0 to 255."""
        return np.asarray(np.median(self.cells[: max(len(self.cells) // 5, 1)], axis=0))

    @property
    def stands(self) -> bool:
        """Whether it is of a camera that stands still, as far as that can be told."""
        return not isinstance(self.gains, NotMeasured)

    @cached_property
    def gains(self) -> Array | NotMeasured:
        """(3, N) of each image, against the median one of a camera that stands still, by colour.

        The gain of an image is the median over its parts; where half of them do not stay what they are but for that
        gain, the camera moves.
        """
        found, unrest = self._gains
        if math.isnan(unrest):
            return NotMeasured(why=f"most of what {self.where} shows is black or white")
        return found if unrest <= STANDS else NotMeasured(why=f"{self.where} moves")

    @property
    def unrest(self) -> float:
        """Share by which half of an image's parts change but for the gain of all, in nine of ten images at most; NaN
        where most of what it shows is black or white."""
        return self._gains[1]

    @cached_property
    def _gains(self) -> tuple[Array, float]:
        usual = np.median(self.cells, axis=0)
        lit = (usual > 20) & (usual < 235)  # (rows, columns, 3)
        if (lit.mean(axis=(0, 1)) < 0.3).any():
            return np.ones((3, len(self.cells))), math.nan
        gains, stays = [], []
        for channel in range(3):
            ratio = self.cells[..., channel][:, lit[..., channel]] / usual[..., channel][lit[..., channel]]
            gain = np.median(ratio, axis=1)
            gains.append(gain)
            stays.append(np.median(np.abs(ratio / np.maximum(gain, 1e-3)[:, None] - 1), axis=1))
        return np.array(gains), float(np.quantile(np.max(stays, axis=0), 0.9))


MOVING = 0.3
"""Of the root mean square step of the state: more is a moving frame."""
STANDS = 0.02
"""Share by which half of a fixed camera's parts stay what they are, but for the gain of all."""
_DIFFERENT, _ALIKE = 0.9, 0.98
"""Correlations of two cameras that show different things, and of one whose images were encoded twice."""
_BLANK_LEVELS = 1.0
"""Of 255, standard deviation over an image's parts below which it is of one colour: black, green or otherwise empty."""


_PARTS = 16
"""Parts along the shorter side, about, whose mean colours stand for an image."""
_FEWEST_PARTS, _MOST_PARTS = 8, 32
"""Where no square part of as many divides both sides, there are `_PARTS` by `_PARTS` that are not square."""
_MOST_LINES = 257
"""Of bytes, whose sum 16 bits hold."""
_EVERY, _FEWEST = 8, 8
"""Of so many images one is looked at pixel by pixel, and of how many at least an episode's deviation is told."""

Films = Mapping[str, Sequence[Film]]
"""Camera -> its film in each episode."""


def difference(one: NDArray[Any], other: NDArray[Any]) -> Array:
    """(N,) mean difference of images in parts."""
    return np.asarray(np.abs(one.astype(np.float32) - other).mean(axis=(1, 2, 3), dtype=np.float64))


def turned(view: Array) -> Iterator[Array]:
    """What a wrong line of a converter, or a camera on its head, makes of a view (rows, columns, 3)."""
    yield from (view[:, ::-1], view[::-1], view[::-1, ::-1])
    yield view[..., ::-1]  # red for blue
    yield np.repeat(view.mean(axis=-1, keepdims=True), 3, axis=-1)  # gray
    if len(view) == len(view[0]):
        across = np.swapaxes(view, 0, 1)
        yield from (across, across[::-1], across[:, ::-1], across[::-1, ::-1])


def films_of_recording(recording: Recording, columns: Columns) -> Films:
    """Of a recording that demorec did not simulate: each image once, beside the first frame that holds it."""
    names = next((feature.names for feature in recording.info.features if feature.name == STATE), ())
    state = course_of(columns.features[STATE], names) if STATE in columns.features else None
    found = {}
    for camera in recording.cameras:
        cells, detail = parts_of(decode(recording.video_settings(camera), recording.packets(camera)))
        held, frames = np.unique(columns.images[camera], return_index=True)
        shown = (held != NO_IMAGE) & (held < len(cells))
        rows = frames[shown]
        film = Film(
            where=f"camera {camera}",
            fps=recording.info.fps,
            cells=cells[held[shown]],
            detail=detail[held[shown]],
            frames=rows,
            state=None if state is None else state[rows],
        )
        found[camera] = [film]
    return found


def parts_of(images: Iterable[NDArray[np.uint8]]) -> tuple[NDArray[np.uint8], Array]:
    """Images (H, W, 3) of one size in parts, and their detail, as `Film.cells` and `Film.detail`.

    What no whole part covers is left out.
    """
    found, detail = [], []
    for image in images:
        (height, width), counts = image.shape[:2], part_counts(image.shape[1], image.shape[0])
        columns, rows = min(counts[0], width), min(counts[1], height)
        down, across = height // rows, width // columns
        # Down first and then across, in few bytes: so NumPy adds many numbers at once.
        lines = image[: rows * down, : columns * across].reshape(rows, down, -1)
        sums = lines.sum(axis=1, dtype=np.uint16 if down <= _MOST_LINES else np.uint32)
        sums = sums.reshape(rows, columns, across, 3).sum(axis=2, dtype=np.uint32)
        found.append(np.rint(sums / (down * across)).astype(np.uint8))
        detail.append(detail_of(image[..., 1]))
    return np.stack(found) if found else np.zeros((0, 1, 1, 3), dtype=np.uint8), np.array(detail)


def likeness_of_films(films: Films) -> Iterator[tuple[str, float]]:
    """(two cameras and the episode, correlation of their images); 1 where they are alike in one episode alone."""
    for one, other in combinations(films, 2):
        found = dict[str, float]()
        for a, b in zip(films[one], films[other], strict=False):
            count = min(len(a.cells), len(b.cells))
            if count and a.cells.shape[1:] == b.cells.shape[1:]:
                found[f"{a.where} and {other}"] = correlation(a.cells[:count], b.cells[:count])
        differ = len(found) > 1 and np.median(list(found.values())) < _DIFFERENT
        yield from ((names, 1.0 if differ and value > _ALIKE else value) for names, value in found.items())


def films_of_dataset(
    info: DatasetInfo, places: Sequence[EpisodePlace], key: str, states: Sequence[Array | None]
) -> list[Film]:
    """Of a camera of a dataset in every episode, in order; `states` (T, D) are by `course_of`.

    Raises:
        ExportError: A video cannot be decoded, or has too few images.
    """
    files: dict[Path, Iterator[_Decoded]] = {}
    ends: dict[Path, int] = {}
    found: list[Film] = []
    for place, state in zip(places, states, strict=True):
        path, first = place.videos[key]
        if path not in files:
            files[path] = _decoded(path, info.features[key].shape)
        lead, ends[path] = max(0, first - ends.get(path, 0)), first + place.length
        images = list(islice(files[path], lead, lead + place.length))
        if len(images) < place.length or not images:
            raise ExportError(
                f"Episode {place.episode_index} has {place.length} frames, {len(images)} images decode: {path}"
            )
        cells, detail, moments = zip(*images, strict=True)
        told = [moment for moment in moments if moment is not None]
        colour, squared = np.mean(told, axis=0) if len(told) >= _FEWEST else np.full((2, 3), np.nan)
        film = Film(
            where=f"{key}, episode {len(found)}",
            fps=info.fps,
            cells=np.stack(cells),
            detail=np.array(detail),
            frames=np.arange(len(cells)),
            state=state,
            deviation=np.sqrt(np.maximum(squared - colour**2, 0.0)),
        )
        found.append(film)
    return found


_Decoded = tuple[NDArray[np.uint8], float, Array | None]


def _decoded(path: Path, shape: tuple[int, ...]) -> Iterator[_Decoded]:
    """(rows, columns, 3) mean colours of the parts of every image, 0 to 255, and `detail_of` it; of some (2, 3) means
    of colours of 1, and of their squares, over all pixels.
    """
    from av.video.reformatter import VideoReformatter

    height, width = shape[:2]
    columns, rows = part_counts(width, height)
    reformatter, in_gray = VideoReformatter(), VideoReformatter()  # a frame's own would be set up anew for each
    with opened_video(path) as (container, stream):
        stream.thread_type = "SLICE"
        # Not what the file's own head says, which may be much more.
        stream.codec_context.options = {"max_pixels": str((height + 128) * (width + 128))}
        for number, frame in enumerate(container.decode(stream)):
            small = reformatter.reformat(frame, columns, rows, "rgb24", interpolation="AREA")
            cells = cast("NDArray[np.uint8]", small.to_ndarray())
            yield cells, _detail(frame, in_gray), None if number % _EVERY else _moments(frame)


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
