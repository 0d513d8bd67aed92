"""The images of a dataset, whoever wrote it: packets as streams hold them, pixels, distances.

A dataset's video holds many episodes. Its packets can be cut out, from the keyframe on that an episode's first image
needs, where no image is shown in another order than it was encoded in.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from fractions import Fraction
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast

import av
import numpy as np
import pyarrow as pa
from av.bitstream import BitStreamFilterContext
from av.video.reformatter import VideoReformatter
from numpy.typing import NDArray
from PIL import Image

from demorec.core.config import MAX_PIXELS
from demorec.core.errors import ExportError, describe_error
from demorec.datasets.lerobot.depth import LARGEST_CODE, DepthScale
from demorec.datasets.lerobot.layout import DatasetInfo
from demorec.datasets.lerobot.mp4_index import check_video
from demorec.datasets.lerobot.paths import INFO_PATH
from demorec.datasets.lerobot.reader import EpisodePlace, RowStream

if TYPE_CHECKING:
    from demorec.mcap.video import Rgb

PacketCodec = Literal["h264", "h265", "av1"]
PACKET_CODECS: dict[str, PacketCodec] = {"h264": "h264", "hevc": "h265", "av1": "av1", "libdav1d": "av1"}
"""libav's name of a codec or decoder -> ours."""
_TO_START_CODES = {"h264": "h264_mp4toannexb", "h265": "hevc_mp4toannexb"}
_TEMPORAL_DELIMITER = b"\x12\x00"
"""In front of every temporal unit of AV1 (its specification, section 7.5); mp4 files leave it out."""


@contextmanager
def opened_video(path: Path) -> Iterator[tuple[av.container.InputContainer, av.video.stream.VideoStream]]:
    """Open a video; ExportError when it cannot be read, in the block too."""
    check_video(path)
    try:
        with av.open(str(path), format="mp4") as container:
            stream = container.streams.video[0]
            stream.thread_type = "NONE"  # starting threads costs more than what they would save
            width, height = stream.codec_context.width, stream.codec_context.height
            if width * height > MAX_PIXELS:
                raise ValueError(f"it has {width}x{height} pixels, allowed are {MAX_PIXELS:,} in all")
            yield container, stream
    except (OSError, EOFError, ValueError, IndexError, av.FFmpegError) as error:
        raise ExportError(f"The video cannot be read ({describe_error(error)}): {path}") from error


class PacketReader:
    """Encoded images of one camera feature as they lie in the mp4 files, in order over all of them.

    Attributes:
        keyframe: Number, in its file, of the keyframe from which on the image read last can be decoded; -1 for none.
    """

    def __init__(self, key: str) -> None:
        self._key = key
        self._path: Path | None = None
        self._packets = _samples(None)
        self._next = 0
        self.keyframe = -1

    def close(self) -> None:
        """Close the open file; harmless when called twice."""
        self._packets.close()

    def read(self, place: EpisodePlace) -> Iterator[bytes]:
        """The samples of an episode; episodes must be asked for in order."""
        path, first = place.videos[self._key]
        if path != self._path:
            self.close()
            self._packets = _samples(path)
            self._path, self._next, self.keyframe = path, 0, -1
        if first < self._next:
            raise ExportError(f"Episode {place.episode_index} overlaps the one before it: {path}")
        begin, self._next = self._next, first + place.length
        for number in range(begin, self._next):  # those before the first belong to no episode
            data, is_key = next(self._packets, (b"", False))
            if not data:
                raise ExportError(
                    f"Episode {place.episode_index} has {place.length} frames, but {max(0, number - first)} images: "
                    f"{path}"
                )
            if is_key:
                self.keyframe = number
            if number >= first:
                yield data


def _samples(path: Path | None) -> Any:
    """A generator of each sample of an mp4 file, and whether it is a keyframe; of none without a file."""
    if path is not None:
        with opened_video(path) as (container, _):
            for packet in container.demux(video=0):
                if packet.size:
                    is_key = packet.is_keyframe
                    yield bytes(packet), is_key


def access_units(stream: av.video.stream.VideoStream, codec: PacketCodec) -> Callable[[av.Packet], bytes]:
    """What makes of a sample of an mp4 file what recordings hold: start codes, or a temporal delimiter, in front."""
    name = _TO_START_CODES.get(codec)
    if name is None:
        return lambda packet: _TEMPORAL_DELIMITER + bytes(packet).removeprefix(_TEMPORAL_DELIMITER)
    bits = BitStreamFilterContext(name, stream)
    return lambda packet: b"".join(bytes(part) for part in bits.filter(packet))


