"""What recordings give to a dataset: those of simulated and of external episodes as `ExportEpisode`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import ConfigError, ExportError
from demorec.core.plain import digest, to_json
from demorec.datasets.episode import (
    DONE,
    INTERVENTION,
    REWARD,
    SUCCESS,
    ExportCamera,
    ExportEpisode,
    Simulated,
    frame_stride,
)
from demorec.datasets.options import CommonOptions
from demorec.episode.episode import interventions
from demorec.episode.external import NO_PICTURE
from demorec.episode.features import (
    ACTION,
    COMMAND,
    DEPTH_SUFFIX,
    ENVIRONMENT_STATE,
    IMAGE_PREFIX,
    STATE,
    StateKind,
    action_names,
    action_vectors,
    command_vectors,
    observation_names,
    observation_vectors,
)
from demorec.episode.sensed import SENSED, ObservationRows
from demorec.mcap import AnyRecording, Recording, SimulatedRecording, channels

_SECOND_NS = 1_000_000_000


class _Simulated(ExportEpisode):
    """Of a recording of demorec's own simulation."""

    simulated: Simulated

    def __init__(self, recording: SimulatedRecording, options: CommonOptions) -> None:
        super().__init__(recording, options)
        self.simulated = Simulated(recording)
        info = recording.info
        self.fps = info.fps // frame_stride(info.fps, options.fps)
        self._state: StateKind = getattr(options, "state", "joint")
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

    @property
    def on_request(self) -> tuple[str, ...]:
        """What was sensed beside the usual, and the executed command."""
        return (*(name for name in SENSED if self._has(name)), COMMAND)

    def _has(self, name: str) -> bool:
        stream = SENSED[name].stream
        return stream is None or stream.topic in self.simulated.recording.topics

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

    def __init__(self, recording: Recording, options: CommonOptions) -> None:
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
    return _External(recording, options) if isinstance(recording, Recording) else _Simulated(recording, options)
