"""Videos of a dataset: an episode's encoded images, decoded pixels and depth.

A dataset's video holds many episodes. An episode's images are found by the index of the file. They can be copied
without re-encoding, together with the images from which they are decoded: from a keyframe to the last image that a
frame needs.
"""

from __future__ import annotations

import hashlib
import os
import reprlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, cast

import av
import numpy as np
from av.bitstream import BitStreamFilterContext
from av.video.reformatter import VideoReformatter
from numpy.typing import NDArray

from demorec.core.config import MAX_PIXELS
from demorec.core.errors import ExportError, describe_error
from demorec.core.files import open_regular
from demorec.datasets.lerobot.depth import LARGEST_CODE, DepthScale
from demorec.datasets.lerobot.layout import DatasetInfo, video_info
from demorec.datasets.lerobot.mp4 import EncodedVideo, one_image_file
from demorec.datasets.lerobot.paths import INFO_PATH
from demorec.extensions.datasets.episode_places import EpisodePlace
from demorec.extensions.datasets.mp4_index import check_video, mp4_index

if TYPE_CHECKING:
    from demorec.mcap.video import Rgb

PacketCodec = Literal["h264", "h265", "av1"]
PACKET_CODECS: dict[str, PacketCodec] = {"h264": "h264", "hevc": "h265", "av1": "av1", "libdav1d": "av1"}
"""libav's name of a codec or decoder -> demorec's."""
_TO_START_CODES = {"h264": "h264_mp4toannexb", "h265": "hevc_mp4toannexb"}
_TEMPORAL_DELIMITER = b"\x12\x00"
"""Precedes every temporal unit of AV1 (its specification, section 7.5); mp4 files leave it out."""
_MAX_REORDERED = 32
"""Maximum number of images by which storage order and display order differ; codecs allow 16."""

OpenedVideo = tuple[av.container.InputContainer, av.video.stream.VideoStream]


@contextmanager
def opened_video(path: Path) -> Iterator[OpenedVideo]:
    """Open a video. Raises ExportError if it cannot be read, also in the block."""
    check_video(path)
    with _video_errors(path), av.open(str(path), format="mp4") as container:
        stream = container.streams.video[0]
        stream.thread_type = "NONE"  # starting threads costs more than it saves
        width, height = stream.codec_context.width, stream.codec_context.height
        if width * height > MAX_PIXELS:
            raise ValueError(f"it has {width}x{height} pixels, allowed are {MAX_PIXELS:,} in all")
        yield container, stream


@contextmanager
def _video_errors(path: Path) -> Iterator[None]:
    try:
        yield
    except (OSError, EOFError, ValueError, IndexError, av.FFmpegError) as error:
        raise ExportError(f"The video cannot be read ({describe_error(error)}): {path}") from error


