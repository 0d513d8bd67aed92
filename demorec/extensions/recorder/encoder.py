"""Threads that encode images and write frames, so that the recorded program need not wait.

Libraries that encode images and write files release Python's lock, so threads suffice: one per camera plus one that
writes, without transfers to another process. The queue is bounded: one that grew without limit would hide that the
machine cannot keep up.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from queue import Empty, Full, Queue
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from demorec.episode.episode import SampledFrame
from demorec.episode.info import Camera
from demorec.extensions.recorder.sampled_writer import SampledWriter

WhenFull = Literal["error", "drop", "wait"]

_FLUSH_SECONDS = 0.25
_WAITING_SECONDS = 0.5
"""Time after which queued frames are written, s. With the time for writing, a crash loses less than a second."""
_WAIT_SECONDS = 0.001
_MAX_WAITING_BYTES = 256 << 20
_MIN_WAITING_FRAMES = 8

WaitingImages = Mapping[str, tuple[int, NDArray[np.uint8] | None]]
"""Camera -> timestamp and pixels of a new image, or its timestamp and None for the same one again."""


class BackgroundEncoder:
    """Thread that opens a writer and feeds it from a queue, in which up to half a second of frames may wait.

    With `waits`, `put` waits for room.
    """

    def __init__(
        self, open_writer: Callable[[], SampledWriter], *, cameras: Sequence[Camera], fps: int, waits: bool
    ) -> None:
        self.writer: SampledWriter | None = None  # once it is open; used only by the thread until `end` returns
        self.error: BaseException | None = None  # the one that ended the thread
        self._waits = waits
        frame_bytes = sum(3 * camera.width * camera.height for camera in cameras)
        most = _MAX_WAITING_BYTES // max(frame_bytes, 1)
        self.capacity = max(_MIN_WAITING_FRAMES, min(round(_WAITING_SECONDS * fps), most))
        self._queue: Queue[tuple[SampledFrame, WaitingImages] | None] = Queue(self.capacity)
        # Reused: fresh memory costs as much as copying into it.
        self._buffers = {camera.name: deque[NDArray[np.uint8]]() for camera in cameras}
        self._last: dict[str, int] = {}
        self._pool = ThreadPoolExecutor(max(len(cameras), 1), thread_name_prefix="demorec-camera")
        self._thread = threading.Thread(target=self._run, args=(open_writer,), name="demorec-encoder", daemon=True)
        self._thread.start()

    def put(self, frame: SampledFrame, images: WaitingImages) -> bool:
        """Copy a frame's images and queue both, from one thread; False if the queue is full and `waits` is off."""
        while self._queue.full():
            if not self._waits:
                return False
            if self.error is not None:
                raise self.error
            time.sleep(_WAIT_SECONDS)
        copies = {
            camera: (stamp_ns, None if pixels is None else self._copy(camera, pixels))
            for camera, (stamp_ns, pixels) in images.items()
        }
        self._queue.put_nowait((frame, copies))
        return True

    def _copy(self, camera: str, pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
        buffers = self._buffers[camera]
        buffer = buffers.popleft() if buffers else np.empty_like(pixels)
        np.copyto(buffer, pixels)
        return buffer

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

    def _run(self, open_writer: Callable[[], SampledWriter]) -> None:
        try:
            self.writer = open_writer()
            flushed_at = time.monotonic()
            while True:
                try:
                    waiting = self._queue.get(timeout=max(flushed_at + _FLUSH_SECONDS - time.monotonic(), 0))
                    if waiting is None:
                        return
                    self._write(self.writer, *waiting)
                except Empty:
                    pass
                if time.monotonic() - flushed_at >= _FLUSH_SECONDS:
                    self.writer.flush()
                    flushed_at = time.monotonic()
        except BaseException as error:
            self.error = error

    def _write(self, writer: SampledWriter, frame: SampledFrame, images: WaitingImages) -> None:
        new = [(camera, stamp, pixels) for camera, (stamp, pixels) in images.items() if pixels is not None]
        numbers = self._pool.map(lambda image: writer.image(*image), new)
        for (camera, _, pixels), number in zip(new, numbers, strict=True):
            self._last[camera] = number
            self._buffers[camera].append(pixels)
        writer.write(replace(frame, images={camera: self._last[camera] for camera in images}))
