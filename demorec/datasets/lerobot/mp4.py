"""Mp4 files written from encoded images as they are: no image is decoded or encoded anew.

A file has one video track at a constant rate, the index (`moov`) in front so that it can be read over a network
(ISO/IEC 14496-12). LeRobot's own writer copies the whole file for every episode; here the images of an episode are
appended, images that lie in other files are copied once, and the index is written once, at the end.
"""

from __future__ import annotations

import errno
import hashlib
import io
import os
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import groupby, pairwise
from operator import itemgetter
from pathlib import Path
from typing import IO

import av
import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import ExportError
from demorec.core.files import sync_path
from demorec.datasets.lerobot.mp4_index import mp4_head

_DEMUXERS = {"h264": "h264", "hevc": "hevc", "av1": "obu"}


@dataclass(frozen=True, kw_only=True)
class Stored:
    """Encoded images in a file.

    Attributes:
        path: Of the file.
        spans: (begin, bytes) of its parts, one behind the other.
        is_own: The file has nothing else, and is deleted once they are written.
    """

    path: Path
    spans: tuple[tuple[int, int], ...]
    is_own: bool = False

    def read(self) -> bytes:
        """All of them; OSError where the file cannot be read."""
        with self.path.open("rb", buffering=0) as file:
            return b"".join(os.pread(file.fileno(), count, begin) for begin, count in self.spans)


@dataclass(frozen=True, kw_only=True, eq=False)
class EncodedVideo:
    """The T images of one camera in one episode, and those around them without which they cannot be decoded.

    Attributes:
        codec: "h264", "hevc" or "av1", or another one by libav's name.
        first: The first image as it was encoded, a keyframe; for another codec an mp4 file of it alone.
        samples: All images back to back, as an mp4 file stores them, or where they lie.
        sizes: (lead + T + tail,) int64, bytes of each in `samples`.
        is_keyframe: (lead + T + tail,) bool, which ones can be decoded by themselves.
        digest: SHA-256 of T samples, those of the images, hex; with a tail, of those that are stored in their place. ""
            where nobody asks for it.
        lead: How many images are in front that belong to no frame, from a keyframe on.
        tail: How many images are shown behind the last frame, since some of the T are decoded from them.
        shifts: (lead + T + tail,) int64, by how many places each image is shown after the place at which it is stored;
            None where images are shown in the order in which they were encoded.
    """

    codec: str
    width: int
    height: int
    first: bytes
    samples: bytes | Stored
    sizes: NDArray[np.int64]
    is_keyframe: NDArray[np.bool_]
    digest: str = ""
    lead: int = 0
    tail: int = 0
    shifts: NDArray[np.int64] | None = None

    @classmethod
    def of_access_units(
        cls, codec: str, width: int, height: int, data: bytes, lengths: Sequence[int] | NDArray[np.int64], lead: int = 0
    ) -> EncodedVideo:
        """From images back to back, as they were encoded, and the length of each; ExportError if that is none."""
        from demorec.mcap.video import is_keyframe  # loads all that reads recordings

        ends = np.cumsum(np.asarray(lengths, dtype=np.int64)).tolist()
        units = [data[begin:end] for begin, end in pairwise([0, *ends])]
        samples = [b"".join(stored for _, stored in _units(codec, unit)) for unit in units]
        if not all(samples):
            raise ExportError(f"A packet of the {codec} video holds no image.")
        video = cls(
            codec=codec,
            width=width,
            height=height,
            first=units[0] if units else b"",
            samples=b"".join(samples),
            sizes=np.array([len(sample) for sample in samples], dtype=np.int64),
            is_keyframe=np.array([is_keyframe(codec, unit) for unit in units], dtype=np.bool_),
            lead=lead,
        )
        return video.with_digest()

    def with_digest(self) -> EncodedVideo:
        """The same with its digest."""
        begin, end = (int(self.sizes[:count].sum()) for count in (self.lead, self.lead + self.num_frames))
        return replace(self, digest=hashlib.sha256(memoryview(self.read())[begin:end]).hexdigest())

    @property
    def num_frames(self) -> int:
        """T."""
        return len(self.sizes) - self.lead - self.tail

    @property
    def delay(self) -> int:
        """How many images a decoder has to hold back until it can show them in order."""
        return 0 if self.shifts is None else -int(self.shifts.min())

    @property
    def num_bytes(self) -> int:
        """Of all images."""
        return int(self.sizes.sum())

    def put_aside(self, folder: Path) -> EncodedVideo:
        """The same with its `samples` in a new file in `folder`: cheap to hand to another process."""
        handle, name = tempfile.mkstemp(dir=folder)
        with os.fdopen(handle, "wb") as file:
            file.write(self.read())
        return replace(self, samples=Stored(path=Path(name), spans=((0, self.num_bytes),), is_own=True))

    def read(self) -> bytes:
        """All images back to back; OSError where a file cannot be read."""
        return self.samples if isinstance(self.samples, bytes) else self.samples.read()

    def parameter_sets(self) -> bytes:
        """What a decoder must know before the first image; ExportError if that is no keyframe that stands alone."""
        if not len(self.is_keyframe) or not self.is_keyframe[0]:
            raise ExportError(f"The {self.codec} video does not start with a keyframe.")
        if self.codec not in _PARAMETER_SETS:
            with av.open(io.BytesIO(self.first), format="mp4") as image:
                return image.streams.video[0].codec_context.extradata or b""
        kinds = _PARAMETER_SETS[self.codec]
        found = b"".join(stored for kind, stored in _units(self.codec, self.first) if kind in kinds)
        if not found:
            raise ExportError(f"The {self.codec} video does not start with a keyframe that carries its parameter sets.")
        return found


