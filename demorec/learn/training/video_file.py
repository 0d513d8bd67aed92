"""One video file that stays open: any frame of it, decoded by PyAV from the nearest key frame on."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from fractions import Fraction
from typing import NamedTuple

import av
import numpy as np
import torch
from av.video.reformatter import VideoReformatter
from lerobot.datasets.video_utils import FrameTimestampError
from numpy.typing import NDArray


class DecodedFrame(NamedTuple):
    """A picture and the time in its file, in seconds: (C, H, W), uint8 colours or uint16 codes of depth."""

    picture: torch.Tensor
    time_s: float


class VideoFile:
    """Frames of the first video stream, numbered in the order in which they are shown.

    Args:
        path: Of the file.
        pixel_format: What frames are converted to: rgb24 or gray12le.

    Raises:
        FrameTimestampError: There is no frame in it.
        OSError: It cannot be opened or decoded.
    """

    def __init__(self, path: str, pixel_format: str) -> None:
        self._path = path
        self._format = pixel_format
        self._container = av.open(path)
        self._stream = self._container.streams.video[0]
        # One thread: none has to be ended in a forked process, and none decodes ahead of what is wanted.
        self._stream.codec_context.thread_count = 1
        self._reformatter = VideoReformatter()
        pts, is_key = self._timetable()
        self._pts = pts
        ticks = self._stream.time_base or Fraction(1)
        self._times_s = pts * ticks.numerator / ticks.denominator
        self._keys = np.union1d([0], np.flatnonzero(is_key))
        self._decoded: Iterator[av.VideoFrame] = iter(())
        self._last: float = math.inf

    def close(self) -> None:
        """Close the file."""
        self._container.close()

    def numbers(self, times_s: NDArray[np.float64]) -> NDArray[np.int64]:
        """The frames nearest to these times."""
        after = np.minimum(np.searchsorted(self._times_s, times_s), len(self._times_s) - 1)
        before = np.maximum(after - 1, 0)
        is_before = times_s - self._times_s[before] <= self._times_s[after] - times_s
        return np.where(is_before, before, after)

    def decode(self, numbers: Sequence[int]) -> Iterator[tuple[int, DecodedFrame]]:
        """The frames of these numbers, which ascend."""
        for number in numbers:
            frame = self._reformatter.reformat(self._frame(number), format=self._format)
            pixels = torch.from_numpy(frame.to_ndarray())
            pixels = pixels.permute(2, 0, 1) if pixels.ndim == 3 else pixels.unsqueeze(0)
            yield number, DecodedFrame(pixels.contiguous(), float(self._times_s[number]))

    def _frame(self, number: int) -> av.VideoFrame:
        key = int(self._keys[np.searchsorted(self._keys, number, side="right") - 1])
        if key - 1 <= self._last < number:
            frame = self._decode_to(number)
            if frame is not None:
                return frame
        # Where frames are shown in another order than they are coded, a key frame may lie behind what is wanted.
        for start in sorted({key, max(0, key - 1), 0}, reverse=True):
            self._container.seek(int(self._pts[start]), backward=True, any_frame=False, stream=self._stream)
            self._decoded = self._container.decode(self._stream)
            self._last = start - 1
            frame = self._decode_to(number)
            if frame is not None:
                return frame
        raise FrameTimestampError(f"The frame at {self._times_s[number]:.6f} s cannot be decoded: {self._path}")

    def _decode_to(self, number: int) -> av.VideoFrame | None:
        """Decode on to a frame; None when it does not come."""
        for frame in self._decoded:
            self._last = self._number(frame.pts)
            if self._last >= number:
                return frame if self._last == number else None
        self._last = math.inf  # at its end, a stream must be sought
        return None

    def _number(self, pts: int | None) -> float:
        """Of a decoded frame; of one that has no place in the file, the number of the last that has."""
        if pts is None:
            return self._last
        number = int(np.searchsorted(self._pts, pts))
        return number if number < len(self._pts) and self._pts[number] == pts else self._last

    def _timetable(self) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Of all frames in the order in which they are shown: time in ticks, and whether it is a key frame."""
        packets = [(p.pts, p.is_keyframe) for p in self._container.demux(self._stream) if p.size and p.pts is not None]
        packets.sort()
        if not packets:
            raise FrameTimestampError(f"There is no frame in this video: {self._path}")
        return np.array([pts for pts, _ in packets], np.int64), np.array([key for _, key in packets], bool)
