"""The recorder of somebody's own robot or program: a run of episodes, each written while it happens."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from types import TracebackType
from typing import Self, get_args

import numpy as np
from numpy.typing import NDArray

from demorec.core.config import VideoConfig
from demorec.core.errors import ConfigError, RecordingError, describe_error
from demorec.core.files import Closing
from demorec.core.registry import nearest_match
from demorec.episode.episode import Outcome, Sample, SampledFrame
from demorec.episode.info import Camera, EpisodeInfo, Feature, Origin
from demorec.episode.validity import find_problems
from demorec.mcap import SampledWriter
from demorec.mcap.recorder.encoder import BackgroundEncoder, Buffers, WaitingImages, WhenFull
from demorec.mcap.recorder.vectors import (
    NamedVectors,
    RobotLike,
    Vectors,
    as_declared,
    features_of,
    named_vectors,
    robot_facts,
)
from demorec.mcap.sampled_writer import SampledFrameCheck
from demorec.mcap.video import size_problem
from demorec.runs.external import ExternalFolder, episode_path, open_external_run

Image = NDArray[np.uint8] | tuple[NDArray[np.uint8], int]
"""(H, W, 3) uint8 RGB, alone or with the stamp (ns) of when it was taken."""

FRAMES = "frames"
"""Name of frames among the drops."""

_REAL_TIME = VideoConfig(preset="ultrafast")


class RecordedEpisode:
    """Context manager over one episode; `Recorder.episode` makes it.

    An exception that ends the `with` block marks the episode as failed, Ctrl-C does not; either way all that came is
    kept. An episode without a frame leaves nothing behind.

    Attributes:
        success: Whether it succeeded, for you to set; None when you do not say.
        drops: "frames" -> how many were dropped because the encoder could not keep up, where that is allowed.
        num_frames: Frames that were taken.
    """

    def __init__(self, run: Recorder, info: EpisodeInfo, encoder: BackgroundEncoder) -> None:
        self.success: bool | None = None
        self.drops: dict[str, int] = {}
        self.num_frames = 0
        self._run = run
        self._info = info
        self._encoder: BackgroundEncoder | None = encoder
        self._check: SampledFrameCheck | None = None

    @property
    def is_open(self) -> bool:
        """Whether it takes more frames."""
        return self._encoder is not None

    def __enter__(self) -> Self:
        return self

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
                raise  # else the first error is the one to be reported

    def write(
        self,
        observation: Vectors,
        action: Vectors | None = None,
        images: Mapping[str, Image | None] | None = None,
        *,
        time_ns: int | None = None,
        stamps: Mapping[str, int] | None = None,
    ) -> bool:
        """Take one frame: copied at once, encoded and written by another thread.

        Args:
            observation: At this time: (D,) numbers; or element -> number; or feature -> numbers.
            action: What was commanded upon it: (D,) numbers, or element -> number.
            images: Camera -> (H, W, 3) uint8 RGB, or that with its own stamp. A camera that is left out, or None, has
                no image at this frame. An image with the stamp of the camera's last one is taken for that one, and
                not encoded again.
            time_ns: Stamp of the frame; by the recorder's clock when left out.
            stamps: Feature -> stamp of its numbers; that of the frame where left out.

        Returns:
            Whether the frame was taken; False only where drops are allowed, when the encoder cannot keep up.

        Raises:
            RecordingError: What was given cannot be recorded, the encoder cannot keep up and drops are not allowed, or
                the disk is full.
        """
        if self._encoder is None:
            raise RecordingError("The episode has ended: begin another with recorder.episode().")
        if self._encoder.error is not None:
            raise _as_recording_error(self._encoder.error)
        time_ns = self._run.clock() if time_ns is None else time_ns
        vectors = named_vectors(observation, action)
        if self._check is None:
            self._encoder.info = self._run.described(self._info, vectors)
            self._check = SampledFrameCheck(self._encoder.info)
        check = self._check
        frame = SampledFrame(time_ns=time_ns, samples=_samples(check, vectors, time_ns, stamps or {}))
        waiting = _waiting(check, images or {}, time_ns)
        new = {camera: (stamp, pixels) for camera, (stamp, pixels) in waiting.items() if pixels is not None}
        check.check_frame(frame)
        for camera, (stamp_ns, pixels) in new.items():
            check.check_image(camera, stamp_ns, pixels)
        if not self._encoder.put(frame, waiting):
            if self._run.when_full == "drop":
                self.drops[FRAMES] = self.drops.get(FRAMES, 0) + 1
                return False
            raise RecordingError(
                f"The encoder cannot keep up, {self._encoder.capacity} frames wait for it: choose quicker encoding "
                '(video=VideoConfig(codec="jpeg")), smaller or fewer images, or when_full="drop" or "wait".'
            )
        for camera, (stamp_ns, _) in new.items():
            check.note_image(camera, stamp_ns)
        check.note_frame(frame)
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
        encoder = self._end()
        if encoder is None:
            return None
        if self.num_frames == 0:
            encoder.writer.discard()
            return None
        if encoder.error is not None:
            encoder.writer.close()
            raise _as_recording_error(encoder.error)
        outcome = Outcome(success=self.success, num_frames=self.num_frames, drops=self.drops, failure_reason=reason)
        path = encoder.writer.finish(outcome)
        self._run.add(path)
        return path

    def discard(self) -> None:
        """End the episode and keep nothing of it; harmless when called twice, and after `finish`."""
        encoder = self._end()
        if encoder is not None:
            encoder.writer.discard()

    def _end(self) -> BackgroundEncoder | None:
        """Take no more frames; the encoder, with all that came, if nobody else has ended it."""
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
    """The images that came, not yet copied; one that came before is None."""
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
    """Context manager over a run: a folder of recorded episodes, which goes on where it ended.

    Args:
        folder: Of the run; made if it is not there. Nothing that is in it is ever written over.
        robot: Its name, the path or text of its URDF, an arm of demorec's, or the names of its joints. Vectors as long
            as there are joints are taken for their positions (rad, m).
        cameras: Name -> (height, width) of its images, or all that is known of it.
        fps: Nominal frames per second of the loop; the frames' own stamps say what they were.
        task: What the robot is asked to do, in words; LeRobot's task text.
        features: Of the vectors, where the first frame does not say enough: names and units of their elements.
        video: How images are encoded; H.264 with the preset "ultrafast" where left out, which takes half the CPU time
            of generate-dataset's "veryfast".
        clock: Tells the stamp of a frame that comes without one, in nanoseconds; it must never go backwards.
        when_full: What happens to a frame when the encoder cannot keep up and no more frames may wait: "error" raises,
            "drop" leaves it out and counts it, "wait" holds up your program, which suits a simulator.

    Attributes:
        path: Of the run's folder.
        recovered: Recordings of episodes that a crash had cut off and that were made whole now.
        clock, when_full: As above.

    Raises:
        ConfigError: The folder is in use, holds something else or cannot be written to; or the robot, the cameras or
            the features cannot be.
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
        self._buffers = Buffers(self._cameras)
        self._stack = ExitStack()
        self._open: RecordedEpisode | None = None
        self._folder: ExternalFolder = self._stack.enter_context(open_external_run(Path(folder)))
        self.path = self._folder.path
        self.recovered = tuple(self._folder.recovered)

    def _check_request(self) -> None:
        """Refuse at once what no first frame could make good."""
        placeholder = Feature(name="observation.state", names=("0",))
        asked = self._info(self._features or (placeholder,), 0, self._task or "placeholder")
        wrong = find_problems(asked)
        sizes = [size_problem(self._video, camera.width, camera.height) for camera in self._cameras]
        wrong += list(filter(None, sizes))
        if self.when_full not in get_args(WhenFull):
            wrong.append(f"when_full is {self.when_full!r}, allowed are {', '.join(get_args(WhenFull))}")
        if wrong:
            raise ConfigError(f"This cannot be recorded: {'; '.join(wrong)}.")

    def close(self) -> None:
        """End the open episode, if there is one, and the run; harmless when called twice."""
        try:
            if self._open is not None:
                self._open.finish()
        finally:
            self._stack.close()

    @property
    def num_episodes(self) -> int:
        """How many the run has, those of earlier programs included."""
        return len(self._folder.episodes)

    def episode(self, task: str = "") -> RecordedEpisode:
        """Begin an episode: its file and its encoders are opened now, so that no frame waits for that.

        Args:
            task: Of this episode, in place of the recorder's.

        Raises:
            RecordingError: One is being recorded already, or the disk is full.
            ConfigError: There is no task text.
        """
        if self._open is not None and self._open.is_open:
            raise RecordingError(
                "An episode is being recorded already: end it first, one robot does one thing at a time."
            )
        instruction = _text(task) or self._task
        if not instruction.strip():
            raise ConfigError("The episode has no task text: give Recorder(task=...) or recorder.episode(task=...).")
        info = self._info(self._features, self._folder.next_index, instruction)
        path = episode_path(self.path, info.episode_index)
        writer = SampledWriter(path, info, video=self._video, begins=False)
        encoder = BackgroundEncoder(
            writer, self._buffers, cameras=info.cameras, fps=info.fps, waits=self.when_full == "wait"
        )
        self._open = RecordedEpisode(self, info, encoder)
        return self._open

    # ------------------------------------------------------------------------------- for the episode

    def described(self, info: EpisodeInfo, vectors: NamedVectors) -> EpisodeInfo:
        """An episode whose first frame has these vectors; ConfigError when the run has episodes of another kind."""
        info = replace(info, features=self._features or features_of(vectors, self._robot))
        if wrong := find_problems(info):
            raise ConfigError(f"This cannot be recorded: {'; '.join(wrong)}.")
        self._folder.check_fits(info)
        return info

    def add(self, recording: Path) -> None:
        """Take a finished recording into the run."""
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
        raise ConfigError(f"The task is {task!r}, it must be a text: say what the robot is asked to do.")
    return task


def _camera(name: str, camera: tuple[int, int] | Camera) -> Camera:
    if isinstance(camera, Camera):
        if camera.name != name or camera.kept:
            raise ConfigError(
                f"The camera {name!r} is described as {camera.name!r}{', passthrough' if camera.kept else ''}: a "
                "recorder takes pixels, under the camera's own name."
            )
        return camera
    try:
        height, width = camera
        return Camera(name=name, width=int(width), height=int(height))
    except (TypeError, ValueError):
        raise ConfigError(f"The camera {name!r} is {camera!r}, it must be (height, width) in pixels.") from None


def _as_recording_error(error: BaseException) -> RecordingError:
    if isinstance(error, RecordingError):
        return error
    return RecordingError(f"The episode cannot be recorded any more ({describe_error(error)}).")
