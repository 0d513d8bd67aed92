"""The pictures of a LeRobot dataset's camera, whoever wrote it: packets as they are where they can be, else pixels.

A dataset's video holds many episodes. Its packets can be cut out, from the keyframe on that an episode's first picture
needs, where no picture is shown in another order than it was coded in.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import av
import numpy as np
from numpy.typing import NDArray

from demorec.core.config import MAX_PIXELS
from demorec.core.errors import in_words
from demorec.datasets.lerobot.files import check_video, table_batches
from demorec.datasets.lerobot.layout import VIDEO_PATH, DatasetInfo
from demorec.datasets.lerobot.packets import PACKET_CODECS, PacketCodec, access_units, episode_distances
from demorec.datasets.lerobot.reader import EpisodePlace
from demorec.episode.external import Kept
from demorec.mcap.video import is_keyframe
from demorec.sources.channel import BagError
from demorec.sources.frames_writer import Picture
from demorec.sources.picture_messages import decode_file, file_head


class DatasetCamera(ABC):
    """Pictures of one feature, in the files of its dataset. Episodes must be asked for in their order.

    Args:
        root: The dataset's folder.
        info: Of it.
        key: Of the feature.
        places: All episodes: what becomes of the pictures is decided once for all of them.

    Attributes:
        key: Of the feature.
        width, height: Pixels.
        kept: The codec of packets that stay as they are, or "32FC1" of distances; "" for pixels, which are coded once.
        told: What becomes of the pictures, in words.
    """

    key: str
    width: int
    height: int
    kept: Kept = ""
    told: str

    @abstractmethod
    def __init__(self, root: Path, info: DatasetInfo, key: str, places: Sequence[EpisodePlace]) -> None: ...

    def lead(self, place: EpisodePlace) -> int:
        """How many of an episode's `pictures` come before its first frame: what that is decoded from."""
        return 0

    @abstractmethod
    def pictures(self, place: EpisodePlace) -> Iterator[Picture]:
        """Its `lead`, then one a frame of the episode: a packet where they are kept, else (H, W, 3) uint8 RGB.

        Of distances (H, W) float32 metres, 0 where nothing was measured.

        Raises:
            BagError, ExportError: They cannot be read, are of another size, or end too early.
        """


class VideoCamera(DatasetCamera):
    """Pictures in mp4 files."""

    def __init__(self, root: Path, info: DatasetInfo, key: str, places: Sequence[EpisodePlace]) -> None:
        self.key = key
        self._root, self._template = root, info.video_path or VIDEO_PATH
        self._path: Path | None = None
        self._shown: Iterator[Picture] = iter(())
        self._next = 0
        self._leads: dict[tuple[Path, int], int] = {}
        self._since_keyframe: list[Picture] = []
        codec, reason = self._look(places)
        self.kept = "" if reason else codec
        self.told = f"{codec}, coded once, since {reason}" if reason else f"{codec} kept as it is"

    def lead(self, place: EpisodePlace) -> int:
        """As of `DatasetCamera`."""
        return self._leads.get(self._place(place), 0) if self.kept else 0

    def pictures(self, place: EpisodePlace) -> Iterator[Picture]:
        """As of `DatasetCamera`."""
        path, first = self._place(place)
        if path != self._path:
            self._path, self._next = path, 0
            self._shown = self._packets(path) if self.kept else self._pixels(path)
        if first < self._next:
            raise BagError(f"Episode {place.episode_index} overlaps the one before it: {path}")
        for number in range(self._next, first + place.length):
            picture = next(self._shown, None)
            if picture is None:
                raise BagError(
                    f"Episode {place.episode_index} has {place.length} frames, but the video ends after "
                    f"{max(0, number - first)} of its pictures: {path}"
                )
            self._next = number + 1
            if number == first and self.kept:
                yield from self._since_keyframe[:-1]
            if number >= first:
                yield picture

    def _place(self, place: EpisodePlace) -> tuple[Path, int]:
        """File of an episode, and the number of its first picture there."""
        position, first = place.videos[self.key]
        return self._root / position.path(self._template, self.key), first

    def _look(self, places: Sequence[EpisodePlace]) -> tuple[PacketCodec, str]:
        """The codec, and why its packets cannot be kept, "" if they can; sets the size and the leads."""
        lengths: dict[Path, dict[int, int]] = {}
        for place in places:
            path, first = self._place(place)
            lengths.setdefault(path, {})[first] = place.length
        codecs, sizes, reason = set(), set(), ""
        for path, beginnings in lengths.items():
            with _opened(path) as (container, stream):
                codec = _codec(stream, path)
                convert = access_units(stream, codec)
                codecs.add(codec)
                sizes.add((stream.codec_context.width, stream.codec_context.height))
                last, keyframe = -1, b""
                for number, packet in enumerate(packet for packet in container.demux(stream) if packet.size):
                    if packet.pts != packet.dts:
                        reason = reason or "pictures are not shown in the order in which they were coded"
                    if packet.is_keyframe:
                        last, keyframe = number, convert(packet)
                    if number in beginnings:
                        self._leads[path, number] = number - last
                        if last < 0 or number - last > beginnings[number] or not is_keyframe(codec, keyframe):
                            reason = reason or "an episode begins far from the keyframe that it needs"
        if len(codecs) != 1 or len(sizes) != 1:
            raise BagError(f"The videos of {self.key} are of several codecs or sizes: {self._root}")
        self.width, self.height = sizes.pop()
        return codecs.pop(), reason

    def _packets(self, path: Path) -> Iterator[bytes]:
        """Access units with start codes, and with parameter sets in front of keyframes; temporal units of AV1."""
        with _opened(path) as (container, stream):
            convert = access_units(stream, _codec(stream, path))
            for packet in container.demux(stream):
                if packet.size:
                    if packet.is_keyframe:
                        self._since_keyframe.clear()
                    self._since_keyframe.append(data := convert(packet))
                    yield data

    def _pixels(self, path: Path) -> Iterator[NDArray[np.uint8]]:
        with _opened(path) as (container, stream):
            for frame in container.decode(stream):
                if (frame.width, frame.height) != (self.width, self.height):
                    raise BagError(f"The video changes its size to {frame.width}x{frame.height}: {path}")
                yield cast(NDArray[np.uint8], frame.to_ndarray(format="rgb24"))