class VideoFile:
    """The encoded images of an mp4 file. Raises ExportError if it cannot be read.

    Attributes:
        offsets, sizes, is_keyframe: (N,) of its images, in storage order.
        frames: (N,) int64, number of the frame in which each is shown.
        order: (N,) indices that sort `frames`.
        keys: (K,) frame numbers of the keyframes.
        codec: Codec of its packets by recordings' name; "" if recordings cannot hold it.
        codec_name: Codec by info.json's name.
        size, pixels: (width, height) and pixel format, as libav describes them.
        parameters: Parameter sets of the codec.
        has_long_lengths: Whether H.264 and HEVC units have four-byte lengths, as from all common writers.
    """

    def __init__(self, path: Path, fps: float) -> None:
        self.path, self._fps = path, fps
        self.offsets, self.sizes, self.is_keyframe, times = mp4_index(path)
        self.frames: NDArray[np.int64] = np.rint(times * fps).astype(np.int64)
        self.order = np.argsort(self.frames, kind="stable")
        self.keys = np.flatnonzero(self.is_keyframe)
        with opened_video(path) as (_, stream):
            context = stream.codec_context
            self.codec: PacketCodec | Literal[""] = PACKET_CODECS.get(context.name, "")
            self.codec_name = "hevc" if self.codec == "h265" else self.codec or context.name
            self.size, self.pixels = (context.width, context.height), context.pix_fmt or ""
            self.parameters = extra = context.extradata or b""
            length_size = extra[4] if self.codec == "h264" else extra[21] if len(extra) > 21 else 3
            self.has_long_lengths = self.codec not in ("h264", "h265") or (length_size & 3) == 3
        self._head = b""

    def samples(self, numbers: Iterable[int]) -> Iterator[bytes]:
        """Yield images in their stored form."""
        try:
            with open_regular(self.path) as file:
                for number in numbers:
                    yield os.pread(file.fileno(), int(self.sizes[number]), int(self.offsets[number]))
        except OSError as error:
            raise ExportError(f"The video cannot be read ({describe_error(error)}): {self.path}") from error

    @contextmanager
    def access_units(self) -> Iterator[Callable[[bytes], bytes]]:
        """Yield the function that converts a stored image to an access unit of a stream, with start codes or a temporal
        delimiter. Raises ExportError for a codec that recordings cannot hold.
        """
        if not self.codec:
            raise ExportError(f"Recordings hold h264, hevc and av1, this video is {self.codec_name}: {self.path}")
        if self.codec == "av1":
            yield lambda sample: _TEMPORAL_DELIMITER + sample.removeprefix(_TEMPORAL_DELIMITER)
            return
        with opened_video(self.path) as (_, stream):
            bits = BitStreamFilterContext(_TO_START_CODES[self.codec], stream)
            yield lambda sample: b"".join(bytes(part) for part in bits.filter(av.Packet(sample)))

    def first_image(self, number: int) -> bytes:
        """Read a first image as `EncodedVideo.first`; the parameter sets of H.264 and HEVC are the file's."""
        if not self.codec:
            with opened_video(self.path) as (_, stream):
                return one_image_file(next(self.samples([number])), stream)
        if self.codec == "av1" or not self._head:
            with self.access_units() as convert:
                self._head = convert(*self.samples([number]))
        return self._head

    def stream_info(self) -> dict[str, Any]:
        """Describe the encoding in info.json's form."""
        return video_info(self.size, self.codec_name, self.pixels, int(self._fps)) | {"is_depth_map": False}


class _Part(NamedTuple):
    """The stored images from which some frames are decoded; `lead` are shown before them, and `tail` after them."""

    numbers: NDArray[np.intp]  # (lead + T + tail,) in the file, in storage order
    places: NDArray[np.int64]  # (lead + T + tail,) display position of each, from 0
    lead: int
    tail: int


