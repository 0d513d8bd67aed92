"""Recorder for any robot or program: a run of episodes, each written while it happens."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from types import TracebackType
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from demorec.core.config import VideoConfig
from demorec.core.errors import ConfigError, RecordingError, describe_error
from demorec.core.files import Closing
from demorec.core.registry import nearest_match
from demorec.episode.episode import Outcome, Sample, SampledFrame
from demorec.episode.info import Camera, EpisodeInfo, Feature, Origin
from demorec.episode.validity import find_problems
from demorec.extensions.recorder.encoder import BackgroundEncoder, WaitingImages, WhenFull
from demorec.extensions.recorder.external_run import ExternalFolder, episode_path, open_external_run
from demorec.extensions.recorder.sampled_writer import SampledFrameCheck, SampledWriter
from demorec.extensions.recorder.vectors import (
    NamedVectors,
    RobotLike,
    Vectors,
    as_declared,
    features_of,
    named_vectors,
    robot_facts,
)
from demorec.mcap.video import size_problem

Image = NDArray[np.uint8] | tuple[NDArray[np.uint8], int]
"""(H, W, 3) uint8 RGB, alone or with its capture timestamp (ns)."""

FRAMES = "frames"
"""Key of frames in the drop counts."""

_REAL_TIME = VideoConfig(preset="ultrafast")


class RecordedEpisode(AbstractContextManager["RecordedEpisode"]):
    """Context manager over one episode, created by `Recorder.episode`.

    An exception that ends the `with` block marks the episode as failed, Ctrl-C does not; all received data is kept. An
    episode without frames leaves no file.

    Attributes:
        success: Whether it succeeded, to be set by the caller; None if unknown.
        drops: "frames" -> number of frames dropped because the encoder could not keep up, if that is allowed.
        num_frames: Number of accepted frames.
        is_open: Whether it accepts more frames.
    """

    def __init__(self, run: Recorder, info: EpisodeInfo) -> None:
        self.success: bool | None = None
        self.drops: dict[str, int] = {}
        self.num_frames = 0
        self.is_open = True
        self._run = run
        self._info = info
        self._check: SampledFrameCheck | None = None
        self._encoder: BackgroundEncoder | None = None

    def __exit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, traceback: TracebackType | None
    ) -> None:
        try:
            if isinstance(exc, Exception):
                self.finish(success=False, reason=describe_error(exc))
            else:
                self.finish(reason="" if exc is None else "interrupted")
        except RecordingError:
            if exc is None:
                raise  # otherwise the first error is reported

    def write(
        self,
        observation: Vectors,
        action: Vectors | None = None,
        images: Mapping[str, Image | None] | None = None,
        *,
        time_ns: int | None = None,
        stamps: Mapping[str, int] | None = None,
    ) -> bool:
        """Add one frame: copied immediately, encoded and written by another thread.

        Args:
            observation: Observation at this time: (D,) numbers; or element -> number; or feature -> numbers.
            action: Action commanded after it: (D,) numbers, or element -> number.
            images: Camera -> (H, W, 3) uint8 RGB, optionally with its own timestamp. A camera that is missing or None
                has no image at this frame. An image with the timestamp of the camera's last one is the same image, and
                is not encoded again.
            time_ns: Timestamp of the frame; by default from the recorder's clock.
            stamps: Feature -> timestamp of its numbers; by default the frame's.

        Returns:
            Whether the frame was accepted; False only if drops are allowed and the encoder cannot keep up.

        Raises:
            RecordingError: The data cannot be recorded, the encoder cannot keep up and drops are not allowed, or the
                disk is full.
        """
        if not self.is_open:
            raise RecordingError("The episode has ended: begin another with recorder.episode().")
        if self._encoder is not None and self._encoder.error is not None:
            raise _as_recording_error(self._encoder.error)
        time_ns = self._run.clock() if time_ns is None else time_ns
        vectors = named_vectors(observation, action)
        if self._check is None:
            self._info = self._run.described(self._info, vectors)
            self._check = SampledFrameCheck(self._info)
        check = self._check
        frame = SampledFrame(time_ns=time_ns, samples=_samples(check, vectors, time_ns, stamps or {}))
        waiting = _waiting(check, images or {}, time_ns)
        new = [(camera, stamp, pixels) for camera, (stamp, pixels) in waiting.items() if pixels is not None]
        check.check_frame(frame)
        for image in new:
            check.check_image(*image)
        if self._encoder is None:
            self._encoder = self._run.open_encoder(self._info)
        if not self._encoder.put(frame, waiting):
            if self._run.when_full == "drop":
                self.drops[FRAMES] = self.drops.get(FRAMES, 0) + 1
                return False
            raise RecordingError(
                f"The encoder cannot keep up ({self._encoder.capacity} frames are waiting): choose faster encoding "
                '(video=VideoConfig(codec="jpeg")), smaller or fewer images, or when_full="drop" or "wait".'
            )
        for camera, stamp_ns, _ in new:
            check.note_image(camera, stamp_ns)
        check.note_frame(frame)
        self.num_frames += 1
        return True

    def finish(self, success: bool | None = None, *, reason: str = "") -> Path | None:
        """End the episode and complete its recording; safe to call twice.

        Args:
            success: Replaces the attribute `success`.
            reason: Reason of a failure, in words.

        Returns:
            The recording; None if there were no frames.

        Raises:
            RecordingError: The disk is full. The data written before is kept, and recovered when the run is opened
                again.
        """
        if success is not None:
            self.success = success
        encoder = self._end()
        if encoder is None:
            return None
        if encoder.error is not None or encoder.writer is None:
            if encoder.writer is not None:
                encoder.writer.close()
            raise _as_recording_error(encoder.error)
        outcome = Outcome(success=self.success, num_frames=self.num_frames, drops=self.drops, failure_reason=reason)
        path = encoder.writer.finish(outcome)
        self._run.add(path)
        return path

    def discard(self) -> None:
        """End the episode and delete its data; safe to call twice, and after `finish`."""
        encoder = self._end()
        if encoder is not None and encoder.writer is not None:
            encoder.writer.discard()

    def _end(self) -> BackgroundEncoder | None:
        """Stop accepting frames; returns the encoder once, and none if there were no frames."""
        self.is_open = False
        encoder, self._encoder = self._encoder, None
        if encoder is not None:
            encoder.end()
        return encoder


def _samples(
    check: SampledFrameCheck, vectors: NamedVectors, time_ns: int, stamps: Mapping[str, int]
) -> dict[str, Sample]:
    features = check.features
    if unknown := [name for name in stamps if name not in features]:
        raise RecordingError(
            f"The stamps name an unknown feature {unknown[0]!r}.{nearest_match(unknown[0], features)} The features "
            f"are: {', '.join(features)}."
        )
    samples = {}
    for name, (vector, names) in vectors.items():
        if name in features:
            vector = as_declared(features[name], vector, names)
        samples[name] = Sample(stamp_ns=stamps.get(name, time_ns), vector=vector)
    return samples


def _waiting(check: SampledFrameCheck, images: Mapping[str, Image | None], time_ns: int) -> WaitingImages:
    """Collect the received images, not yet copied; a repeated one is None."""
    waiting: dict[str, tuple[int, NDArray[np.uint8] | None]] = {}
    for camera, image in images.items():
        if isinstance(image, tuple) and len(image) != 2:
            raise RecordingError(f"The image of the camera {camera!r} is a tuple, it must be (pixels, stamp in ns).")
        pixels, stamp_ns = image if isinstance(image, tuple) else (image, time_ns)
        if pixels is not None:
            is_same = camera in check.image_stamps and check.image_stamps[camera] == stamp_ns
            waiting[camera] = stamp_ns, None if is_same else pixels
    return waiting


class Recorder(Closing):
    """Context manager over a run: a folder of recorded episodes, which is continued if it exists.

    Args:
        folder: Folder of the run; created if missing. Its files are never overwritten.
        robot: Its name, the path or text of its URDF, an arm of demorec's, or the names of its joints. Vectors with one
            element per joint are interpreted as joint positions (rad, m).
        cameras: Name -> (height, width) of its images, or a full description.
        fps: Nominal frames per second of the loop; timestamps record the actual rate.
        task: Task of the robot, in words; LeRobot's task text.
        features: Descriptions of the vectors, if the first frame is not sufficient: names and units of their elements.
        video: Encoding of the images; by default H.264 with the preset "ultrafast", which takes half the CPU time of
            generate-dataset's "veryfast".
        clock: Returns the timestamp of a frame without one, in nanoseconds; must never go backwards.
        when_full: Treatment of a frame when the encoder cannot keep up and the queue is full: "error" raises, "drop"
            omits and counts it, "wait" blocks the program, which suits a simulator.

    Attributes:
        path: Path of the run's folder.
        recovered: Recordings of episodes cut off by a crash, which have now been recovered.
        clock, when_full: The arguments.

    Raises:
        ConfigError: The folder is in use, contains something else or is not writable; or the robot, the cameras or the
            features are invalid.
    """

    def __init__(
        self,
        folder: str | Path,
        *,
        robot: RobotLike,
        cameras: Mapping[str, tuple[int, int] | Camera] | None = None,
        fps: int,
        task: str = "",
        features: Sequence[Feature] = (),
        video: VideoConfig | None = None,
        clock: Callable[[], int] = time.monotonic_ns,
        when_full: WhenFull = "error",
    ) -> None:
        self._robot = robot_facts(robot)
        self._cameras = tuple(_camera(name, camera) for name, camera in (cameras or {}).items())
        self._fps, self._task, self._features = fps, _text(task), tuple(features)
        self._video = video or _REAL_TIME
        self._video.validate()
        self.clock, self.when_full = clock, when_full
        self._check_request()
        self._stack = ExitStack()
        self._open: RecordedEpisode | None = None
        self._folder: ExternalFolder = self._stack.enter_context(open_external_run(Path(folder)))
        self.path = self._folder.path
        self.recovered = tuple(self._folder.recovered)

    def _check_request(self) -> None:
        """Reject errors that no first frame could fix."""
        placeholder = Feature(name="observation.state", names=("0",))
        asked = self._info(self._features or (placeholder,), 0, self._task or "placeholder")
        wrong = find_problems(asked)
        sizes = [size_problem(self._video, camera.width, camera.height) for camera in self._cameras]
        wrong += list(filter(None, sizes))
        if self.when_full not in get_args(WhenFull):
            wrong.append(f"when_full is {self.when_full!r}, choose from {', '.join(get_args(WhenFull))}")
        if wrong:
            raise ConfigError(f"This cannot be recorded: {'; '.join(wrong)}.")

    def close(self) -> None:
        """End the open episode, if any, and the run; safe to call twice."""
        try:
            if self._open is not None:
                self._open.finish()
        finally:
            self._stack.close()

    @property
    def num_episodes(self) -> int:
        """Number of episodes in the run, including those of earlier programs."""
        return len(self._folder.episodes)

    def episode(self, task: str = "") -> RecordedEpisode:
        """Begin an episode; its file is created with the first frame.

        Args:
            task: Task of this episode, replaces the recorder's.

        Raises:
            RecordingError: An episode is already being recorded.
            ConfigError: The task text is missing.
        """
        if self._open is not None and self._open.is_open:
            raise RecordingError("An episode is already being recorded: end it first.")
        instruction = _text(task) or self._task
        if not instruction.strip():
            raise ConfigError("The episode has no task text: give Recorder(task=...) or recorder.episode(task=...).")
        info = self._info(self._features, self._folder.next_index, instruction)
        self._open = RecordedEpisode(self, info)
        return self._open

    # ------------------------------------------------------------------------------- for the episode

    def described(self, info: EpisodeInfo, vectors: NamedVectors) -> EpisodeInfo:
        """Describe an episode by its first frame's vectors; ConfigError if the run has a different kind of episodes."""
        info = replace(info, features=self._features or features_of(vectors, self._robot))
        if wrong := find_problems(info):
            raise ConfigError(f"This cannot be recorded: {'; '.join(wrong)}.")
        self._folder.check_fits(info)
        return info

    def open_encoder(self, info: EpisodeInfo) -> BackgroundEncoder:
        """Begin the file of a described episode."""
        path = episode_path(self.path, info.episode_index)
        return BackgroundEncoder(
            partial(SampledWriter, path, info, video=self._video),
            cameras=info.cameras,
            fps=info.fps,
            waits=self.when_full == "wait",
        )

    def add(self, recording: Path) -> None:
        """Add a finished recording to the run."""
        self._folder.add(recording)

    def _info(self, features: tuple[Feature, ...], episode_index: int, instruction: str) -> EpisodeInfo:
        return EpisodeInfo(
            episode_index=episode_index,
            instruction=instruction,
            robot_name=self._robot.name,
            urdf=self._robot.urdf,
            fps=self._fps,
            features=features,
            cameras=self._cameras,
            origin=Origin(),
            versions={"demorec": version("demorec")},
        )


def _text(task: object) -> str:
    if not isinstance(task, str):
        raise ConfigError(f"The task is {task!r}; describe the robot's task in a text.")
    return task


def _camera(name: str, camera: tuple[int, int] | Camera) -> Camera:
    if isinstance(camera, Camera):
        if camera.name != name or camera.kept:
            raise ConfigError(
                f"The camera {name!r} is described as {camera.name!r}{', passthrough' if camera.kept else ''}: give "
                "pixels, under the camera's own name."
            )
        return camera
    try:
        height, width = camera
        return Camera(name=name, width=int(width), height=int(height))
    except (TypeError, ValueError):
        raise ConfigError(f"The camera {name!r} is {camera!r}; give (height, width) in pixels.") from None


def _as_recording_error(error: BaseException | None) -> RecordingError:
    if isinstance(error, RecordingError):
        return error
    reason = "unknown" if error is None else describe_error(error)
    return RecordingError(f"The episode cannot be recorded any more ({reason}).")
