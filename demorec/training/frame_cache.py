"""Decoded frames that were wanted lately, within a limit of bytes."""

from __future__ import annotations

from collections import OrderedDict
from typing import NamedTuple

import torch


class DecodedFrame(NamedTuple):
    """A picture and the time in its file, in seconds: (C, H, W), uint8 colours or uint16 codes of depth."""

    picture: torch.Tensor
    time_s: float


class FrameCache:
    """Forgets the frames that have not been wanted for the longest time."""

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
