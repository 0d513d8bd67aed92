"""Images of video files at given times; those of a batch are decoded together, each once.

LeRobot opens the file for every item, decodes from the key frame before the wanted one and converts all frames on the
way to RGB. Here a file stays open, the frames of a batch are decoded in their order in the file, decoding continues
from the last frame unless a key frame is nearer, and only wanted frames are converted.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from threading import Lock
from typing import Any, NamedTuple

import av
import numpy as np
import torch
from av.video.reformatter import VideoReformatter
from lerobot.datasets.video_utils import FrameTimestampError, VideoDecoderCache
from numpy.typing import NDArray


class DecodedFrame(NamedTuple):
    """An image and the time in its file, in seconds: (C, H, W), uint8 colours or uint16 codes of depth."""

    image: torch.Tensor
    time_s: float


class VideoFile:
    """Frames of the first video stream, numbered in the order in which they are shown.

    Args:
        path: Path of the file.
        pixel_format: Format that frames are converted to: rgb24 or gray12le.

    Raises:
        FrameTimestampError: The file has no frame.
        OSError: The file cannot be opened or decoded.
    """

    def __init__(self, path: str, pixel_format: str) -> None:
        self._path = path
        self._format = pixel_format
        self._container = av.open(path)
        self._stream = self._container.streams.video[0]
        # One thread: more would have to be ended in a forked process, and would decode unwanted frames.
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
        """Find the frames nearest to these times."""
        after = np.minimum(np.searchsorted(self._times_s, times_s), len(self._times_s) - 1)
        before = np.maximum(after - 1, 0)
        is_before = times_s - self._times_s[before] <= self._times_s[after] - times_s
        return np.where(is_before, before, after)

    def decode(self, numbers: Sequence[int]) -> Iterator[tuple[int, DecodedFrame]]:
        """Decode the frames of these ascending numbers."""
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
        # If the display order differs from the coding order, the key frame may follow the wanted frame.
        for start in sorted({key, max(0, key - 1), 0}, reverse=True):
            self._container.seek(int(self._pts[start]), backward=True, any_frame=False, stream=self._stream)
            self._decoded = self._container.decode(self._stream)
            self._last = start - 1
            frame = self._decode_to(number)
            if frame is not None:
                return frame
        raise FrameTimestampError(f"The frame at {self._times_s[number]:.6f} s cannot be decoded: {self._path}")

    def _decode_to(self, number: int) -> av.VideoFrame | None:
        """Continue decoding up to a frame; None if it does not come."""
        for frame in self._decoded:
            self._last = self._number(frame.pts)
            if self._last >= number:
                return frame if self._last == number else None
        self._last = math.inf  # at its end, a stream must be sought
        return None

    def _number(self, pts: int | None) -> float:
        """Number of a decoded frame; that of the frame before if its time is not in the file."""
        if pts is None:
            return self._last
        number = int(np.searchsorted(self._pts, pts))
        return number if number < len(self._pts) and self._pts[number] == pts else self._last

    def _timetable(self) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Times in ticks, and whether it is a key frame, of all frames in display order."""
        packets = [(p.pts, p.is_keyframe) for p in self._container.demux(self._stream) if p.size and p.pts is not None]
        packets.sort()
        if not packets:
            raise FrameTimestampError(f"The video has no frames: {self._path}")
        return np.array([pts for pts, _ in packets], np.int64), np.array([key for _, key in packets], bool)


_PYAV_NAMES = ("pyav", "video_reader")
"""LeRobot's names of the decoder; the second is an old one."""
_MAX_OPEN_FILES = 64


class FrameCache:
    """Decoded frames within a limit of bytes; drops the least recently used ones."""

    def __init__(self, limit_bytes: int) -> None:
        self._limit = limit_bytes
        self._held = 0
        self._frames: OrderedDict[tuple[str, int], DecodedFrame] = OrderedDict()

    @property
    def num_bytes(self) -> int:
        """Size of the images that are held."""
        return self._held

    def get(self, path: str, number: int) -> DecodedFrame | None:
        """Get a frame of a file by its number; None if it is not held."""
        frame = self._frames.get((path, number))
        if frame is not None:
            self._frames.move_to_end((path, number))
        return frame

    def put(self, path: str, number: int, frame: DecodedFrame) -> None:
        """Hold a frame that is not held yet; its image must own its memory and never change."""
        if frame.image.nbytes > self._limit:
            return
        self._frames[path, number] = frame
        self._held += frame.image.nbytes
        while self._held > self._limit:
            _, forgotten = self._frames.popitem(last=False)
            self._held -= forgotten.image.nbytes