def _codec(stream: av.video.stream.VideoStream, path: Path) -> PacketCodec:
    name = stream.codec_context.name
    if name not in PACKET_CODECS:
        raise BagError(f"The video's codec is {name}; h264, hevc and av1 are read: {path}")
    return PACKET_CODECS[name]


@contextmanager
def _opened(path: Path) -> Iterator[tuple[av.container.InputContainer, av.video.stream.VideoStream]]:
    """A video within bounds; BagError when it cannot be read, in the block too."""
    check_video(path)
    try:
        with av.open(str(path), format="mp4") as container:
            stream = container.streams.video[0]
            stream.thread_type = "NONE"
            # A few bytes can announce pictures of gigabytes.
            stream.codec_context.options = {"max_pixels": str(MAX_PIXELS)}
            yield container, stream
    except (OSError, IndexError, av.FFmpegError) as error:
        raise BagError(f"The video cannot be read ({in_words(error)}): {path}") from error


_LARGE_BYTES, _IMAGE_RATIO = 24 << 20, 200
"""An image of more pixels than that, in RGB (8 million), takes at least so small a part of them as a file."""
_PIXEL_BYTES, _FILE_RATIO = 512 << 20, 1000
"""All images of a dataset may have so many bytes of pixels, or so many times its files: deflate reaches 1,032, and rows
that share one image share its bytes."""


class DepthCamera(DatasetCamera):
    """Distances in mp4 files, as codes: what LeRobot and our own exports make of them."""

    kept = "32FC1"
    told = "the distances of its codes, in metres (32FC1)"

    def __init__(self, root: Path, info: DatasetInfo, key: str, places: Sequence[EpisodePlace]) -> None:
        self.key = key
        self._root, self._info = root, info
        self.height, self.width = info.features[key].shape[:2]
        next(self.pictures(places[0]))

    def pictures(self, place: EpisodePlace) -> Iterator[NDArray[np.float32]]:
        """As of `DatasetCamera`."""
        return episode_distances(self._root, self._info, self.key, place)


class ImageCamera(DatasetCamera):
    """Pictures in the rows of the data files, PNG or JPEG."""

    width = height = 0
    told = "pictures of their own, coded once"

    def __init__(self, root: Path, info: DatasetInfo, key: str, places: Sequence[EpisodePlace]) -> None:
        self.key = key
        self._root, self._template = root, info.data_path
        self._path: Path | None = None
        self._rows: Iterator[tuple[int, Any]] = iter(())
        self._allowed = _PIXEL_BYTES
        first = next(self.pictures(places[0]))
        self.height, self.width = first.shape[:2]
        self._path = None

    def pictures(self, place: EpisodePlace) -> Iterator[NDArray[np.uint8]]:
        """As of `DatasetCamera`."""
        path = self._root / place.data.path(self._template)
        if path != self._path:
            self._path, self._rows = path, _image_rows(path, self.key)
            self._allowed += _FILE_RATIO * path.stat().st_size if path.is_file() else 0
        found = 0
        while found < place.length:
            index, value = next(self._rows, (-1, None))
            if index == -1:  # not "below 0": a damaged table has indices of any type
                raise BagError(f"Episode {place.episode_index} has {place.length} frames, but {found} pictures: {path}")
            if index == place.from_index + found:
                found += 1
                yield self._decoded(value, path)

    def _decoded(self, value: Any, path: Path) -> NDArray[np.uint8]:
        data = value.get("bytes") if isinstance(value, dict) else None
        try:
            if not data:
                raise ValueError("it is not in the table")
            head = file_head(data)
            num_bytes, kind = 3 * head.width * head.height, f"{head.width}x{head.height} pixels"
            self._allowed -= num_bytes
            if num_bytes > max(_LARGE_BYTES, _IMAGE_RATIO * len(data)):
                raise ValueError(f"{kind} in {len(data):,} bytes are no image of a camera")
            if self._allowed < 0:
                raise ValueError(f"{kind} in so many rows are too many for files of this size")
            picture = decode_file(data)
        except ValueError as error:
            raise BagError(f"A picture of {self.key} cannot be read ({in_words(error)}): {path}") from error
        if self.width and picture.shape[:2] != (self.height, self.width):
            raise BagError(f"The pictures of {self.key} change their size: {path}")
        return picture


def _image_rows(path: Path, key: str) -> Iterator[tuple[int, Any]]:
    """(index, picture) of each row."""
    for batch in table_batches(path, ["index", key], rows=16):
        yield from zip(batch.column("index").to_pylist(), batch.column(key).to_pylist(), strict=True)