class Mp4Writer:
    """One mp4 file; episodes are appended, `close` puts the index in front and makes the file durable.

    Images that lie in files are copied from there by `close`, others wait in a file beside. Until then the file has
    another name, so that an unfinished one is never taken for a finished one. All methods raise OSError when the file
    cannot be written, and ExportError for images that libav does not understand.
    """

    def __init__(self, path: Path, first: EncodedVideo, *, fps: int) -> None:
        self.parameter_sets = first.parameter_sets()
        self.delay = first.delay
        self.num_images = 0
        self.num_bytes = 0
        self._path = path
        try:
            self._template = _first_image_file(first, fps)
        except av.FFmpegError as error:
            raise ExportError(f"The video cannot be written as mp4 ({error.strerror}): {path}") from error
        self._videos: list[EncodedVideo] = []
        self._spans: list[tuple[Path, int, int]] = []
        self._waiting, self._unfinished = path.with_suffix(".waiting"), path.with_suffix(".unfinished")
        path.parent.mkdir(parents=True, exist_ok=True)
        self._own: IO[bytes] | None = self._waiting.open("wb", buffering=0)

    def add(self, video: EncodedVideo) -> None:
        """Append the images of an episode; if they are in a file of their own, it is deleted."""
        assert self._own is not None
        samples = video.samples
        if isinstance(samples, Stored) and not samples.is_own:
            self._spans += [(samples.path, *span) for span in samples.spans]
        else:
            self._spans.append((self._waiting, self._own.tell(), video.num_bytes))
            self._own.write(video.read())
            if isinstance(samples, Stored):
                samples.path.unlink()
        self._videos.append(replace(video, first=b"", samples=b""))
        self.num_images += len(video.sizes)
        self.num_bytes += video.num_bytes

    def close(self) -> None:
        """Write the file and give it its name; harmless when called twice."""
        if self._own is None:
            return
        self._own.close()
        sizes = np.concatenate([video.sizes for video in self._videos])
        keys = np.concatenate([video.is_keyframe for video in self._videos])
        shifts = [np.zeros(len(v.sizes), np.int64) if v.shifts is None else v.shifts for v in self._videos]
        with self._unfinished.open("wb", buffering=0) as file:
            file.write(mp4_head(self._template, sizes, keys, np.concatenate(shifts) + self.delay))
            for path, spans in groupby(self._spans, key=itemgetter(0)):
                with path.open("rb", buffering=0) as source:
                    for _, begin, count in spans:
                        _copy_bytes(source, begin, count, file)
        sync_path(self._unfinished)
        self._unfinished.rename(self._path)
        self._waiting.unlink()
        self._own = None

    def abort(self) -> None:
        """Drop what was gathered; nothing after `close`."""
        if self._own is not None:
            self._own.close()
            self._own = None
            self._unfinished.unlink(missing_ok=True)
            self._waiting.unlink(missing_ok=True)