class EpisodeVideo:
    """The images of a camera feature in one episode of T frames; methods raise ExportError when they cannot be read.

    Attributes:
        path: The mp4 file.
        first: Number of the episode's first image in it.
        length: T.
    """

    def __init__(self, info: DatasetInfo, key: str, place: EpisodePlace) -> None:
        self.path, self.first = place.videos[key]
        self.length = place.length
        self._feature, self._key, self._fps = info.features[key], key, int(info.fps)
        self._episode = place.episode_index

    def _seek(
        self, container: av.container.InputContainer, stream: av.video.stream.VideoStream, frame: int = 0
    ) -> Fraction:
        """Go to a frame or before it; return how many frames a tick of the video's clock is."""
        assert stream.time_base is not None
        container.seek(round((self.first + frame) / (self._fps * stream.time_base)), stream=stream)
        return self._fps * stream.time_base

    @cached_property
    def lead(self) -> int:
        """How many images there are from the keyframe on that the first frame needs, less that frame."""
        with opened_video(self.path) as (container, stream):
            rate, keyframe = self._seek(container, stream), 0
            for packet in container.demux(stream):
                if packet.size and packet.pts is not None:
                    frame = round(packet.pts * rate) - self.first
                    keyframe = frame if packet.is_keyframe else keyframe
                    if frame == 0:
                        return -min(keyframe, 0)
        raise ExportError(f"Episode {self._episode} has {self.length} frames, the video ends before them: {self.path}")

    def packets(self) -> Iterator[tuple[int, bytes, bool]]:
        """(frame, access unit, whether it is a keyframe) of the `lead`, whose frames are below 0, and of T frames."""
        with opened_video(self.path) as (container, stream):
            rate, codec = self._seek(container, stream), codec_of(stream)
            claimed = str((self._feature.info or {}).get("video.codec"))
            if PACKET_CODECS.get(claimed, codec) != codec:
                raise ValueError(f"its codec is {codec}, and meta/info.json says {claimed}")
            convert, left = access_units(stream, codec), self.length
            lead: list[tuple[int, bytes, bool]] = []
            for packet in container.demux(stream):
                if not packet.size or packet.pts is None:
                    continue
                # Read before the conversion, which empties the packet.
                frame, is_key = round(packet.pts * rate) - self.first, packet.is_keyframe
                data = convert(packet)
                if is_key:
                    lead.clear()
                if frame < 0:
                    lead.append((frame, data, is_key))
                elif frame < self.length:
                    yield from (*lead, (frame, data, is_key))
                    lead.clear()
                    left -= 1
                if not left:
                    return
            raise ValueError(f"episode {self._episode} has {self.length} frames, {left} of them no image")

    def images(self, begin: int = 0) -> Iterator[Rgb]:
        """(H, W, 3) uint8 RGB of every frame from one on, which may be one of the lead (below 0)."""
        reformatter = VideoReformatter()  # a frame's own would be set up anew for each
        for frame in self._frames(begin):
            yield cast("Rgb", reformatter.reformat(frame, format="rgb24").to_ndarray())

    @cached_property
    def depth_scale(self) -> DepthScale:
        """What the codes of its depth stand for; ExportError when that is not known."""
        try:
            return DepthScale.of(self._feature.info or {})
        except ValueError as error:
            raise ExportError(
                f"The depth of {self._key} cannot be read ({error} in {INFO_PATH}): {self.path}"
            ) from error

    def codes(self, begin: int = 0) -> Iterator[NDArray[np.uint16]]:
        """(H, W) codes of depth, 0 to 4095, of every frame from one on."""
        height, width = self._feature.shape[:2]
        for frame in self._frames(begin, (width, height)):
            yield np.minimum(frame.to_ndarray(format="gray12le"), LARGEST_CODE)

    def distances(self) -> Iterator[NDArray[np.float32]]:
        """(H, W) metres of every frame, 0 where nothing was measured."""
        metres = self.depth_scale.shown()
        for codes in self.codes():
            yield metres[codes]

    def images_at(self, frames: Sequence[int]) -> Iterator[Rgb]:
        """(H, W, 3) uint8 RGB of some frames, numbered from 0 within the episode."""
        with opened_video(self.path) as (container, stream):
            for frame in frames:
                image = next(self._decoded(container, stream, frame))
                yield cast("Rgb", image.to_ndarray(format="rgb24"))

    def _frames(self, begin: int = 0, size: tuple[int, int] | None = None) -> Iterator[av.VideoFrame]:
        """The decoded images from a frame on, one a frame; the size is what info.json claims."""
        with opened_video(self.path) as (container, stream):
            found = (stream.codec_context.width, stream.codec_context.height)
            if size not in (None, found):
                raise ValueError(f"it has {found[0]}x{found[1]} pixels, and meta/info.json says {size[0]}x{size[1]}")
            if begin < self.length:
                yield from self._decoded(container, stream, begin)

    def _decoded(
        self, container: av.container.InputContainer, stream: av.video.stream.VideoStream, begin: int
    ) -> Iterator[av.VideoFrame]:
        """As `_frames`, of an opened video; ValueError when an image is missing or of another size."""
        rate, number = self._seek(container, stream, begin), begin
        size = (stream.codec_context.width, stream.codec_context.height)
        for image in container.decode(stream):
            frame = begin - 1 if image.pts is None else round(image.pts * rate) - self.first
            if frame < begin:
                continue
            if frame != number:
                break
            if (image.width, image.height) != size:
                raise ValueError(f"it changes its size to {image.width}x{image.height}")
            yield image
            number += 1
            if number == self.length:
                return
        raise ValueError(f"episode {self._episode} has {self.length} frames, and frame {number} no image")