class ImageReader:
    """Open files and the frame cache of one process; its methods may be called from several threads.

    Args:
        backend: LeRobot's name of the decoder of colours.
        tolerance_s: Maximum difference between the time of a frame and the wanted time.
        cache_bytes: Maximum size of the decoded frames that are kept, as uint8 or uint16.
    """

    def __init__(self, backend: str, tolerance_s: float, cache_bytes: int) -> None:
        self._backend = backend
        self._tolerance_s = tolerance_s
        self._cache = FrameCache(cache_bytes)
        self._files: OrderedDict[tuple[str, bool], VideoFile] = OrderedDict()
        self._torchcodec = VideoDecoderCache()
        self._lock = Lock()

    def read(self, path: Path, times_s: NDArray[np.float64], *, is_depth: bool) -> list[torch.Tensor]:
        """Read the images of several items from one file.

        Args:
            path: Path of the file.
            times_s: (B, T) seconds in the file.
            is_depth: Whether it holds codes of depth instead of colours.

        Returns:
            B tensors (T, C, H, W), uint8 or uint16.

        Raises:
            FrameTimestampError: The file has no frame within the tolerance of a time.
            ValueError: The backend is unknown.
        """
        with self._lock:
            decoder = self._decoder(str(path), is_depth)
            numbers = decoder.numbers(times_s)
            frames = self._frames(str(path), decoder, sorted(set(numbers.reshape(-1).tolist())))
        # As LeRobot chooses: in single precision, of an item's own frames the nearest to each of its times.
        wanted = times_s.astype(np.float32)
        found = np.array([[frames[n].time_s for n in row] for row in numbers.tolist()], np.float32)
        distance = np.abs(wanted[:, :, None] - found[:, None, :])
        nearest = distance.argmin(2)
        is_far = ~(distance.min(2) < self._tolerance_s)
        if is_far.any():
            time = times_s[is_far][0]
            raise FrameTimestampError(
                f"The video has no frame within {self._tolerance_s} s of {time:.6f} s (the nearest is at "
                f"{found[is_far][0]:.6f} s), so it does not match the table of the frames: {path}"
            )
        chosen = np.take_along_axis(numbers, nearest, 1)
        return [torch.stack([frames[n].image for n in row]) for row in chosen.tolist()]

    def _frames(
        self, path: str, decoder: VideoFile | _TorchcodecFile, numbers: Sequence[int]
    ) -> dict[int, DecodedFrame]:
        held = {number: self._cache.get(path, number) for number in numbers}
        frames = {number: frame for number, frame in held.items() if frame is not None}
        for number, frame in decoder.decode([number for number in numbers if number not in frames]):
            frames[number] = frame
            self._cache.put(path, number, frame)
        return frames

    def _decoder(self, path: str, is_depth: bool) -> VideoFile | _TorchcodecFile:
        if self._backend == "torchcodec" and not is_depth:  # as in LeRobot, it does not read depth
            return _TorchcodecFile(self._torchcodec.get_decoder(path))
        if self._backend not in _PYAV_NAMES and not is_depth:
            raise ValueError(f"The video backend is {self._backend!r}; choose 'pyav' or 'torchcodec'.")
        key = (path, is_depth)
        if key not in self._files:
            self._files[key] = VideoFile(path, "gray12le" if is_depth else "rgb24")
        self._files.move_to_end(key)
        while len(self._files) > _MAX_OPEN_FILES:
            self._files.popitem(last=False)[1].close()
        return self._files[key]


class _TorchcodecFile:
    """A decoder of torchcodec with the methods of `VideoFile`."""

    def __init__(self, decoder: Any) -> None:
        self._decoder = decoder

    def numbers(self, times_s: NDArray[np.float64]) -> NDArray[np.int64]:
        fps: float = self._decoder.metadata.average_fps
        return np.rint(times_s * fps).astype(np.int64)

    def decode(self, numbers: Sequence[int]) -> Iterator[tuple[int, DecodedFrame]]:
        if numbers:
            batch = self._decoder.get_frames_at(indices=list(numbers))
            for number, image, time_s in zip(numbers, batch.data, batch.pts_seconds.tolist(), strict=True):
                yield number, DecodedFrame(image.clone(), time_s)  # without this, one frame keeps the memory of all