class EpisodeVideo:
    """The images of a camera feature in one episode of T frames.

    Attributes:
        path: The mp4 file.
        first: Number of the episode's first image in it.
        length: T.

    Methods and properties raise ExportError if the images cannot be read.
    """

    def __init__(self, opener: Callable[[Path], VideoFile], key: str, place: EpisodePlace, info: DatasetInfo) -> None:
        self.path, self.first = place.videos[key]
        self.length = place.length
        self._opener, self._key, self._feature, self._fps = opener, key, info.features[key], int(info.fps)
        self._episode = place.episode_index

    @property
    def file(self) -> VideoFile:
        """The mp4 file."""
        return self._opener(self.path)

    def _part(self, first: int, last: int) -> _Part:
        """Find frames `first` to `last` - 1, with all images from which they are decoded."""
        file, begin, end = self.file, self.first + first, self.first + last
        if last <= first:
            return _Part(np.zeros(0, np.intp), np.zeros(0, np.int64), lead=0, tail=0)
        wanted = file.order[slice(*np.searchsorted(file.frames, (begin, end), sorter=file.order))]
        if len(wanted) != last - first:
            count = f"{len(wanted)} images for {last - first} frames of {self._key}"
            raise ExportError(f"Episode {self._episode} has {count}: {self.path}")
        keys = file.keys[: np.searchsorted(file.keys, wanted.min(), side="right")]
        keys = keys[file.frames[keys] <= begin]
        if not len(keys):
            raise ExportError(f"Episode {self._episode} does not begin after a keyframe of {self._key}: {self.path}")
        keyframe = int(file.frames[keys[-1]])
        numbers = _without_gaps(file.frames, int(keys[-1]), int(wanted.max()) + 1)
        places = file.frames[numbers] - keyframe
        if not np.array_equal(np.sort(places), np.arange(len(places))):
            raise ExportError(f"Two images of {self._key} have the same time, or a time has none: {self.path}")
        return _Part(numbers, places, lead=begin - keyframe, tail=len(places) - (end - keyframe))

    @cached_property
    def _whole(self) -> _Part:
        return self._part(0, self.length)

    @property
    def lead(self) -> int:
        """Number of images from the keyframe up to the first frame, excluding that frame."""
        return self._whole.lead

    def cut(self, first: int = 0, last: int | None = None) -> EncodedVideo:
        """Extract the images of frames `first` to `last` - 1, with all images from which they are decoded. Raises
        ExportError if they are missing, or cannot be extracted without re-encoding.
        """
        file, part = self.file, self._part(first, self.length if last is None else last)
        if not file.has_long_lengths:
            raise ExportError(f"The video has lengths of less than four bytes, which are not copied: {self.path}")
        shifts = part.places - np.arange(len(part.places))
        return EncodedVideo(
            codec=file.codec_name,
            first=file.first_image(int(part.numbers[0])),
            samples=b"".join(file.samples(part.numbers)),
            sizes=file.sizes[part.numbers],
            is_keyframe=file.is_keyframe[part.numbers],
            lead=part.lead,
            tail=part.tail,
            shifts=shifts if shifts.any() else None,
        )

    def digest(self) -> str:
        """SHA-256 (hex) of the T stored images, as in `EncodedVideo.digest`."""
        part, digest = self._whole, hashlib.sha256()
        for sample in self.file.samples(part.numbers[part.lead : part.lead + self.length]):
            digest.update(sample)
        return digest.hexdigest()

    def packets(self) -> Iterator[tuple[int, bytes, bool]]:
        """Yield (frame, access unit, is a keyframe) for the `lead`, with negative frames, and for T frames."""
        file, part = self.file, self._whole
        claimed = str((self._feature.info or {}).get("video.codec"))
        if PACKET_CODECS.get(claimed, file.codec) != file.codec:
            raise ExportError(
                f"The video cannot be read (its codec is {file.codec}, and meta/info.json lists {claimed}): {self.path}"
            )
        frames = part.places - part.lead
        shown = np.flatnonzero(frames < self.length)
        numbers = part.numbers[shown]
        are_keyframes = file.is_keyframe[numbers].tolist()
        with file.access_units() as convert:
            for frame, sample, is_key in zip(frames[shown].tolist(), file.samples(numbers), are_keyframes, strict=True):
                if not sample:
                    raise ExportError(
                        f"Episode {self._episode} has no image of {self._key} in frame {frame}: {self.path}"
                    )
                yield frame, convert(sample), is_key

    def why_transcoded(self) -> str:
        """Reason why the episode's packets cannot pass through, or ""."""
        from demorec.mcap.video import is_keyframe  # loads all code for reading recordings

        file, part = self.file, self._whole
        if not file.codec:
            return f"recordings cannot hold {file.codec_name}"
        if (np.diff(file.frames) < 0).any():
            return "images are not shown in the order in which they were encoded"
        _, keyframe, _ = next(self.packets())
        if part.lead > self.length or not is_keyframe(file.codec, keyframe):
            return "an episode begins far from the keyframe that it needs"
        return ""

    def images(self, begin: int = 0) -> Iterator[Rgb]:
        """Yield (H, W, 3) uint8 RGB of every frame from `begin`, which may be in the lead (below 0)."""
        reformatter = VideoReformatter()  # a frame's own reformatter would be set up again for each frame
        for frame in self.decoded(begin):
            yield cast("Rgb", reformatter.reformat(frame, format="rgb24").to_ndarray())

    @cached_property
    def depth_scale(self) -> DepthScale:
        """Scale from its depth codes to distances. Raises ExportError if it is unknown."""
        try:
            return depth_scale_of(self._feature.info or {})
        except ValueError as error:
            raise ExportError(
                f"The depth of {self._key} cannot be read ({error} in {INFO_PATH}): {self.path}"
            ) from error

    def codes(self, begin: int = 0) -> Iterator[NDArray[np.uint16]]:
        """Yield (H, W) depth codes, 0 to 4095, of every frame from `begin`."""
        height, width = self._feature.shape[:2]
        for frame in self.decoded(begin, (width, height)):
            yield np.minimum(frame.to_ndarray(format="gray12le"), LARGEST_CODE)

    def distances(self) -> Iterator[NDArray[np.float32]]:
        """Yield (H, W) metres for every frame, 0 where nothing was measured."""
        metres = self.depth_scale.shown()
        for codes in self.codes():
            yield metres[codes]

    def images_at(self, frames: Sequence[int]) -> Iterator[Rgb]:
        """Yield (H, W, 3) uint8 RGB of selected frames, numbered from 0 within the episode."""
        with opened_video(self.path) as (container, stream):
            for frame in frames:
                image = next(self._from(container, stream, frame))
                yield cast("Rgb", image.to_ndarray(format="rgb24"))

    def decoded(
        self, begin: int = 0, size: tuple[int, int] | None = None, opened: OpenedVideo | None = None
    ) -> Iterator[av.VideoFrame]:
        """Yield the decoded images from a frame on, one per frame.

        Args:
            begin: The first frame.
            size: (width, height) in info.json, to be checked; any by default.
            opened: The file, if already open.
        """
        with (
            _video_errors(self.path),
            opened_video(self.path) if opened is None else nullcontext(opened) as (container, stream),
        ):
            found = (stream.codec_context.width, stream.codec_context.height)
            if size not in (None, found):
                raise ValueError(f"it has {found[0]}x{found[1]} pixels, and meta/info.json lists {size[0]}x{size[1]}")
            if begin < self.length:
                yield from self._from(container, stream, begin)

    def _from(
        self, container: av.container.InputContainer, stream: av.video.stream.VideoStream, begin: int
    ) -> Iterator[av.VideoFrame]:
        """Implement `decoded` for an opened video. Raises ValueError if an image is missing or has another size."""
        assert stream.time_base is not None
        rate, number = float(self._fps * stream.time_base), begin
        container.seek(round((self.first + begin) / (self._fps * stream.time_base)), stream=stream)
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
        raise ValueError(f"episode {self._episode} has {self.length} frames, but no image for frame {number}")


