"""Mp4 files written from coded pictures as they are: no picture is decoded or coded anew.

A file has one video track at a constant rate, every picture presented in coding order, the index (`moov`) in front
so that it can be read over a network (ISO/IEC 14496-12). LeRobot's own writer copies the whole file for every
episode; here the pictures of an episode are appended and the index is written once, at the end.
"""

from __future__ import annotations

import hashlib
import io
import os
import struct
import tempfile
from array import array
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import IO

import av
import numpy as np
from numpy.typing import NDArray

from demorec.errors import ExportError
from demorec.export.bitstream import mp4_samples, parameter_sets

_DEMUXERS = {"h264": "h264", "hevc": "hevc", "av1": "obu"}
_MATRIX = struct.pack(">9i", 0x10000, 0, 0, 0, 0x10000, 0, 0, 0, 0x40000000)
_MOVIE_TIMESCALE = 1000


@dataclass(frozen=True, kw_only=True, eq=False)
class CodedVideo:
    """The T pictures of one camera in one episode.

    Attributes:
        codec: "h264", "hevc" or "av1".
        first: The first picture as it was coded, a keyframe.
        samples: All pictures back to back, as an mp4 file stores them; or a file of them that is deleted once written.
        sizes: (T,) int64, bytes of each in `samples`.
        is_keyframe: (T,) bool, which ones can be decoded by themselves.
        digest: SHA-256 of `samples`, hex.
    """

    codec: str
    width: int
    height: int
    first: bytes
    samples: bytes | Path
    sizes: NDArray[np.int64]
    is_keyframe: NDArray[np.bool_]
    digest: str

    @classmethod
    def of_access_units(
        cls, codec: str, width: int, height: int, data: bytes, lengths: Sequence[int] | NDArray[np.int64]
    ) -> CodedVideo:
        """From pictures back to back, as they were coded, and the length of each; ExportError if that is none."""
        unit_lengths = np.asarray(lengths, dtype=np.int64)
        samples, sizes, is_key = mp4_samples(codec, data, unit_lengths)
        first = data[: int(unit_lengths[0])] if len(unit_lengths) else b""
        return cls(
            codec=codec,
            width=width,
            height=height,
            first=first,
            samples=samples,
            sizes=sizes,
            is_keyframe=is_key,
            digest=hashlib.sha256(samples).hexdigest(),
        )

    @property
    def num_bytes(self) -> int:
        """Of all pictures."""
        return int(self.sizes.sum())

    def put_aside(self, folder: Path) -> CodedVideo:
        """The same with its `samples`, bytes so far, in a new file in `folder`: cheap to hand to another process."""
        assert isinstance(self.samples, bytes)
        handle, name = tempfile.mkstemp(dir=folder)
        with os.fdopen(handle, "wb") as file:
            file.write(self.samples)
        return replace(self, samples=Path(name))

    def parameter_sets(self) -> bytes:
        """Of the first picture; ExportError if that is no keyframe that stands alone."""
        if not len(self.is_keyframe) or not self.is_keyframe[0]:
            raise ExportError(f"The {self.codec} video does not start with a keyframe.")
        return parameter_sets(self.codec, self.first)