def one_image_file(image: bytes, stream: av.VideoStream) -> bytes:
    """Write an mp4 file of one image that was encoded as a stream describes."""
    described = io.BytesIO()
    with av.open(described, "w", format="mp4") as target:
        packet = av.Packet(image)
        packet.stream = target.add_stream_from_template(stream, opaque=True)
        packet.pts = packet.dts = 0
        packet.is_keyframe = True
        target.mux_one(packet)
    return described.getvalue()


def _first_image_file(video: EncodedVideo, fps: int) -> bytes:
    """Write a file of the first image alone, as libav does, with the time base of the whole video."""
    buffer = io.BytesIO()
    described = io.BytesIO(video.first)
    if video.codec in _DEMUXERS:
        with av.open(described, format=_DEMUXERS[video.codec]) as source:
            described = io.BytesIO(one_image_file(video.first, source.streams.video[0]))
    # The bit rate would be that of the first image, and without `bitexact` the file would name the version of libav.
    options = {"write_btrt": "0", "fflags": "bitexact"}
    with (
        av.open(described, "r", format="mp4") as image,
        av.open(buffer, "w", format="mp4", container_options=options) as target,
    ):
        stream = target.add_stream_from_template(image.streams.video[0], opaque=True)
        stream.codec_context.thread_count = 1  # nothing is decoded: no threads for it
        stream.time_base = Fraction(1, fps)
        target.start_encoding()
        ticks = int(1 / (fps * stream.time_base))  # a frame, in the unit that libav has chosen now
        packet = next(image.demux())
        packet.stream, packet.time_base = stream, stream.time_base
        packet.pts, packet.dts, packet.duration = 0, -video.delay * ticks, ticks
        target.mux_one(packet)
    return buffer.getvalue()


_TEMPORAL_DELIMITER = 2
"""Kind of a unit of AV1 that mp4 files leave out."""
_PARAMETER_SETS = {"h264": (7, 8), "hevc": (32, 33, 34), "av1": (1,)}
"""Kinds of the units of which one mp4 file holds one set: a decoder must know them before the first image."""


def _units(codec: str, access_unit: bytes) -> Iterator[tuple[int, bytes]]:
    """Kind of each unit, and the unit as an mp4 file stores it: nothing but the framing changes."""
    if codec == "av1":
        for kind, start, end in _open_bitstream_units(access_unit):
            if kind != _TEMPORAL_DELIMITER:
                yield kind, access_unit[start:end]
        return
    before, *pieces = access_unit.split(b"\x00\x00\x01")
    if before.strip(b"\x00") or not pieces:
        raise ExportError("A video packet does not begin with a start code: it is no Annex B stream.")
    for nal in (piece.rstrip(b"\x00") for piece in pieces):
        if nal:
            yield nal[0] & 31 if codec == "h264" else (nal[0] >> 1) & 63, len(nal).to_bytes(4, "big") + nal


def _open_bitstream_units(access_unit: bytes) -> list[tuple[int, int, int]]:
    """(type, start, end) of each unit; every one must carry its size, as encoders write them."""
    units = []
    start = 0
    while start < len(access_unit):
        header = access_unit[start]
        if not header & 2:
            raise ExportError("An AV1 packet holds a unit without a size field.")
        position = start + 1 + ((header >> 2) & 1)
        size = shift = 0
        while True:
            byte = access_unit[position]
            position += 1
            size |= (byte & 127) << shift
            shift += 7
            if not byte & 128:
                break
        end = position + size
        if end > len(access_unit):
            raise ExportError("An AV1 packet is cut off.")
        units.append(((header >> 3) & 15, start, end))
        start = end
    return units


_COPIED_BYTES = 1 << 16
"""Copied at a time: pages of the file cache are taken faster one by one than a quarter of a megabyte together."""


def _copy_bytes(source: IO[bytes], begin: int, count: int, target: IO[bytes]) -> None:
    """Append a part of a file to another, both without a buffer.

    Raises:
        OSError: The part is not there, or cannot be written.
    """
    place = target.tell()
    while count:
        # In whole pages of the target: of parts that lie at any byte the kernel's own copying takes half as much again.
        data = os.pread(source.fileno(), min(count, _COPIED_BYTES - place % _COPIED_BYTES), begin)
        if not data:
            raise OSError(errno.EIO, "the file ends before it should", source.name)
        done = target.write(data)
        begin, count, place = begin + done, count - done, place + done