def codec_of(stream: av.video.stream.VideoStream) -> PacketCodec:
    """The codec of a stream; ValueError for one whose packets no recording holds."""
    name = stream.codec_context.name
    if name not in PACKET_CODECS:
        raise ValueError(f"its codec is {name}; h264, hevc and av1 are read")
    return PACKET_CODECS[name]


def why_transcoded(videos: Sequence[EpisodeVideo]) -> tuple[PacketCodec, tuple[int, int], str]:
    """Of a camera's videos of all episodes the codec, (width, height), and why packets cannot pass through, or "".

    Raises:
        ExportError: A video cannot be read, or they are of several codecs or sizes.
    """
    from demorec.mcap.video import is_keyframe  # loads all that reads recordings

    of_files: dict[Path, dict[int, EpisodeVideo]] = {}
    for video in videos:
        of_files.setdefault(video.path, {})[video.first] = video
    kinds, leads, reason = set(), [], ""
    for path, beginnings in of_files.items():
        with opened_video(path) as (container, stream):
            codec = codec_of(stream)
            kinds.add((codec, (stream.codec_context.width, stream.codec_context.height)))
            convert = access_units(stream, codec)
            last, keyframe = -1, b""
            for number, packet in enumerate(packet for packet in container.demux(stream) if packet.size):
                if packet.pts != packet.dts:
                    reason = reason or "images are not shown in the order in which they were encoded"
                if packet.is_keyframe:
                    last, keyframe = number, convert(packet)
                if (begun := beginnings.get(number)) is not None:
                    leads.append((begun, number - last))
                    if last < 0 or number - last > begun.length or not is_keyframe(codec, keyframe):
                        reason = reason or "an episode begins far from the keyframe that it needs"
    if len(kinds) != 1:
        raise ExportError(f"The videos of a camera are of several codecs or sizes: {', '.join(map(str, of_files))}")
    for video, lead in leads if not reason else ():
        video.lead = lead
    ((codec, size),) = kinds
    return codec, size, reason


class StoredImages:
    """The images of a camera feature that are in the rows of the data files, PNG or JPEG."""

    def __init__(self, info: DatasetInfo, key: str) -> None:
        self._key = key
        self._stream = RowStream(info, [key])

    def read(self, place: EpisodePlace, frames: Collection[int] | None = None) -> Iterator[Rgb]:
        """(H, W, 3) uint8 RGB of some frames of an episode, of all by default; ExportError when they cannot be read."""
        columns = (batch.column(self._key) for batch in self._stream.batches(place))
        yield from self.decode(place, columns if frames is None else _some_rows(columns, frames))

    def decode(self, place: EpisodePlace, columns: Iterable[pa.Array]) -> Iterator[Rgb]:
        """(H, W, 3) uint8 RGB of some rows of an episode, whose column was read already; ExportError as `read`."""
        path = place.data
        shape: tuple[int, ...] | None = None
        for column in columns:
            for item in column:
                value = item.as_py()
                data = value.get("bytes") if isinstance(value, dict) else None
                try:
                    image = self._decoded(data or b"")
                    if shape not in (None, image.shape):
                        raise ValueError(f"it is of another size, {image.shape[1]}x{image.shape[0]} pixels")
                except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
                    raise ExportError(
                        f"An image of {self._key} cannot be read ({describe_error(error)}): {path}"
                    ) from error
                shape = image.shape
                yield image

    def _decoded(self, data: bytes) -> Rgb:
        if not data:
            raise ValueError("it is not in the table")
        with Image.open(io.BytesIO(data), formats=("JPEG", "PNG")) as image:
            if image.width * image.height > MAX_PIXELS:
                raise ValueError(f"{image.width}x{image.height} pixels, at most {MAX_PIXELS:,} are read")
            if image.mode not in ("RGB", "RGBA", "L", "P", "1"):
                raise ValueError(f"its pixels are {image.mode!r}, which is no colour of 8 bits")
            return np.asarray(image.convert("RGB"))


def _some_rows(columns: Iterable[pa.Array], wanted: Collection[int]) -> Iterator[pa.Array]:
    """Of a column that comes in pieces, the rows of some numbers."""
    first = 0
    for column in columns:
        is_wanted = [first + row in wanted for row in range(len(column))]
        yield column.filter(pa.array(is_wanted, pa.bool_()))
        first += len(column)