class Mp4Writer:
    """One mp4 file; episodes are appended, `close` puts the index in front and makes the file durable.

    Until then the pictures lie in a file beside it, so that an unfinished file is never taken for a finished one.
    """

    def __init__(self, path: Path, first: CodedVideo, *, fps: int) -> None:
        self.parameter_sets = first.parameter_sets()
        self.num_frames = 0
        self.num_bytes = 0
        self._path = path
        self._fps = fps
        self._size = (first.width, first.height)
        self._sample_entry = _sample_entry(first.codec, first.first)
        self._sizes = array("I")
        self._keyframes = array("I")
        self._chunks: list[tuple[int, int]] = []  # (samples, bytes) of each episode
        path.parent.mkdir(parents=True, exist_ok=True)
        self._body_path = path.with_suffix(".pictures")
        self._body: IO[bytes] = self._body_path.open("w+b")

    def add(self, video: CodedVideo) -> None:
        """Append the pictures of an episode."""
        if isinstance(video.samples, Path):
            self._body.flush()
            with video.samples.open("rb") as file:
                _copy(file, self._body, video.num_bytes)
            self._body.seek(0, os.SEEK_END)
            video.samples.unlink()
        else:
            self._body.write(video.samples)
        self._sizes.extend(video.sizes.tolist())
        self._keyframes.extend((np.flatnonzero(video.is_keyframe) + self.num_frames + 1).tolist())
        self._chunks.append((len(video.sizes), video.num_bytes))
        self.num_frames += len(video.sizes)
        self.num_bytes += video.num_bytes

    def close(self) -> None:
        """Write index and pictures into the final file; harmless when called twice."""
        if self._body.closed:
            return
        self._body.flush()
        file_type = _box(b"ftyp", b"isom", struct.pack(">I", 0x200), b"isomiso2mp41")
        wide = self.num_bytes + (1 << 20) + 8 * len(self._sizes) > 0xFFFFFFFF
        header = struct.pack(">I4s", self.num_bytes + 8, b"mdat")
        if wide:
            header = struct.pack(">I4sQ", 1, b"mdat", self.num_bytes + 16)
        index = self._index(0, wide)
        index = self._index(len(file_type) + len(index) + len(header), wide)
        with self._path.open("wb") as file:
            file.write(file_type + index + header)
            file.flush()
            _copy(self._body, file, self.num_bytes)
            os.fsync(file.fileno())
        self.abort()

    def abort(self) -> None:
        """Drop what was collected."""
        self._body.close()
        self._body_path.unlink(missing_ok=True)

    def _index(self, data_offset: int, wide: bool) -> bytes:
        # As libav does it: the smallest timescale above 10 kHz that a frame divides (15360 at 30 fps).
        timescale = self._fps
        while timescale < 10_000:
            timescale *= 2
        ticks = timescale // self._fps
        duration = self.num_frames * ticks
        movie_duration = -(-duration * _MOVIE_TIMESCALE // timescale)
        width, height = self._size
        movie_header = _full_box(
            b"mvhd",
            1,
            0,
            struct.pack(">QQIQ", 0, 0, _MOVIE_TIMESCALE, movie_duration),
            struct.pack(">IH10x", 0x10000, 0x100),
            _MATRIX,
            bytes(24),
            struct.pack(">I", 2),
        )
        track_header = _full_box(
            b"tkhd",
            1,
            3,
            struct.pack(">QQI4xQ", 0, 0, 1, movie_duration),
            struct.pack(">8xHHH2x", 0, 0, 0),
            _MATRIX,
            struct.pack(">II", width << 16, height << 16),
        )
        media_header = _full_box(
            b"mdhd", 1, 0, struct.pack(">QQIQ", 0, 0, timescale, duration), struct.pack(">HH", 0x55C4, 0)
        )
        handler = _full_box(b"hdlr", 0, 0, struct.pack(">4x4s12x", b"vide"), b"VideoHandler\x00")
        data_reference = _box(b"dinf", _full_box(b"dref", 0, 0, struct.pack(">I", 1), _full_box(b"url ", 0, 1)))
        tables = _box(b"stbl", self._sample_entry, *self._sample_tables(ticks, data_offset, wide))
        information = _box(b"minf", _full_box(b"vmhd", 0, 1, bytes(8)), data_reference, tables)
        media = _box(b"mdia", media_header, handler, information)
        return _box(b"moov", movie_header, _box(b"trak", track_header, media))

    def _sample_tables(self, ticks: int, data_offset: int, wide: bool) -> Iterable[bytes]:
        yield _full_box(b"stts", 0, 0, struct.pack(">III", 1, self.num_frames, ticks))
        if len(self._keyframes) < self.num_frames:
            yield _full_box(b"stss", 0, 0, _counted(np.array(self._keyframes, dtype=">u4")))
        runs: list[tuple[int, int, int]] = []  # (first chunk, samples per chunk, sample entry)
        offsets = []
        position = data_offset
        for number, (samples, size) in enumerate(self._chunks, start=1):
            if not runs or runs[-1][1] != samples:
                runs.append((number, samples, 1))
            offsets.append(position)
            position += size
        yield _full_box(b"stsc", 0, 0, _counted(np.array(runs, dtype=">u4")))
        sizes = np.array(self._sizes, dtype=">u4")
        yield _full_box(b"stsz", 0, 0, struct.pack(">II", 0, len(sizes)), sizes.tobytes())
        if wide:
            yield _full_box(b"co64", 0, 0, _counted(np.array(offsets, dtype=">u8")))
        else:
            yield _full_box(b"stco", 0, 0, _counted(np.array(offsets, dtype=">u4")))


def _box(kind: bytes, *parts: bytes) -> bytes:
    body = b"".join(parts)
    return struct.pack(">I4s", len(body) + 8, kind) + body


def _full_box(kind: bytes, version: int, flags: int, *parts: bytes) -> bytes:
    return _box(kind, struct.pack(">I", version << 24 | flags), *parts)


def _counted(entries: np.ndarray) -> bytes:  # type: ignore[type-arg]
    return struct.pack(">I", len(entries)) + entries.tobytes()


def _copy(source: IO[bytes], target: IO[bytes], size: int) -> None:
    """Copy the whole of `source` behind what `target` has, inside the kernel where it can."""
    source.seek(0)
    copied = 0
    try:
        while copied < size:
            count = os.copy_file_range(source.fileno(), target.fileno(), size - copied, offset_src=copied)
            if count == 0:
                break
            copied += count
    except (OSError, AttributeError):
        if copied:
            raise
    source.seek(copied)
    while block := source.read(1 << 20):
        target.write(block)
    target.flush()


def _sample_entry(codec: str, access_unit: bytes) -> bytes:
    """The `stsd` box that describes the coding, taken from a one-picture file that libav writes."""
    buffer = io.BytesIO()
    try:
        with (
            av.open(io.BytesIO(access_unit), format=_DEMUXERS[codec]) as source,
            av.open(buffer, "w", format="mp4") as target,
        ):
            stream = target.add_stream_from_template(source.streams.video[0], opaque=True)
            stream.time_base = Fraction(1, 30)
            packet = av.Packet(access_unit)
            packet.pts = packet.dts = 0
            packet.duration = 1
            packet.time_base = Fraction(1, 30)
            packet.is_keyframe = True
            packet.stream = stream
            target.mux_one(packet)
    except av.FFmpegError as error:
        raise ExportError(f"The first picture of a {codec} video cannot be understood ({error}).") from error
    return _without_bitrate(_find_box(buffer.getvalue(), (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"stsd")))


def _find_box(data: bytes, path: Sequence[bytes]) -> bytes:
    start, end = 0, len(data)
    for depth, kind in enumerate(path):
        while start < end:
            size, found = struct.unpack_from(">I4s", data, start)
            if found == kind:
                break
            start += size
        else:
            raise ExportError(f"libav wrote an mp4 file without {kind.decode()}.")
        end = start + size
        if depth < len(path) - 1:
            start += 8
    return data[start:end]


def _without_bitrate(description: bytes) -> bytes:
    """The stsd box less `btrt`, which would tell the bit rate of the one picture."""
    entry_start, fixed = 16, 8 + 78  # the first sample entry; its fields before the boxes inside
    entry = description[entry_start:]
    kept = [entry[8:fixed]]
    position = fixed
    while position < len(entry):
        size, kind = struct.unpack_from(">I4s", entry, position)
        if kind != b"btrt":
            kept.append(entry[position : position + size])
        position += size
    return _box(b"stsd", description[8:entry_start], _box(entry[4:8], *kept))
