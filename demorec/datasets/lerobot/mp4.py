"""Mp4 writer for encoded images, without decoding or re-encoding.

A file has one video track at a constant rate, and its index at the start so that it can be read over a network.
LeRobot's own writer copies the whole file for every episode; this one appends images and writes the index once, at the
end.
"""

from __future__ import annotations

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


@dataclass(frozen=True, kw_only=True, eq=False)
class EncodedVideo:
    """The T images of one camera in one episode, and further images needed to decode them.

    Attributes:
        codec: "h264", "hevc" or "av1", or another one by libav's name.
        first: The first image as encoded, a keyframe; for other codecs an mp4 file of it alone.
        samples: All images concatenated in mp4's form, or a file with them, which is deleted once they are written.
        sizes: (lead + T + tail,) int64, size of each in bytes.
        is_keyframe: (lead + T + tail,) bool, whether each can be decoded independently.
        digest: SHA-256 (hex) of the T samples; with a tail, of the samples stored in their places. "" if not requested.
        lead: Number of images before the first frame, starting with a keyframe.
        tail: Number of images shown after the last frame, from which some of the T are decoded.
        shifts: (lead + T + tail,) int64, display position minus storage position of each image; None if both orders are
        equal.
    """

    codec: str
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
        cls, codec: str, data: bytes, lengths: Sequence[int] | NDArray[np.int64], lead: int = 0
    ) -> EncodedVideo:
        """Build from concatenated access units and their lengths; ExportError if they are invalid."""
        ends = np.cumsum(np.asarray(lengths, dtype=np.int64)).tolist()
        units = [data[begin:end] for begin, end in pairwise([0, *ends])]
        parts = [list(_units(codec, unit)) for unit in units]
        samples = [b"".join(stored for _, stored in part) for part in parts]
        if not all(samples):
            raise ExportError(f"A packet of the {codec} video holds no image.")
        keyframes = [any(kind in _KEYFRAMES[codec] for kind, _ in part) for part in parts]
        video = cls(
            codec=codec,
            first=units[0] if units else b"",
            samples=b"".join(samples),
            sizes=np.array([len(sample) for sample in samples], dtype=np.int64),
            is_keyframe=np.array(keyframes, dtype=np.bool_),
            lead=lead,
        )
        return video.with_digest()

    def with_digest(self) -> EncodedVideo:
        """Return a copy with its digest."""
        begin, end = (int(self.sizes[:count].sum()) for count in (self.lead, self.lead + self.num_frames))
        return replace(self, digest=hashlib.sha256(memoryview(self.read())[begin:end]).hexdigest())

    @property
    def num_frames(self) -> int:
        """T."""
        return len(self.sizes) - self.lead - self.tail

    @property
    def delay(self) -> int:
        """Number of images that a decoder must hold back to show them in order."""
        return 0 if self.shifts is None else -int(self.shifts.min())

    @property
    def num_bytes(self) -> int:
        """Total size of the images."""
        return int(self.sizes.sum())

    def put_aside(self, folder: Path) -> EncodedVideo:
        """Move `samples` to a new file in `folder`, so that passing to another process is cheap."""
        handle, name = tempfile.mkstemp(dir=folder)
        with os.fdopen(handle, "wb") as file:
            file.write(self.read())
        return replace(self, samples=Path(name))

    def read(self) -> bytes:
        """Read all images, concatenated; OSError if their file cannot be read."""
        return self.samples if isinstance(self.samples, bytes) else self.samples.read_bytes()

    def parameter_sets(self) -> bytes:
        """Parameter sets for the decoder; ExportError if the first image is not an independent keyframe."""
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
    """Writer of one mp4 file; episodes are appended, and `close` writes the index at the start.

    Until then the file has another name, so that an unfinished one is never mistaken for a finished one. Methods raise
    OSError if the file cannot be written, and ExportError for images that libav cannot parse.
    """

    def __init__(self, path: Path, first: EncodedVideo, *, fps: int) -> None:
        self.parameter_sets = first.parameter_sets()
        self.delay = first.delay
        self.num_images = 0
        self.num_bytes = 0
        self._path, self._unfinished = path, path.with_suffix(".unfinished")
        template = _first_image_file(first, path)
        path.parent.mkdir(parents=True, exist_ok=True)
        # The bit rate would be the first image's, and without `bitexact` the file would contain libav's version.
        options = {"movflags": "faststart", "write_btrt": "0", "fflags": "bitexact"}
        self._file: OutputContainer | None = av.open(
            str(self._unfinished), "w", format="mp4", container_options=options
        )
        with av.open(template, format="mp4") as image:
            self._stream = self._file.add_stream_from_template(image.streams.video[0], opaque=True)
        self._stream.codec_context.thread_count = 1  # nothing is decoded, so it needs no threads
        self._stream.time_base = Fraction(1, fps)
        self._file.start_encoding()
        # duration of a frame, in the unit that libav has now chosen
        self._ticks = int(1 / (fps * self._stream.time_base))

    def add(self, video: EncodedVideo) -> None:
        """Append the images of an episode; a separate file with them is deleted."""
        shifts = [0] * len(video.sizes) if video.shifts is None else video.shifts.tolist()
        data, begin = video.read(), 0
        with _mux_errors(self._path):
            for size, is_key, shift in zip(video.sizes.tolist(), video.is_keyframe.tolist(), shifts, strict=True):
                self._mux(data[begin : begin + size], is_key, shift)
                begin += size
        self.num_bytes += video.num_bytes
        if isinstance(video.samples, Path):
            video.samples.unlink()

    def _mux(self, sample: bytes, is_keyframe: bool, shift: int) -> None:
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
        """Write the index and rename the file; idempotent."""
        if self._file is not None:
            with _mux_errors(self._path):
                self._file.close()
            self._unfinished.rename(self._path)
            self._file = None

    def abort(self) -> None:
        """Discard the file; does nothing after `close`."""
        if self._file is not None:
            with suppress(OSError, av.FFmpegError):  # libav may raise the same error again
                self._file.close()
            self._file = None
            self._unfinished.unlink(missing_ok=True)


