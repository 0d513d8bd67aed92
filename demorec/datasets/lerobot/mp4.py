"""Mp4 files written from encoded images as they are: no image is decoded or encoded anew.

A file has one video track at a constant rate, and its index in front so that it can be read over a network. LeRobot's
own writer copies the whole file for every episode; here images are appended, and the index is written once, at the end.
"""

from __future__ import annotations

import errno
import hashlib
import io
import os
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import pairwise
from pathlib import Path

import av
import numpy as np
from av.container import OutputContainer
from numpy.typing import NDArray

from demorec.core.errors import ExportError

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
        """Read all of them. Raises OSError if the file cannot be read, or ends before."""
        with self.path.open("rb", buffering=0) as file:
            data = b"".join(os.pread(file.fileno(), count, begin) for begin, count in self.spans)
        if len(data) != sum(count for _, count in self.spans):
            raise OSError(errno.EIO, "the file ends before it should", str(self.path))
        return data


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
        ends = np.cumsum(np.asarray(lengths, dtype=np.int64)).tolist()
        units = [data[begin:end] for begin, end in pairwise([0, *ends])]
        parts = [list(_units(codec, unit)) for unit in units]
        samples = [b"".join(stored for _, stored in part) for part in parts]
        if not all(samples):
            raise ExportError(f"A packet of the {codec} video holds no image.")
        keyframes = [any(kind in _KEYFRAMES[codec] for kind, _ in part) for part in parts]
        video = cls(
            codec=codec,
            width=width,
            height=height,
            first=units[0] if units else b"",
            samples=b"".join(samples),
            sizes=np.array([len(sample) for sample in samples], dtype=np.int64),
            is_keyframe=np.array(keyframes, dtype=np.bool_),
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
    """One mp4 file; episodes are appended, `close` puts the index in front.

    Until then the file has another name, so that an unfinished one is never taken for a finished one. All methods raise
    OSError if the file cannot be written, and ExportError for images that libav does not understand.
    """

    def __init__(self, path: Path, first: EncodedVideo, *, fps: int) -> None:
        self.parameter_sets = first.parameter_sets()
        self.delay = first.delay
        self.num_images = 0
        self.num_bytes = 0
        self._path, self._unfinished = path, path.with_suffix(".unfinished")
        template = _first_image_file(first, path)
        path.parent.mkdir(parents=True, exist_ok=True)
        # The bit rate would be that of the first image, and without `bitexact` the file would name libav's version.
        options = {"movflags": "faststart", "write_btrt": "0", "fflags": "bitexact"}
        self._file: OutputContainer | None = av.open(
            str(self._unfinished), "w", format="mp4", container_options=options
        )
        with av.open(template, format="mp4") as image:
            self._stream = self._file.add_stream_from_template(image.streams.video[0], opaque=True)
        self._stream.codec_context.thread_count = 1  # nothing is decoded: no threads for it
        self._stream.time_base = Fraction(1, fps)
        self._file.start_encoding()
        self._ticks = int(1 / (fps * self._stream.time_base))  # a frame, in the unit that libav has chosen now

    def add(self, video: EncodedVideo) -> None:
        """Append the images of an episode; if they are in a file of their own, it is deleted."""
        shifts = [0] * len(video.sizes) if video.shifts is None else video.shifts.tolist()
        data, begin = video.read(), 0
        with _mux_errors(self._path):
            for size, is_key, shift in zip(video.sizes.tolist(), video.is_keyframe.tolist(), shifts, strict=True):
                self._mux(data[begin : begin + size], is_key, shift)
                begin += size
        self.num_bytes += video.num_bytes
        if isinstance(video.samples, Stored) and video.samples.is_own:
            video.samples.path.unlink()

    def _mux(self, sample: bytes, is_keyframe: bool, shift: int) -> None:
        """Append an image that is shown `shift` places after the place at which it is stored."""
        assert self._file is not None
        packet = av.Packet(sample)
        packet.stream = self._stream
        packet.dts = (self.num_images - self.delay) * self._ticks
        packet.pts = (self.num_images + shift) * self._ticks
        packet.duration = self._ticks
        packet.is_keyframe = is_keyframe
        self._file.mux_one(packet)
        self.num_images += 1

    def close(self) -> None:
        """Write the index and give the file its name; harmless when called twice."""
        if self._file is not None:
            with _mux_errors(self._path):
                self._file.close()
            self._unfinished.rename(self._path)
            self._file = None

    def abort(self) -> None:
        """Drop what was written; nothing after `close`."""
        if self._file is not None:
            with suppress(OSError, av.FFmpegError):  # which libav may raise again
                self._file.close()
            self._file = None
            self._unfinished.unlink(missing_ok=True)


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


def _first_image_file(video: EncodedVideo, path: Path) -> io.BytesIO:
    """Return an mp4 file of the first image alone, which describes the encoding, for the file at `path`."""
    if video.codec not in _DEMUXERS:
        return io.BytesIO(video.first)
    with (
        _mux_errors(path),
        av.open(io.BytesIO(video.first), format=_DEMUXERS[video.codec]) as source,
    ):
        described = one_image_file(video.first, source.streams.video[0])
    return io.BytesIO(described)


@contextmanager
def _mux_errors(path: Path) -> Iterator[None]:
    """Turn libav's errors into an ExportError; those of the file stay OSError."""
    try:
        yield
    except av.FFmpegError as error:
        if isinstance(error, OSError):
            raise
        raise ExportError(f"The video cannot be written as mp4 ({error.strerror}): {path}") from error


_TEMPORAL_DELIMITER = 2
"""Kind of a unit of AV1 that mp4 files leave out."""
_KEYFRAMES = {"h264": (5,), "hevc": range(16, 22), "av1": (1,)}
"""Kinds of the units that only images have that are decoded without others: slices of IDR and IRAP, AV1's headers."""
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
