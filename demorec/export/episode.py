"""An episode as every exporter writes it: which frames, which numbers, which images, whoever recorded it.

`exported(recording, options)` gives one; the formats ask it and never what kind of recording it comes from.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from demorec.errors import ConfigError, ExportError
from demorec.export.options import CommonOptions
from demorec.plain import digest, to_json
from demorec.recording import AnyRecording, CollectedRecording, Recording, channels
from demorec.registry import nearest_match
from demorec.scene.collected import NO_PICTURE
from demorec.scene.episode import EpisodeColumns, interventions
from demorec.scene.features import (
    ACTION,
    COMMAND,
    DEPTH_SUFFIX,
    ENVIRONMENT_STATE,
    IMAGE_PREFIX,
    SENSED,
    STATE,
    ObservationRows,
    StateKind,
    action_names,
    action_vectors,
    command_vectors,
    observation_names,
    observation_vectors,
)

REWARD, DONE, SUCCESS = "next.reward", "next.done", "next.success"
INTERVENTION = "intervention"
"""As LeRobot's DAgger calls it: whether the expert acts in an episode that a policy began."""
SCALARS: Mapping[str, Literal["float32", "bool"]] = {
    INTERVENTION: "bool",
    REWARD: "float32",
    DONE: "bool",
    SUCCESS: "bool",
}
"""Features of one number a frame, and their type."""
_SECOND_NS = 1_000_000_000


@dataclass(frozen=True, kw_only=True)
class ExportCamera:
    """A stream of images of the dataset.

    Attributes:
        name: Of the camera in the recording.
        feature: What the dataset calls it.
        is_depth: Whether its images are distances.
    """

    name: str
    feature: str
    is_depth: bool = False


class Simulated:
    """What only an episode has that demorec simulated: its recording with all that is known of it, and its numbers.

    Args:
        recording: Open.
    """

    def __init__(self, recording: Recording) -> None:
        self.recording = recording

    @cached_property
    def columns(self) -> EpisodeColumns:
        """All numbers, every frame; RecordingError for damage."""
        return self.recording.columns()


