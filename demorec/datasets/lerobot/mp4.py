"""Mp4 files written from coded pictures as they are: no picture is decoded or coded anew.

A file has one video track at a constant rate, every picture presented in coding order, the index (`moov`) in front
so that it can be read over a network (ISO/IEC 14496-12). LeRobot's own writer copies the whole file for every
episode; here the pictures of an episode are appended and the index is written once, at the end.
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
from pathlib import Path
from typing import IO

import av
import numpy as np
from av.container import OutputContainer
from av.video.stream import VideoStream
from numpy.typing import NDArray

from demorec.core.errors import ExportError
from demorec.datasets.lerobot.bitstream import mp4_samples, parameter_sets
from demorec.datasets.staging import sync_file

_DEMUXERS = {"h264": "h264", "hevc": "hevc", "av1": "obu"}


@dataclass(frozen=True, kw_only=True, eq=False)
class CodedVideo:
    """The T pictures of one camera in one episode, and those before them without which they cannot be decoded.

    Attributes:
        codec: "h264", "hevc" or "av1".
        first: The first picture as it was coded, a keyframe.
        samples: All pictures back to back, as an mp4 file stores them; or a file of them that is deleted once written.
        sizes: (lead + T,) int64, bytes of each in `samples`.
        is_keyframe: (lead + T,) bool, which ones can be decoded by themselves.
        digest: SHA-256 of the samples of the T pictures, hex.
        lead: How many pictures are in front that belong to no frame, from a keyframe on.
    """

    codec: str
    width: int
    height: int
    first: bytes
    samples: bytes | Path
    sizes: NDArray[np.int64]
    is_keyframe: NDArray[np.bool_]
    digest: str
    lead: int = 0

    @classmethod
    def of_access_units(
        cls, codec: str, width: int, height: int, data: bytes, lengths: Sequence[int] | NDArray[np.int64], lead: int = 0
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
            digest=hashlib.sha256(memoryview(samples)[int(sizes[:lead].sum()) :]).hexdigest(),
            lead=lead,
        )

    @property
    def num_frames(self) -> int:
        """T."""
        return len(self.sizes) - self.lead

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

    def opened(self) -> IO[bytes]:
        """`samples`, to be read one after the other."""
        return self.samples.open("rb") if isinstance(self.samples, Path) else io.BytesIO(self.samples)

    def parameter_sets(self) -> bytes:
        """Of the first picture; ExportError if that is no keyframe that stands alone."""
        if not len(self.is_keyframe) or not self.is_keyframe[0]:
            raise ExportError(f"The {self.codec} video does not start with a keyframe.")
        return parameter_sets(self.codec, self.first)


class Mp4Writer:
    """One mp4 file; episodes are appended, `close` puts the index in front and makes the file durable.

    Until then it has another name, so that an unfinished file is never taken for a finished one. All methods raise
    OSError when the file cannot be written, and ExportError for pictures that libav does not understand.
    """

    def __init__(self, path: Path, first: CodedVideo, *, fps: int) -> None:
        self.parameter_sets = first.parameter_sets()
        self.num_pictures = 0
        self.num_bytes = 0
        self._path = path
        self._unfinished = path.with_suffix(".unfinished")
        self._is_open = True
        path.parent.mkdir(parents=True, exist_ok=True)
        # The protocol is named since libav takes what is before a colon for one. The bit rate would be that of the
        # first picture, and without `bitexact` the file would name the version of libav.
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

    def add(self, video: CodedVideo) -> None:
        """Append the pictures of an episode; if they are in a file, it is deleted."""
        time = self.num_pictures * self._ticks
        with video.opened() as samples, self._muxing():
            for size, is_keyframe in zip(video.sizes.tolist(), video.is_keyframe.tolist(), strict=True):
                packet = av.Packet(samples.read(size))
                packet.stream = self._stream
                packet.pts = packet.dts = time
                packet.duration = self._ticks
                packet.is_keyframe = is_keyframe
                self._container.mux_one(packet)
                time += self._ticks
        if isinstance(video.samples, Path):
            video.samples.unlink()
        self.num_pictures += len(video.sizes)
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
        """Drop what was collected; nothing after `close`."""
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


def _add_stream(container: OutputContainer, first: CodedVideo) -> VideoStream:
    """A stream for samples like those of `first`, as libav describes them in a file of its first picture."""
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
