"""Mp4 files written from encoded images as they are: no image is decoded or encoded anew.

A file has one video track at a constant rate, every image presented in coding order, the index (`moov`) in front
so that it can be read over a network (ISO/IEC 14496-12). LeRobot's own writer copies the whole file for every
episode; here the images of an episode are appended and the index is written once, at the end.
"""

from __future__ import annotations

import hashlib
import io
import os
import struct
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import accumulate, pairwise
from pathlib import Path
from typing import IO

import av
import numpy as np
from av.container import OutputContainer
from av.video.stream import VideoStream
from numpy.typing import NDArray

from demorec.core.errors import ExportError
from demorec.datasets.staging import sync_file

_DEMUXERS = {"h264": "h264", "hevc": "hevc", "av1": "obu"}


@dataclass(frozen=True, kw_only=True, eq=False)
class EncodedVideo:
    """The T images of one camera in one episode, and those around them without which they cannot be decoded.

    Attributes:
        codec: "h264", "hevc" or "av1".
        first: The first image as it was encoded, a keyframe.
        samples: All images back to back, as an mp4 file stores them; or a file of them that is deleted once written.
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
    samples: bytes | Path
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
        unit_lengths = np.asarray(lengths, dtype=np.int64)
        samples, sizes, is_key = mp4_samples(codec, data, unit_lengths)
        first = data[: int(unit_lengths[0])] if len(unit_lengths) else b""
        video = cls(
            codec=codec,
            width=width,
            height=height,
            first=first,
            samples=samples,
            sizes=sizes,
            is_keyframe=is_key,
            lead=lead,
        )
        return video.with_digest()

    def with_digest(self) -> EncodedVideo:
        """The same with its digest, if its `samples` are bytes."""
        assert isinstance(self.samples, bytes)
        begin, end = (int(self.sizes[:count].sum()) for count in (self.lead, self.lead + self.num_frames))
        return replace(self, digest=hashlib.sha256(memoryview(self.samples)[begin:end]).hexdigest())

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
        """The same with its `samples`, bytes so far, in a new file in `folder`: cheap to hand to another process."""
        assert isinstance(self.samples, bytes)
        handle, name = tempfile.mkstemp(dir=folder)
        with os.fdopen(handle, "wb") as file:
            file.write(self.samples)
        return replace(self, samples=Path(name))

    def opened(self) -> IO[bytes]:
        """`samples`, to be read one after the other."""
        return self.samples.open("rb") if isinstance(self.samples, Path) else io.BytesIO(self.samples)

    def parameter_sets(self) -> bytes:
        """Of the first image; ExportError if that is no keyframe that stands alone."""
        if not len(self.is_keyframe) or not self.is_keyframe[0]:
            raise ExportError(f"The {self.codec} video does not start with a keyframe.")
        return parameter_sets(self.codec, self.first)


class Mp4Writer:
    """One mp4 file; episodes are appended, `close` puts the index in front and makes the file durable.

    Until then it has another name, so that an unfinished file is never taken for a finished one. All methods raise
    OSError when the file cannot be written, and ExportError for images that libav does not understand.
    """

    def __init__(self, path: Path, first: EncodedVideo, *, fps: int) -> None:
        self.parameter_sets = first.parameter_sets()
        self.delay = first.delay
        self.num_images = 0
        self.num_bytes = 0
        self._path = path
        self._unfinished = path.with_suffix(".unfinished")
        self._is_open = True
        path.parent.mkdir(parents=True, exist_ok=True)
        # The protocol is named since libav takes what is before a colon for one. The bit rate would be that of the
        # first image, and without `bitexact` the file would name the version of libav.
        self._container = av.open(
            f"file:{self._unfinished}",
            "w",
            format="mp4",
            container_options={"movflags": "faststart", "write_btrt": "0", "fflags": "bitexact"},
        )
        with self._muxing():
            self._stream = _add_stream(self._container, first)
            self._stream.time_base = Fraction(1, fps)
            self._container.start_encoding()
        # A frame, in the unit that libav has chosen now.
        self._ticks = int(1 / (fps * self._stream.time_base))

    def add(self, video: EncodedVideo) -> None:
        """Append the images of an episode; if they are in a file, it is deleted."""
        time = self.num_images * self._ticks
        shifts = [0] * len(video.sizes) if video.shifts is None else video.shifts.tolist()
        with video.opened() as samples, self._muxing():
            for size, is_keyframe, shift in zip(video.sizes.tolist(), video.is_keyframe.tolist(), shifts, strict=True):
                packet = av.Packet(samples.read(size))
                packet.stream = self._stream
                packet.pts = time + shift * self._ticks
                packet.dts = time - self.delay * self._ticks
                packet.duration = self._ticks
                packet.is_keyframe = is_keyframe
                self._container.mux_one(packet)
                time += self._ticks
        if isinstance(video.samples, Path):
            video.samples.unlink()
        self.num_images += len(video.sizes)
        self.num_bytes += video.num_bytes

    def close(self) -> None:
        """Write the index and give the file its name; harmless when called twice."""
        if self._is_open:
            with self._muxing():
                self._container.close()
            sync_file(self._unfinished)
            self._unfinished.rename(self._path)
            self._is_open = False

    def abort(self) -> None:
        """Drop what was gathered; nothing after `close`."""
        if self._is_open:
            self._is_open = False
            with suppress(av.FFmpegError):  # libav writes the index even so, which fails again on a full disk
                self._container.close()
            self._unfinished.unlink(missing_ok=True)

    @contextmanager
    def _muxing(self) -> Iterator[None]:
        try:
            yield
        except OSError:  # libav's errors of the file system are of this type
            raise
        except av.FFmpegError as error:
            raise ExportError(f"The video cannot be written as mp4 ({error.strerror}): {self._path}") from error


def _add_stream(container: OutputContainer, first: EncodedVideo) -> VideoStream:
    """A stream for samples like those of `first`, as libav describes them in a file of its first image."""
    buffer = io.BytesIO()
    with (
        av.open(io.BytesIO(first.first), format=_DEMUXERS[first.codec]) as source,
        av.open(buffer, "w", format="mp4") as target,
    ):
        packet = av.Packet(first.first)
        packet.stream = target.add_stream_from_template(source.streams.video[0], opaque=True)
        packet.pts = packet.dts = 0
        packet.is_keyframe = True
        target.mux_one(packet)
    buffer.seek(0)
    with av.open(buffer, format="mp4") as described:
        stream = container.add_stream_from_template(described.streams.video[0], opaque=True)
    stream.codec_context.thread_count = 1  # nothing is decoded: no threads for it
    return stream


_AV1_SEQUENCE_HEADER = 1
_AV1_TEMPORAL_DELIMITER = 2
_PARAMETER_SETS = {"h264": (7, 8), "hevc": (32, 33, 34)}


def mp4_samples(
    codec: str, data: bytes, lengths: NDArray[np.int64]
) -> tuple[bytes, NDArray[np.int64], NDArray[np.bool_]]:
    """Access units back to back, as an mp4 file stores them; their lengths there; which ones are keyframes.

    Raises:
        ExportError: One of them is none.
    """
    from demorec.mcap.video import is_keyframe  # loads all that reads recordings

    ends = [0, *accumulate(lengths.tolist())]
    units = [data[a:b] for a, b in pairwise(ends)]
    samples = [mp4_sample(codec, unit) for unit in units]
    if not all(samples):
        raise ExportError(f"A packet of the {codec} video holds no image.")
    sizes = np.array([len(sample) for sample in samples], dtype=np.int64)
    return b"".join(samples), sizes, np.array([is_keyframe(codec, unit) for unit in units], dtype=np.bool_)


def mp4_sample(codec: str, access_unit: bytes) -> bytes:
    """The access unit as an mp4 file stores it; nothing but the framing changes."""
    if codec == "av1":
        return b"".join(
            access_unit[start:end]
            for kind, start, end in _open_bitstream_units(access_unit)
            if kind != _AV1_TEMPORAL_DELIMITER
        )
    parts: list[bytes] = []
    for nal in _nal_units(access_unit):
        parts.append(len(nal).to_bytes(4, "big"))
        parts.append(nal)
    return b"".join(parts)


def parameter_sets(codec: str, access_unit: bytes) -> bytes:
    """What a decoder must know before the first image: one mp4 file holds one of these.

    Raises:
        ExportError: There is none, so the episode does not start with a keyframe that stands alone.
    """
    if codec == "av1":
        found = b"".join(
            access_unit[start:end]
            for kind, start, end in _open_bitstream_units(access_unit)
            if kind == _AV1_SEQUENCE_HEADER
        )
    else:
        wanted = _PARAMETER_SETS[codec]
        found = b"".join(
            struct.pack(">I", len(nal)) + nal for nal in _nal_units(access_unit) if _nal_type(codec, nal) in wanted
        )
    if not found:
        raise ExportError(f"The {codec} video does not start with a keyframe that carries its parameter sets.")
    return found


def _nal_units(access_unit: bytes) -> list[bytes]:
    before, *pieces = access_unit.split(b"\x00\x00\x01")
    if before.strip(b"\x00") or not pieces:
        raise ExportError("A video packet does not begin with a start code: it is no Annex B stream.")
    return [nal for piece in pieces if (nal := piece.rstrip(b"\x00"))]


def _nal_type(codec: str, nal: bytes) -> int:
    return nal[0] & 31 if codec == "h264" else (nal[0] >> 1) & 63


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
