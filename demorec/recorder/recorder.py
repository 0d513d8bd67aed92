"""The recorder of somebody's own robot or program: a run of episodes, each written while it happens."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from importlib.metadata import version
from pathlib import Path
from typing import get_args

from demorec.closing import Closing
from demorec.config import VideoConfig
from demorec.errors import ConfigError, RecordingError
from demorec.recorder.coder import Buffers, Coder, WhenFull
from demorec.recorder.episode import RecordedEpisode
from demorec.recorder.robot import RobotLike, robot_facts
from demorec.recorder.vectors import NamedVectors, features_of
from demorec.recording import CollectedWriter
from demorec.recording.collected.validity import what_is_wrong
from demorec.runs.collected import CollectedFolder, open_collected_run
from demorec.scene.collected import CollectedCamera, CollectedFeature, CollectedInfo

_REAL_TIME = VideoConfig(preset="ultrafast")


class Recorder(Closing):
    """Context manager over a run: a folder of recorded episodes, which goes on where it ended.

    Args:
        folder: Of the run; made if it is not there. Nothing that is in it is ever written over.
        robot: Its name, the path or text of its URDF, an arm of demorec's, or the names of its joints. Vectors as long
            as there are joints are taken for their positions (rad, m).
        cameras: Name -> (height, width) of its pictures, or all that is known of it.
        fps: Nominal frames per second of the loop; the frames' own stamps say what they were.
        task: What the robot is asked to do, in words; LeRobot's task text.
        features: Of the vectors, where the first frame does not say enough: names and units of their elements.
        video: How pictures are coded; H.264 with the preset "ultrafast" where left out, which takes half the CPU time
            of generate-dataset's "veryfast".
        clock: Tells the stamp of a frame that comes without one, in nanoseconds; it must never go backwards.
        when_full: What happens to a frame when the coder cannot keep up and no more frames may wait: "error" raises,
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
        cameras: Mapping[str, tuple[int, int] | CollectedCamera] | None = None,
        fps: int,
        task: str = "",
        features: Sequence[CollectedFeature] = (),
        video: VideoConfig | None = None,
        clock: Callable[[], int] = time.monotonic_ns,
        when_full: WhenFull = "error",
    ) -> None:
        self._robot = robot_facts(robot)
        self._cameras = tuple(_camera(name, camera) for name, camera in (cameras or {}).items())
        self._fps, self._task, self._features = fps, task, tuple(features)
        self._video = video or _REAL_TIME
        self._video.validate()
        self.clock, self.when_full = clock, when_full
        self._check_request()
        self._buffers = Buffers(self._cameras)
        self._stack = ExitStack()
        self._open: RecordedEpisode | None = None
        self._folder: CollectedFolder = self._stack.enter_context(open_collected_run(Path(folder)))
        self.path = self._folder.path
        self.recovered = tuple(self._folder.recovered)

    def _check_request(self) -> None:
        """Refuse at once what no first frame could make good."""
        placeholder = CollectedFeature(name="observation.state", names=("0",))
        asked = self._info(self._features or (placeholder,), 0, self._task or "placeholder")
        wrong = what_is_wrong(asked)
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
        """Begin an episode.

        Args:
            task: Of this episode, in place of the recorder's.

        Raises:
            RecordingError: One is being recorded already.
            ConfigError: There is no task text.
        """
        if self._open is not None:
            raise RecordingError(
                "An episode is being recorded already: end it first, one robot does one thing at a time."
            )
        instruction = task or self._task
        if not instruction.strip():
            raise ConfigError("The episode has no task text: give Recorder(task=...) or recorder.episode(task=...).")
        self._open = RecordedEpisode(self, self._folder.next_index, instruction)
        return self._open

    # ------------------------------------------------------------------------------- for the episode

    def describe(self, vectors: NamedVectors, episode_index: int, instruction: str) -> CollectedInfo:
        """What an episode with these vectors is; ConfigError when the run has episodes of another kind."""
        info = self._info(self._features or features_of(vectors, self._robot), episode_index, instruction)
        if wrong := what_is_wrong(info):
            raise ConfigError(f"This cannot be recorded: {'; '.join(wrong)}.")
        self._folder.check_fits(info)
        return info

    def start_coder(self, info: CollectedInfo) -> Coder:
        """Begin the recording."""
        writer = CollectedWriter(self._folder.path_of(info.episode_index), info, video=self._video)
        return Coder(writer, self._buffers, cameras=info.cameras, fps=info.fps, waits=self.when_full == "wait")

    def add(self, recording: Path) -> Path:
        """Take a finished recording into the run."""
        self._folder.add(recording)
        return recording

    def forget(self, episode: RecordedEpisode) -> None:
        """The episode has ended."""
        if self._open is episode:
            self._open = None

    def _info(self, features: tuple[CollectedFeature, ...], episode_index: int, instruction: str) -> CollectedInfo:
        return CollectedInfo(
            episode_index=episode_index,
            instruction=instruction,
            robot=self._robot.name,
            urdf=self._robot.urdf,
            fps=self._fps,
            features=features,
            cameras=self._cameras,
            versions={"demorec": version("demorec")},
        )


def _camera(name: str, camera: tuple[int, int] | CollectedCamera) -> CollectedCamera:
    if isinstance(camera, CollectedCamera):
        if camera.name != name or camera.kept:
            raise ConfigError(
                f"The camera {name!r} is described as {camera.name!r}{' of kept packets' if camera.kept else ''}: a "
                "recorder takes pixels, under the camera's own name."
            )
        return camera
    try:
        height, width = camera
        return CollectedCamera(name=name, width=int(width), height=int(height))
    except (TypeError, ValueError):
        raise ConfigError(f"The camera {name!r} is {camera!r}, it must be (height, width) in pixels.") from None
