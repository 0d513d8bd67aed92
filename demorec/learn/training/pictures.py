"""Pictures of video files at given times: those of a batch together, each decoded once.

LeRobot opens the file for every item, decodes from the key frame before the wanted one and makes colours of all that
it passes. Here a file stays open, the frames of a batch are wanted in their order in the file, decoding goes on where
it stands unless a key frame is nearer, and only what is wanted is converted.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator, Sequence
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
import torch
from lerobot.datasets.video_utils import FrameTimestampError, VideoDecoderCache
from numpy.typing import NDArray

from demorec.learn.training.video_file import DecodedFrame, VideoFile

_PYAV_NAMES = ("pyav", "video_reader")
"""LeRobot's names of the decoder; the second is an old one."""
_OPEN_FILES = 64


class FrameCache:
    """Decoded frames within a limit of bytes; forgets those that have not been wanted for the longest time."""

    def __init__(self, limit_bytes: int) -> None:
        self._limit = limit_bytes
        self._held = 0
        self._frames: OrderedDict[tuple[str, int], DecodedFrame] = OrderedDict()

    @property
    def num_bytes(self) -> int:
        """Of the pictures that are held."""
        return self._held

    def get(self, path: str, number: int) -> DecodedFrame | None:
        """A frame of a file by its number there; None when it is not held."""
        frame = self._frames.get((path, number))
        if frame is not None:
            self._frames.move_to_end((path, number))
        return frame

    def put(self, path: str, number: int, frame: DecodedFrame) -> None:
        """Hold a frame that is not held yet; its picture must own its memory, and nobody may change it."""
        if frame.picture.nbytes > self._limit:
            return
        self._frames[path, number] = frame
        self._held += frame.picture.nbytes
        while self._held > self._limit:
            _, forgotten = self._frames.popitem(last=False)
            self._held -= forgotten.picture.nbytes


class PictureReader:
    """Open files and the cache of frames of one process; its methods may be called from several threads.

    Args:
        backend: LeRobot's name of the decoder of colours.
        tolerance_s: How far from the wanted time a frame may lie.
        cache_bytes: Limit of the decoded frames that are kept, as uint8 or uint16.
    """

    def __init__(self, backend: str, tolerance_s: float, cache_bytes: int) -> None:
        self._backend = backend
        self._tolerance_s = tolerance_s
        self._cache = FrameCache(cache_bytes)
        self._files: OrderedDict[tuple[str, bool], VideoFile] = OrderedDict()
        self._torchcodec = VideoDecoderCache()
        self._lock = Lock()

    def read(self, path: Path, times_s: NDArray[np.float64], *, is_depth: bool) -> list[torch.Tensor]:
        """The pictures of several items from one file.

        Args:
            path: Of the file.
            times_s: (B, T) seconds in the file.
            is_depth: Whether it holds codes of depth instead of colours.

        Returns:
            B tensors (T, C, H, W) of their own memory, uint8 or uint16.

        Raises:
            FrameTimestampError: The file has no frame within the tolerance of a time.
            ValueError: There is no such backend.
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
                f"There is no frame within {self._tolerance_s} s of {time:.6f} s, the nearest lies at "
                f"{found[is_far][0]:.6f} s, so the video does not fit the table of the frames: {path}"
            )
        chosen = np.take_along_axis(numbers, nearest, 1)
        return [torch.stack([frames[n].picture for n in row]) for row in chosen.tolist()]

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
        if self._backend == "torchcodec" and not is_depth:  # which reads no depth, as LeRobot has it
            return _TorchcodecFile(self._torchcodec.get_decoder(path))
        if self._backend not in _PYAV_NAMES and not is_depth:
            raise ValueError(f"The video backend is {self._backend!r}, allowed are 'pyav' and 'torchcodec'.")
        key = (path, is_depth)
        if key not in self._files:
            self._files[key] = VideoFile(path, "gray12le" if is_depth else "rgb24")
        self._files.move_to_end(key)
        while len(self._files) > _OPEN_FILES:
            self._files.popitem(last=False)[1].close()
        return self._files[key]


class _TorchcodecFile:
    """A decoder of torchcodec, opened as LeRobot opens it, with the methods of `VideoFile`."""

    def __init__(self, decoder: Any) -> None:
        self._decoder = decoder

    def numbers(self, times_s: NDArray[np.float64]) -> NDArray[np.int64]:
        fps: float = self._decoder.metadata.average_fps
        return np.rint(times_s * fps).astype(np.int64)

    def decode(self, numbers: Sequence[int]) -> Iterator[tuple[int, DecodedFrame]]:
        if numbers:
            batch = self._decoder.get_frames_at(indices=list(numbers))
            for number, picture, time_s in zip(numbers, batch.data, batch.pts_seconds.tolist(), strict=True):
                yield number, DecodedFrame(picture.clone(), time_s)  # else one frame would hold the memory of all