def one_image_file(image: bytes, stream: av.VideoStream) -> bytes:
    """Write an mp4 file of one image, encoded as the stream describes."""
    described = io.BytesIO()
    with av.open(described, "w", format="mp4") as target:
        packet = av.Packet(image)
        packet.stream = target.add_stream_from_template(stream, opaque=True)
        packet.pts = packet.dts = 0
        packet.is_keyframe = True
        target.mux_one(packet)
    return described.getvalue()


def _first_image_file(video: EncodedVideo, path: Path) -> io.BytesIO:
    """Return an mp4 file of the first image alone, as a template of the encoding, for the file at `path`."""
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
"""Type of an AV1 unit that mp4 files omit."""
_KEYFRAMES = {"h264": (5,), "hevc": range(16, 22), "av1": (1,)}
"""Types of units that occur only in independently decodable images: slices of IDR and IRAP, AV1's headers."""
_PARAMETER_SETS = {"h264": (7, 8), "hevc": (32, 33, 34), "av1": (1,)}
"""Types of units of which an mp4 file holds one set: a decoder needs them before the first image."""


def _units(codec: str, access_unit: bytes) -> Iterator[tuple[int, bytes]]:
    """Type of each unit, and the unit in mp4's form: only the framing changes."""
    if codec == "av1":
        from demorec.mcap.video import obu_units  # loads all code for reading recordings

        for kind, start, end in obu_units(access_unit):
            if not access_unit[start] & 2:
                raise ExportError("An AV1 packet holds a unit without a size field.")
            if end > len(access_unit):
                raise ExportError("An AV1 packet is truncated.")
            if kind != _TEMPORAL_DELIMITER:
                yield kind, access_unit[start:end]
        return
    before, *pieces = access_unit.split(b"\x00\x00\x01")
    if before.strip(b"\x00") or not pieces:
        raise ExportError("A video packet does not begin with a start code: it is not an Annex B stream.")
    for nal in (piece.rstrip(b"\x00") for piece in pieces):
        if nal:
            yield nal[0] & 31 if codec == "h264" else (nal[0] >> 1) & 63, len(nal).to_bytes(4, "big") + nal