def depth_scale_of(info: Mapping[str, Any]) -> DepthScale:
    """Read the scale of depth codes from a feature's `info`, by any writer; ValueError if it is invalid."""
    numbers = [info.get(f"video.{name}") for name in ("depth_min", "depth_max", "shift")]
    use_log = info.get("video.use_log")
    if not isinstance(use_log, bool) or not all(_is_number(number) for number in numbers):
        raise ValueError(f"its scale of depth is {reprlib.repr([*numbers, use_log])}")
    nearest, farthest, shift = (float(number) for number in numbers if number is not None)
    if not nearest < farthest or (use_log and not nearest + shift > 0):
        raise ValueError(f"its scale of depth is {nearest} to {farthest} m, shifted by {shift}")
    return DepthScale(nearest=nearest, farthest=farthest, shift=shift, use_log=use_log)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e6


def _without_gaps(frames: NDArray[np.int64], begin: int, end: int) -> NDArray[np.intp]:
    """Indices of the images from `begin`, in storage order, with those that later ones need. Storage order and display
    order may differ. Images stored after the keyframe and shown before it are left out, because they need images that
    are not included. Images after the last requested one are included until every moment has an image.
    """
    last = min(end + _MAX_REORDERED, len(frames))
    while True:
        part: NDArray[np.intp] = begin + np.flatnonzero(frames[begin:end] >= frames[begin])
        if len(part) > int(frames[part].max() - frames[begin]) or end >= last:
            return part
        end += 1