class ExportEpisode(ABC):
    """What a dataset has of one recording, with these options.

    Args:
        recording: Open.
        options: Of the export.

    Attributes:
        simulated: What only a simulated episode has; None for an external one.
        fps: Of the dataset.
        names: Vector feature -> names of its D elements, all that recording and options offer.
        scalars: Of `SCALARS`, all that they offer.
        cameras: Those that the dataset shall have, in its order.

    Raises:
        ConfigError: Options that the recording cannot serve.
    """

    simulated: Simulated | None
    fps: int
    names: Mapping[str, tuple[str, ...]]
    scalars: tuple[str, ...]
    cameras: tuple[ExportCamera, ...]

    def __init__(self, recording: AnyRecording, options: CommonOptions) -> None:
        self.recording = recording
        self.options = options

    def _settle(
        self, names: Mapping[str, tuple[str, ...]], scalars: tuple[str, ...], cameras: Collection[ExportCamera]
    ) -> None:
        """Take what is offered, and of the cameras those that are wanted."""
        check_feature_names(self.options, [*names, *(camera.feature for camera in cameras), *scalars])
        self.names, self.scalars = names, scalars
        self.cameras = tuple(camera for camera in cameras if self.options.takes(camera.feature))

    @property
    def depth_left_out(self) -> tuple[str, ...]:
        """Depth cameras that were not asked for."""
        return ()

    @property
    def is_silent(self) -> bool:
        """Whether there is nothing that language could be made of."""
        return self.simulated is None and not self.subtasks

    @property
    def subtasks(self) -> tuple[tuple[int, str], ...]:
        """(frame, what is begun there) as an external source states it."""
        return ()

    @property
    @abstractmethod
    def origin(self) -> str:
        """Where the episode comes from: "" for a generated one, "replay of DIGEST", or JSON of imported files."""

    @property
    @abstractmethod
    def urdf(self) -> str:
        """The robot's URDF as text, "" where it is not known."""

    @property
    @abstractmethod
    def joints(self) -> Mapping[str, tuple[str, ...]]:
        """Feature -> for each element the joint of the URDF of which it is the position, "" for none."""

    @property
    @abstractmethod
    def units(self) -> Mapping[str, tuple[str, ...]]:
        """Feature of `joints` -> units of its elements, where they are known."""

    @abstractmethod
    def described_cameras(self) -> list[dict[str, Any]]:
        """What is known of each camera of the recording: name, width, height, intrinsics (K, row by row), mount,
        mount_from_camera and world_from_camera_start (position, quaternion xyzw); None for what is not."""

    @abstractmethod
    def traits(self) -> Iterator[tuple[str, str]]:
        """What all recordings of a dataset must have in common, as (what, value) in words."""

    def _camera_traits(self) -> Iterator[tuple[str, str]]:
        yield "cameras", " ".join(camera.feature.removeprefix(IMAGE_PREFIX) for camera in self.cameras) or "none"
        for name in dict.fromkeys(camera.name for camera in self.cameras):
            settings = self.recording.video_settings(name)
            yield f"size of camera {name}", f"{settings.width}x{settings.height}"
            yield f"codec of camera {name}", settings.codec

    @cached_property
    def rows(self) -> NDArray[np.intp]:
        """(T,) which frames of the recording the dataset has; ExportError where there are none."""
        if self.recording.num_frames == 0:
            raise ExportError(f"The recording has no frames: {self.recording.path}")
        return np.arange(0, self.recording.num_frames, self.recording.info.fps // self.fps)

    @cached_property
    def vectors(self) -> Mapping[str, NDArray[np.floating[Any]]]:
        """Feature of `names` that the dataset shall have -> (T, D), as precise as the recording has it.

        Raises:
            ExportError: The recording has no frames, or a number that is not finite.
            RecordingError: It is damaged.
        """
        vectors = {name: values for name, values in self._vectors().items() if self.options.takes(name)}
        for name, values in vectors.items():
            self._check_finite(name, values)
        return vectors

    @cached_property
    def singles(self) -> Mapping[str, NDArray[np.generic]]:
        """The same as float32, and (T,) of the scalars; ExportError for a number that float32 does not hold, too."""
        found: dict[str, NDArray[np.generic]] = {}
        for name, values in self.vectors.items():
            with np.errstate(over="ignore"):
                found[name] = single = values.astype(np.float32)
            self._check_finite(name, single)
        return found | {name: values for name, values in self.scalar_columns.items() if self.options.takes(name)}

    def _check_finite(self, name: str, values: NDArray[np.floating[Any]]) -> None:
        if len(wrong := np.flatnonzero(~np.isfinite(values).all(axis=1))):
            why = "too large for float32" if values.dtype == np.float32 else "not finite"
            raise ExportError(
                f"The feature {name} is {why} in frame {int(self.rows[wrong[0]])}, leave the recording out: "
                f"{self.recording.path}"
            )

    @abstractmethod
    def _vectors(self) -> Mapping[str, NDArray[np.floating[Any]]]:
        """Feature -> (T, D)."""

    @property
    @abstractmethod
    def scalar_columns(self) -> Mapping[str, NDArray[np.generic]]:
        """Feature of `scalars` -> (T,)."""

    @abstractmethod
    def numbers(self, camera: ExportCamera) -> NDArray[np.int64]:
        """(T,) which image of the camera each frame shows, of those that `recording.packets` gives.

        Raises:
            ConfigError: The recording has no such images.
            ExportError: A frame has none.
        """

    def images(self, camera: ExportCamera) -> Iterator[NDArray[Any]]:
        """What the frames show, one a frame: (H, W, 3) uint8 RGB, of a depth camera (H, W) float32 metres.

        Raises:
            ExportError: They show images in another order than that of the camera; and as `numbers`.
        """
        wanted = self.numbers(camera)
        if (np.diff(wanted) < 0).any():
            raise ExportError(
                f"The images of the camera {camera.name} are not in the order of the frames: {self.recording.path}"
            )
        recording = self.recording
        found: Iterator[NDArray[Any]] = (
            recording.depth(camera.name) if camera.is_depth else recording.images(camera.name)
        )
        images = enumerate(found)
        number, image = next(images)
        for due in wanted.tolist():
            while number < due:
                number, image = next(images)
            yield image


class _Simulated(ExportEpisode):
    """Of a recording of demorec's own simulation."""

    simulated: Simulated

    def __init__(self, recording: Recording, options: CommonOptions) -> None:
        super().__init__(recording, options)
        self.simulated = Simulated(recording)
        info = recording.info
        self.fps = info.fps // frame_stride(info.fps, options.fps)
        self._state: StateKind = getattr(options, "state", "joint")
        # Recordings of format version 1 have no wrench.
        self._sensed = [name for name in SENSED if name in options.features and self._has(name)]
        names = observation_names(
            info.robot, info.scene, privileged=options.privileged, state=self._state, sensed=self._sensed
        )
        if COMMAND in options.features:
            names[COMMAND] = action_names(info.robot, "joint")
        cameras = []
        for name in recording.cameras:
            cameras.append(ExportCamera(name=name, feature=IMAGE_PREFIX + name))
            if options.depth:
                cameras.append(ExportCamera(name=name, feature=IMAGE_PREFIX + name + DEPTH_SUFFIX, is_depth=True))
        scalars = (*((INTERVENTION,) if getattr(options, "intervention", False) else ()), REWARD, DONE, SUCCESS)
        self._settle({**names, ACTION: action_names(info.robot, options.action)}, scalars, cameras)

    def _has(self, name: str) -> bool:
        return name != "observation.wrench" or channels.WRENCH in self.simulated.recording.topics

    @property
    def origin(self) -> str:
        """Of a derived episode."""
        return self.simulated.recording.info.origin

    @property
    def urdf(self) -> str:
        """As the recording describes the arm."""
        recording = self.simulated.recording
        return recording.description() if channels.description_topic() in recording.topics else ""

    @property
    def joints(self) -> Mapping[str, tuple[str, ...]]:
        """Of observation.state."""
        arm = self.simulated.recording.info.robot.arm_joints
        return {STATE: (*arm, *("" for _ in self.names[STATE][len(arm) :]))}

    @property
    def units(self) -> Mapping[str, tuple[str, ...]]:
        """Of observation.state."""
        pose = ("m",) * 3 + ("",) * 4 if self._state == "joint_ee" else ()
        return {STATE: (*("rad" for _ in self.simulated.recording.info.robot.arm_joints), "m", *pose)}

    def described_cameras(self) -> list[dict[str, Any]]:
        """All of it, of the scene's cameras."""
        return [
            {
                "name": camera.name,
                "width": camera.width,
                "height": camera.height,
                "intrinsics": camera.intrinsics.reshape(-1).tolist(),
                "mount": camera.mount,
                "mount_from_camera": camera.mount_from_camera.vector().tolist(),
                "world_from_camera_start": self.simulated.columns.world_from_camera[camera.name][0].tolist(),
            }
            for camera in self.simulated.recording.info.scene.cameras
        ]

    def traits(self) -> Iterator[tuple[str, str]]:
        """Of robot, cameras and, where it is exported, of what is in the scene."""
        info = self.simulated.recording.info
        yield "kind of episode", "simulated"
        yield "fps", str(info.fps)
        # A scaled arm (the tutorial's) has the same joints and limits; its lengths stay with each episode's sidecar.
        yield "robot", f"{info.robot.name} ({digest(info.robot.scaled(0.0))})"
        yield from self._camera_traits()
        if self.options.privileged and self.options.takes(ENVIRONMENT_STATE):
            names = self.names[ENVIRONMENT_STATE]
            yield "objects and goals", " ".join(dict.fromkeys(name.partition(".")[0] for name in names))
            yield "components of the environment state", f"{len(names)} ({digest(list(names))})"

    def numbers(self, camera: ExportCamera) -> NDArray[np.int64]:
        """Its frames themselves; ConfigError for depth that was not recorded."""
        if camera.is_depth and not self.simulated.recording.has_depth(camera.name):
            raise ConfigError(
                f"--depth needs recordings with depth images (generate --depth), and the camera {camera.name!r} has "
                f"none: leave it out: {self.recording.path}"
            )
        return self.rows.astype(np.int64)

    def _vectors(self) -> Mapping[str, NDArray[np.floating[Any]]]:
        """With frames left out, an observation is that of the first frame of its group and an action the last one of
        it: where the robot shall be when the next observation is taken.
        """
        info, rows = self.simulated.recording.info, self.rows
        action_rows = np.minimum(rows + info.fps // self.fps - 1, self.recording.num_frames - 1)
        vectors: dict[str, NDArray[np.floating[Any]]] = dict(
            observation_vectors(
                ObservationRows.of_columns(self.simulated.columns, rows),
                info.robot,
                info.scene,
                privileged=self.options.privileged,
                state=self._state,
                sensed=self._sensed,
                dtype=np.float64,
            )
        )
        if COMMAND in self.names:
            vectors[COMMAND] = command_vectors(self.simulated.columns, action_rows)
        vectors[ACTION] = action_vectors(
            self.simulated.columns, info.scene, self.options.action, action_rows, dtype=np.float64
        )
        return vectors

    @cached_property
    def scalar_columns(self) -> Mapping[str, NDArray[np.generic]]:
        """As its name says."""
        outcome, is_last = self.simulated.recording.outcome, self.rows == self.rows[-1]
        success = outcome is not None and outcome.success
        found: dict[str, NDArray[np.generic]] = {
            INTERVENTION: interventions(self.simulated.columns.phase)[self.rows],
            REWARD: (is_last & success).astype(np.float32),
            DONE: is_last,
            SUCCESS: is_last & success,
        }
        return {name: found[name] for name in self.scalars}


class _External(ExportEpisode):
    """Of a recording of somebody else's robot, simulator or program: its features and images as they came."""

    simulated = None

    def __init__(self, recording: CollectedRecording, options: CommonOptions) -> None:
        super().__init__(recording, options)
        self._recording = recording
        self._check_options()
        info = recording.info
        self.fps = info.fps
        cameras = [ExportCamera(name=name, feature=IMAGE_PREFIX + name) for name in recording.cameras]
        cameras += [
            ExportCamera(name=name, feature=IMAGE_PREFIX + name, is_depth=True)
            for name in (recording.depth_cameras if options.depth else ())
        ]
        self._settle({feature.name: feature.names for feature in info.features}, (DONE,), cameras)

    def _check_options(self) -> None:
        """Raise ConfigError for options that only a simulated episode can serve."""
        options, path, info = self.options, self.recording.path, self._recording.info
        if options.action != "joint":
            raise ConfigError(
                f"action is {options.action!r}, but external actions are exported as they came (joint): {path}"
            )
        if (state := getattr(options, "state", "joint")) != "joint":
            raise ConfigError(f"state is {state!r}, but an external state is exported as it came (joint): {path}")
        if options.depth and not self._recording.depth_cameras:
            raise ConfigError(f"depth is asked for, but no camera of the recording measures distances: {path}")
        unknown = [kind for kind in getattr(options, "language", None) or () if kind != "subtask"]
        if unknown:
            raise ConfigError(
                f"language names {unknown[0]!r}, but of an external episode only the subtasks are known that its "
                f"source states: {path}"
            )
        for name in ("privileged", "progress", "boxes"):  # the last two of LeRobot datasets alone
            if getattr(options, name, None) not in (None, False):
                raise ConfigError(f"{name} is asked for, which needs the scene of a simulated episode: {path}")
        if options.fps not in (None, info.fps):
            raise ConfigError(
                f"fps is {options.fps}, but the episode was recorded at {info.fps}, and whether frames can be left out "
                f"of it depends on what its actions mean: {path}"
            )

    @property
    def depth_left_out(self) -> tuple[str, ...]:
        """Depth cameras that were not asked for."""
        return () if self.options.depth else self._recording.depth_cameras

    @property
    def subtasks(self) -> tuple[tuple[int, str], ...]:
        """(frame, what is begun there) as its source states it."""
        return self._recording.subtasks

    @property
    def origin(self) -> str:
        """The recorder, or the imported files."""
        return to_json(self._recording.info.origin)

    @property
    def urdf(self) -> str:
        """As the source has it."""
        return self._recording.info.urdf

    @property
    def joints(self) -> Mapping[str, tuple[str, ...]]:
        """Of all features that have any."""
        return {feature.name: feature.joints for feature in self._recording.info.features if any(feature.joints)}

    @property
    def units(self) -> Mapping[str, tuple[str, ...]]:
        """Of those."""
        found = self._recording.info.features
        return {feature.name: feature.units for feature in found if any(feature.joints) and feature.units}

    def described_cameras(self) -> list[dict[str, Any]]:
        """What the source states of them."""
        return [
            {
                "name": camera.name,
                "width": camera.width,
                "height": camera.height,
                "intrinsics": None if camera.intrinsics is None else list(camera.intrinsics),
                "mount": camera.mount or None,
                "mount_from_camera": (
                    None if camera.mount_from_camera is None else camera.mount_from_camera.vector().tolist()
                ),
            }
            for camera in self._recording.info.cameras
        ]

    def traits(self) -> Iterator[tuple[str, str]]:
        """Of features and cameras."""
        info = self._recording.info
        wanted = {name: elements for name, elements in self.names.items() if self.options.takes(name)}
        yield "kind of episode", "external"
        yield "fps", str(info.fps)
        yield "robot", info.robot
        yield "features", " ".join(wanted)
        yield from ((f"feature {name}", ", ".join(elements)) for name, elements in wanted.items())
        yield from self._camera_traits()

    def numbers(self, camera: ExportCamera) -> NDArray[np.int64]:
        """Its own image, or the camera's last one where that may be held; ExportError where there is neither."""
        columns = self._recording.columns()
        numbers = columns.pictures[camera.name].copy()
        stamps = columns.picture_stamps[camera.name]
        longest = round(self.options.hold_pictures * _SECOND_NS)
        without = np.flatnonzero(numbers == NO_PICTURE)
        for frame in without.tolist():
            before = int(numbers[frame - 1]) if frame else NO_PICTURE
            age = int(columns.time_ns[frame] - stamps[before]) if before != NO_PICTURE else None
            if age is None or age > longest:
                last, hold = "none came before it", ""
                if age is not None:
                    last = f"the last one is {age / _SECOND_NS:.3g} s old"
                    hold = "allow that one to be held (--hold-pictures SECONDS), or "
                raise ExportError(
                    f"Frame {frame} has no image of the camera {camera.name}, as {len(without)} of {len(numbers)} "
                    f"frames, and {last}: {hold}leave the camera (--features) or the episode (--episodes) out: "
                    f"{self.recording.path}"
                )
            numbers[frame] = before
        return numbers

    def _vectors(self) -> Mapping[str, NDArray[np.floating[Any]]]:
        return self._recording.columns().features

    @cached_property
    def scalar_columns(self) -> Mapping[str, NDArray[np.generic]]:
        """As its name says."""
        return {DONE: self.rows == self.rows[-1]}


def exported(recording: AnyRecording, options: CommonOptions) -> ExportEpisode:
    """What a dataset with these options has of a recording; ConfigError for options that it cannot serve."""
    return (
        _External(recording, options) if isinstance(recording, CollectedRecording) else _Simulated(recording, options)
    )


def frame_stride(recording_fps: int, fps: int | None) -> int:
    """How many frames of the recording make one of the dataset.

    Raises:
        ConfigError: The wanted fps does not divide that of the recording.
    """
    if fps is None:
        return 1
    if recording_fps % fps:
        divisors = [str(n) for n in range(1, recording_fps + 1) if recording_fps % n == 0]
        raise ConfigError(
            f"fps is {fps}, which does not divide the recordings' {recording_fps}: allowed are {', '.join(divisors)}."
        )
    return recording_fps // fps


def check_feature_names(options: CommonOptions, offered: Collection[str]) -> None:
    """Raise ConfigError when `options.features` names one that is not among the offered ones."""
    for name in options.features:
        if name == ENVIRONMENT_STATE and name not in offered:
            raise ConfigError(f"The feature {name} is named in --features, but only --privileged adds it.")
        if name not in offered:
            raise ConfigError(
                f"Unknown feature {name!r}.{nearest_match(name, offered)} The recordings and these options give: "
                f"{', '.join(offered)}."
            )
