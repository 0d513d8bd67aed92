"""One episode while it is being recorded."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray

from demorec.errors import RecordingError, in_words
from demorec.recorder.coder import Coder, WaitingFrame, WaitingPictures, WhenFull
from demorec.recorder.vectors import NamedVectors, Vectors, as_declared, named_vectors
from demorec.recording.collected.frame_check import CollectedCheck
from demorec.registry import nearest_match
from demorec.scene.collected import CollectedFeature, CollectedFrame, CollectedInfo, CollectedOutcome, Sample

Image = NDArray[np.uint8] | tuple[NDArray[np.uint8], int]
"""(H, W, 3) uint8 RGB, alone or with the stamp (ns) of when it was taken."""

FRAMES = "frames"
"""Name of frames among the drops."""


class Run(Protocol):
    """The run that an episode belongs to, as far as the episode needs it: a `Recorder`."""

    clock: Callable[[], int]
    when_full: WhenFull

    def describe(self, vectors: NamedVectors, episode_index: int, instruction: str) -> CollectedInfo:
        """What an episode with these vectors is; ConfigError when the run has episodes of another kind."""

    def start_coder(self, info: CollectedInfo) -> Coder:
        """Begin the recording."""

    def add(self, recording: Path) -> Path:
        """Take a finished recording into the run."""

    def forget(self, episode: RecordedEpisode) -> None:
        """The episode has ended."""


class RecordedEpisode:
    """Context manager over one episode; `Recorder.episode` makes it.

    An exception that ends the `with` block marks the episode as failed, Ctrl-C does not; either way all that came is
    kept. An episode without a frame leaves nothing behind.

    Attributes:
        success: Whether it succeeded, for you to set; None when you do not say.
        drops: "frames" -> how many were dropped because the coder could not keep up, where that is allowed.
        num_frames: Frames that were taken.
    """

    def __init__(self, run: Run, episode_index: int, instruction: str) -> None:
        self.success: bool | None = None
        self.drops: dict[str, int] = {}
        self.num_frames = 0
        self._run = run
        self._index, self._instruction = episode_index, instruction
        self._coder: Coder | None = None
        self._features: dict[str, CollectedFeature] = {}
        self._picture_stamps: dict[str, int] = {}
        self._is_open = True

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, traceback: TracebackType | None
    ) -> None:
        try:
            if isinstance(exc, Exception):
                self.finish(success=False, reason=in_words(exc))
            else:
                self.finish(reason="" if exc is None else "interrupted")
        except RecordingError:
            if exc is None:
                raise  # else the first error is the one to be told

    def write(
        self,
        observation: Vectors,
        action: Vectors | None = None,
        images: Mapping[str, Image | None] | None = None,
        *,
        time_ns: int | None = None,
        stamps: Mapping[str, int] | None = None,
    ) -> bool:
        """Take one frame: copied at once, coded and written by another thread.

        Args:
            observation: At this time: (D,) numbers; or element -> number; or feature -> numbers.
            action: What was commanded upon it: (D,) numbers, or element -> number.
            images: Camera -> (H, W, 3) uint8 RGB, or that with its own stamp. A camera that is left out, or None, has
                no picture at this frame. A picture with the stamp of the camera's last one is taken for that one, and
                not coded again.
            time_ns: Stamp of the frame; by the recorder's clock when left out.
            stamps: Feature -> stamp of its numbers; that of the frame where left out.

        Returns:
            Whether the frame was taken; False only where drops are allowed, when the coder cannot keep up.

        Raises:
            RecordingError: What was given cannot be recorded, the coder cannot keep up and drops are not allowed, or
                the disk is full.
        """
        if not self._is_open:
            raise RecordingError("The episode has ended: begin another with recorder.episode().")
        if self._coder is not None and self._coder.error is not None:
            raise _as_recording_error(self._coder.error)
        if time_ns is None:
            time_ns = self._run.clock()
        vectors = named_vectors(observation, action)
        if self._coder is None:
            self._begin(vectors)
        samples = self._samples(vectors, time_ns, stamps or {})
        pictures = self._pictures(images or {}, time_ns)
        return self._queue(WaitingFrame(time_ns=time_ns, samples=samples, pictures=pictures))

    def _begin(self, vectors: NamedVectors) -> None:
        info = self._run.describe(vectors, self._index, self._instruction)
        self._check = CollectedCheck(info)
        self._features = {feature.name: feature for feature in info.features}
        self._coder = self._run.start_coder(info)

    def _samples(
        self,
        vectors: NamedVectors,
        time_ns: int,
        stamps: Mapping[str, int],
    ) -> dict[str, Sample]:
        if unknown := [name for name in stamps if name not in self._features]:
            raise RecordingError(
                f"The stamps name an unknown feature {unknown[0]!r}.{nearest_match(unknown[0], self._features)} The "
                f"features are: {', '.join(self._features)}."
            )
        samples = {}
        for name, (vector, names) in vectors.items():
            if name in self._features:
                vector = as_declared(self._features[name], vector, names)
            samples[name] = Sample(stamp_ns=stamps.get(name, time_ns), vector=vector)
        return samples

    def _pictures(self, images: Mapping[str, Image | None], time_ns: int) -> WaitingPictures:
        """What came of pictures, checked and not yet copied; one that came before is None."""
        pictures: dict[str, tuple[int, NDArray[np.uint8] | None]] = {}
        for camera, image in images.items():
            if isinstance(image, tuple) and len(image) != 2:
                raise RecordingError(
                    f"The picture of the camera {camera!r} is a tuple, it must be (pixels, stamp in ns)."
                )
            pixels, stamp_ns = image if isinstance(image, tuple) else (image, time_ns)
            if pixels is None:
                continue
            if camera in self._picture_stamps and stamp_ns == self._picture_stamps[camera]:
                pictures[camera] = stamp_ns, None
            else:
                pictures[camera] = stamp_ns, pixels
        return pictures

    def _queue(self, frame: WaitingFrame) -> bool:
        assert self._coder is not None
        self._check.check_frame(CollectedFrame(time_ns=frame.time_ns, samples=frame.samples))
        new = {camera: (stamp, pixels) for camera, (stamp, pixels) in frame.pictures.items() if pixels is not None}
        for camera, (stamp_ns, pixels) in new.items():
            self._check.check_picture(camera, stamp_ns, pixels)
        if not self._coder.put(frame):
            if self._run.when_full == "drop":
                self.drops[FRAMES] = self.drops.get(FRAMES, 0) + 1
                return False
            raise RecordingError(
                f"The coder cannot keep up, {self._coder.capacity} frames wait for it: give quicker coding "
                '(video=VideoConfig(codec="jpeg")), smaller or fewer pictures, or when_full="drop" or "wait".'
            )
        for camera, (stamp_ns, _) in new.items():
            self._check.note_picture(camera, stamp_ns)
            self._picture_stamps[camera] = stamp_ns
        self._check.note_frame(CollectedFrame(time_ns=frame.time_ns, samples=frame.samples))
        self.num_frames += 1
        return True

    def finish(self, success: bool | None = None, *, reason: str = "") -> Path | None:
        """End the episode and make its recording whole; harmless when called twice.

        Args:
            success: In place of the attribute of that name.
            reason: Why it is no success, in words.

        Returns:
            The recording; None when there was not one frame.

        Raises:
            RecordingError: The disk is full. What was written so far stays, and is recovered when the run is opened
                again.
        """
        if success is not None:
            self.success = success
        coder = self._end()
        if coder is None:
            return None
        if coder.error is not None:
            coder.close()
            raise _as_recording_error(coder.error)
        outcome = CollectedOutcome(success=self.success, num_frames=self.num_frames, drops=self.drops, reason=reason)
        return self._run.add(coder.finish(outcome).path)

    def discard(self) -> None:
        """End the episode and keep nothing of it; harmless when called twice, and after `finish`."""
        coder = self._end()
        if coder is not None:
            coder.discard()

    def _end(self) -> Coder | None:
        """Take no more frames; the coder, with all that came, if there was anything and nobody else has ended it."""
        coder, self._coder = self._coder, None
        self._is_open = False
        self._run.forget(self)
        if coder is not None:
            coder.end()
        return coder


def _as_recording_error(error: BaseException) -> RecordingError:
    if isinstance(error, RecordingError):
        return error
    return RecordingError(f"The episode cannot be recorded any more ({in_words(error)}).")
