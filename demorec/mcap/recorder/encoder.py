"""Threads that encode images and write frames, so that the recorded program need not wait.

Libraries that encode images and write files release Python's lock, so threads suffice: one per camera plus one that
writes, without transfers to another process. The queue is bounded: one that grew without limit would hide that the
machine cannot keep up.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from queue import Empty, Full, Queue
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from demorec.episode.episode import SampledFrame
from demorec.episode.info import Camera, EpisodeInfo
from demorec.mcap import SampledWriter

WhenFull = Literal["error", "drop", "wait"]

_FLUSH_SECONDS = 0.25
_WAITING_SECONDS = 0.5
"""Time after which queued frames are written, s. With the time for writing, a crash loses less than a second."""
_WAIT_SECONDS = 0.001
_MAX_WAITING_BYTES = 256 << 20
_MIN_WAITING_FRAMES = 8

WaitingImages = Mapping[str, tuple[int, NDArray[np.uint8] | None]]
"""Camera -> timestamp and pixels of a new image, or its timestamp and None for the same one again."""


class Buffers:
    """Reused memory for queued images: fresh memory costs as much as copying into it."""

    def __init__(self, cameras: Sequence[Camera]) -> None:
        self._free: dict[tuple[int, ...], deque[NDArray[np.uint8]]] = {
            (camera.height, camera.width, 3): deque() for camera in cameras
        }

    def copy(self, pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Copy pixels into a buffer reserved until `give_back`."""
        free = self._free[pixels.shape]
        try:
            buffer = free.popleft()
        except IndexError:
            buffer = np.empty(pixels.shape, dtype=np.uint8)
        np.copyto(buffer, pixels)
        return buffer

    def give_back(self, buffer: NDArray[np.uint8]) -> None:
        """Release the memory of a copy."""
        self._free[buffer.shape].append(buffer)


class BackgroundEncoder:
    """Thread that feeds a writer from a queue.

    Args:
        buffers: Pool that images are returned to.
        cameras: Cameras of the episode; they determine the capacity.
        fps: Nominal frames per second: up to half a second of frames may wait, if memory allows.
        waits: Whether `put` waits for room.

    Attributes:
        writer: Writer of the episode; used only by the thread until `end` returns.
        info: Description of the episode, to be set before the first frame is put.
        error: Error that ended the thread, if any.
        capacity: Maximum number of waiting frames.
    """

    def __init__(
        self,
        writer: SampledWriter,
        buffers: Buffers,
        *,
        cameras: Sequence[Camera],
        fps: int,
        waits: bool = False,
    ) -> None:
        self.writer, self._buffers, self._waits = writer, buffers, waits
        self.info: EpisodeInfo | None = None
        self.error: BaseException | None = None
        frame_bytes = sum(3 * camera.width * camera.height for camera in cameras)
        most = _MAX_WAITING_BYTES // max(frame_bytes, 1)
        self.capacity = max(_MIN_WAITING_FRAMES, min(round(_WAITING_SECONDS * fps), most))
        self._queue: Queue[tuple[SampledFrame, WaitingImages] | None] = Queue(self.capacity)
        self._last: dict[str, int] = {}
        self._flushed_at = time.monotonic()
        self._pool = ThreadPoolExecutor(max(len(cameras), 1), thread_name_prefix="demorec-camera")
        self._thread = threading.Thread(target=self._run, name="demorec-encoder", daemon=True)
        self._thread.start()

    def put(self, frame: SampledFrame, images: WaitingImages) -> bool:
        """Copy a frame's images and queue both; False if the queue is full and `waits` is off.

        Only one thread may put frames.
        """
        while self._queue.full():
            if not self._waits:
                return False
            if self.error is not None:
                raise self.error
            time.sleep(_WAIT_SECONDS)
        copies = {
            camera: (stamp_ns, None if pixels is None else self._buffers.copy(pixels))
            for camera, (stamp_ns, pixels) in images.items()
        }
        self._queue.put_nowait((frame, copies))
        return True

    def end(self) -> None:
        """Wait until everything queued is with the writer, or the thread has died; safe to call twice."""
        while self._thread.is_alive():
            try:
                self._queue.put(None, timeout=0.1)
                break
            except Full:
                continue
        self._thread.join()
        self._pool.shutdown()

    def _run(self) -> None:
        try:
            while True:
                wait = self._flushed_at + _FLUSH_SECONDS - time.monotonic()
                try:
                    waiting = self._queue.get(timeout=wait) if wait > 0 else self._queue.get_nowait()
                except Empty:
                    self._flush()
                    continue
                if waiting is None:
                    return
                self._write(*waiting)
                if time.monotonic() - self._flushed_at >= _FLUSH_SECONDS:
                    self._flush()
        except BaseException as error:
            self.error = error

    def _flush(self) -> None:
        self.writer.flush()
        self._flushed_at = time.monotonic()

    def _write(self, frame: SampledFrame, images: WaitingImages) -> None:
        if self.info is not None:
            self.writer.begin(self.info)
            self.info = None
        new = [(camera, stamp, pixels) for camera, (stamp, pixels) in images.items() if pixels is not None]
        numbers = list(self._pool.map(lambda image: self.writer.image(*image), new))
        for (camera, _, pixels), number in zip(new, numbers, strict=True):
            self._last[camera] = number
            self._buffers.give_back(pixels)
        held = {camera: self._last[camera] for camera in images}
        self.writer.write(replace(frame, images=held))
