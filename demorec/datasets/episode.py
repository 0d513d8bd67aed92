"""An episode as every exporter writes it: which frames, which numbers, which images, whoever recorded it.

The formats ask an `ExportEpisode`, and never what kind of recording it comes from.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import ConfigError, ExportError
from demorec.core.plain import digest, to_json
from demorec.core.registry import nearest_match
from demorec.datasets.options import CommonOptions
from demorec.episode.episode import NO_IMAGE, Table, Trajectory, interventions
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
from demorec.episode.info import Feature
from demorec.episode.sensed import SENSED, ObservationRows
from demorec.mcap import Recording, channels

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


class ExportEpisode:
    """What a dataset has of one recording, with these options.

    Args:
        recording: Open.
        options: Of the export.

    Attributes:
        recording, info: The episode; a simulated one has more to give.
        fps: Of the dataset.
        names: Vector feature -> names of its D elements, all that recording and options offer.
        scalars: Of `SCALARS`, all that they offer.
        cameras: Those that the dataset shall have, in its order.
        depth_left_out: Depth cameras of an external episode that were not asked for.

    Raises:
        ConfigError: Options that the recording cannot serve.
    """

    def __init__(self, recording: Recording, options: CommonOptions) -> None:
        self.recording, self.options = recording, options
        self._state: StateKind = getattr(options, "state", "joint")
        self._sensed: list[str] = []
        self.names: dict[str, tuple[str, ...]]
        self.depth_left_out: tuple[str, ...] = ()
        self.scalars: tuple[str, ...] = (DONE,)
        cameras = [ExportCamera(name=name, feature=IMAGE_PREFIX + name) for name in recording.cameras]
        on_request: tuple[str, ...] = ()
        self.info = info = recording.info
        if info.simulation is not None:
            self.fps = info.fps // _frame_stride(info.fps, options.fps)
            sensed = [name for name, row in SENSED.items() if not row.topic or row.topic in recording.topics]
            on_request = (*sensed, COMMAND)
            self._sensed = [name for name in sensed if name in options.features]
            robot, scene = info.simulated.robot, info.simulated.scene
            self.names = observation_names(
                robot, scene, privileged=options.privileged, state=self._state, sensed=self._sensed
            )
            if COMMAND in options.features:
                self.names[COMMAND] = action_names(robot, "joint")
            self.names[ACTION] = action_names(robot, options.action)
            if options.depth:
                depth = [ExportCamera(name=c.name, feature=c.feature + DEPTH_SUFFIX, is_depth=True) for c in cameras]
                cameras = [camera for pair in zip(cameras, depth, strict=True) for camera in pair]
            self.scalars = (REWARD, DONE, SUCCESS)
            if getattr(options, "intervention", False):
                self.scalars = (INTERVENTION, *self.scalars)
        else:
            _check_external(recording, options)
            self.fps = info.fps
            if getattr(options, "motor_units", False):
                self.scalars = ()
            self.names = {feature.name: feature.names for feature in info.features}
            if options.depth:
                depth_cameras = recording.depth_cameras
                cameras += [ExportCamera(name=n, feature=IMAGE_PREFIX + n, is_depth=True) for n in depth_cameras]
            else:
                self.depth_left_out = recording.depth_cameras
        offered = [*self.names, *(camera.feature for camera in cameras), *self.scalars]
        _check_feature_names(options, [*offered, *(name for name in on_request if name not in offered)])
        self.cameras = tuple(camera for camera in cameras if options.takes(camera.feature))

    @property
    def origin(self) -> str:
        """Where the episode comes from: "" for a generated one, "replay of DIGEST", or JSON of imported files."""
        origin = self.info.origin
        return origin if isinstance(origin, str) else to_json(origin)

    @property
    def urdf(self) -> str:
        """The robot's URDF as text, "" where it is not known."""
        recording = self.recording
        is_described = not self.info.urdf and channels.description_topic() in recording.topics
        return recording.description() if is_described else self.info.urdf

    def moving(self) -> tuple[Feature, ...]:
        """The features that have joints of the URDF: which of their elements are the positions of which, and units."""
        if self.info.simulation is None:
            return tuple(feature for feature in self.info.features if any(feature.joints))
        arm = self.info.simulated.robot.arm_joints
        pose = ("m",) * 3 + ("",) * 4 if self._state == "joint_ee" else ()
        names = self.names[STATE]
        joints = (*arm, *("" for _ in names[len(arm) :]))
        return (Feature(name=STATE, names=names, joints=joints, units=(*("rad" for _ in arm), "m", *pose)),)

    def traits(self) -> Iterator[tuple[str, str]]:
        """What all recordings of a dataset must have in common, as (what, value) in words."""
        info = self.info
        yield "kind of episode", "external" if info.simulation is None else "simulated"
        yield "fps", str(info.fps)
        if info.simulation is not None:
            # A scaled arm (the tutorial's) has the same joints and limits; its lengths are in the sidecar.
            robot = info.simulated.robot
            yield "robot", f"{robot.name} ({digest(robot.scaled(0.0))})"
        else:
            wanted = {name: elements for name, elements in self.names.items() if self.options.takes(name)}
            yield "robot", info.robot_name
            yield "features", " ".join(wanted)
            yield from ((f"feature {name}", ", ".join(elements)) for name, elements in wanted.items())
        yield "cameras", " ".join(camera.feature.removeprefix(IMAGE_PREFIX) for camera in self.cameras) or "none"
        for name in dict.fromkeys(camera.name for camera in self.cameras):
            settings = self.recording.video_settings(name)
            yield f"size of camera {name}", f"{settings.width}x{settings.height}"
            yield f"codec of camera {name}", settings.codec
        if info.simulation and self.options.privileged and self.options.takes(ENVIRONMENT_STATE):
            names = self.names[ENVIRONMENT_STATE]
            yield "objects and goals", " ".join(dict.fromkeys(name.partition(".")[0] for name in names))
            yield "components of the environment state", f"{len(names)} ({digest(list(names))})"

    @property
    def table(self) -> Table:
        """Features of every frame; RecordingError for damage."""
        return self.recording.table()

    @property
    def trajectory(self) -> Trajectory:
        """Everything simulated, of every frame; RecordingError for damage, or if demorec did not simulate it."""
        return self.recording.trajectory()

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
        found = self.table.features if self.info.simulation is None else self._simulated_vectors()
        vectors = {name: values for name, values in found.items() if self.options.takes(name)}
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

    def _simulated_vectors(self) -> Mapping[str, NDArray[np.floating[Any]]]:
        """Feature -> (T, D). With frames left out, an observation is that of the first frame of its group and an action
        the last one of it: where the robot shall be when the next observation is taken.
        """
        info, rows, trajectory, options = self.info, self.rows, self.trajectory, self.options
        action_rows = np.minimum(rows + info.fps // self.fps - 1, self.recording.num_frames - 1)
        vectors: dict[str, NDArray[np.floating[Any]]] = dict(
            observation_vectors(
                ObservationRows.of_trajectory(trajectory, rows),
                info.simulated.robot,
                info.simulated.scene,
                privileged=options.privileged,
                state=self._state,
                sensed=self._sensed,
                dtype=np.float64,
            )
        )
        if COMMAND in self.names:
            vectors[COMMAND] = command_vectors(trajectory, action_rows)
        vectors[ACTION] = action_vectors(
            trajectory, info.simulated.scene, options.action, action_rows, dtype=np.float64
        )
        return vectors

    @cached_property
    def scalar_columns(self) -> Mapping[str, NDArray[np.generic]]:
        """Feature of `scalars` -> (T,)."""
        is_last = self.rows == self.rows[-1]
        found: dict[str, NDArray[np.generic]] = {DONE: is_last}
        if self.info.simulation is not None:
            is_success = is_last & bool(self.recording.success)
            found |= {REWARD: is_success.astype(np.float32), SUCCESS: is_success}
            if INTERVENTION in self.scalars:
                found[INTERVENTION] = interventions(self.recording.phases)[self.rows]
        return {name: found[name] for name in self.scalars}

    def numbers(self, camera: ExportCamera) -> NDArray[np.int64]:
        """(T,) which image of the camera each frame shows, of those that `recording.packets` gives; of an external
        episode also the camera's last one where that may be held.

        Raises:
            ConfigError: The recording has no such images.
            ExportError: A frame has none.
        """
        if camera.is_depth and not self.recording.has_depth(camera.name):
            raise ConfigError(
                f"--depth needs recordings with depth images (generate --depth), and the camera {camera.name!r} has "
                f"none: leave it out: {self.recording.path}"
            )
        return self._held_numbers(camera.name)[self.rows]

    def _held_numbers(self, camera: str) -> NDArray[np.int64]:
        table = self.table
        numbers, stamps = table.images[camera].copy(), table.image_stamps[camera]
        longest = round(self.options.hold_images * _SECOND_NS)
        without = np.flatnonzero(numbers == NO_IMAGE)
        for frame in without.tolist():
            before = int(numbers[frame - 1]) if frame else NO_IMAGE
            age = int(table.time_ns[frame] - stamps[before]) if before != NO_IMAGE else None
            if age is None or age > longest:
                last, hold = "none came before it", ""
                if age is not None:
                    last = f"the last one is {age / _SECOND_NS:.3g} s old"
                    hold = "allow that one to be held (--hold-images SECONDS), or "
                raise ExportError(
                    f"Frame {frame} has no image of the camera {camera}, as {len(without)} of {len(numbers)} "
                    f"frames, and {last}: {hold}leave the camera (--features) or the episode (--episodes) out: "
                    f"{self.recording.path}"
                )
            numbers[frame] = before
        return numbers

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


def _check_external(recording: Recording, options: CommonOptions) -> None:
    """Raise ConfigError for options that only a simulated episode can serve."""
    fps, state = recording.info.fps, getattr(options, "state", "joint")
    unknown = [kind for kind in getattr(options, "language", None) or () if kind != "subtask"]
    scenic = ("privileged", "progress", "boxes")  # the last two of LeRobot datasets alone
    needs_scene = [name for name in scenic if getattr(options, name, None) not in (None, False)]
    problems = (
        options.action != "joint"
        and f"action is {options.action!r}, but external actions are exported as they came (joint)",
        state != "joint" and f"state is {state!r}, but an external state is exported as it came (joint)",
        options.depth
        and not recording.depth_cameras
        and "depth is asked for, but no camera of the recording measures distances",
        unknown
        and f"language names {unknown[0]!r}, but of an external episode only the subtasks are known that its source "
        "states",
        needs_scene and f"{needs_scene[0]} is asked for, which needs the scene of a simulated episode",
        options.fps not in (None, fps)
        and f"fps is {options.fps}, but the episode was recorded at {fps}, and whether frames can be left out of it "
        "depends on what its actions mean",
    )
    for problem in filter(None, problems):
        raise ConfigError(f"{problem}: {recording.path}")


def _frame_stride(recording_fps: int, fps: int | None) -> int:
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


def _check_feature_names(options: CommonOptions, offered: Collection[str]) -> None:
    """Raise ConfigError when `options.features` names one that is not among the offered ones."""
    for name in options.features:
        if name == ENVIRONMENT_STATE and name not in offered:
            raise ConfigError(f"The feature {name} is named in --features, but only --privileged adds it.")
        if name not in offered:
            raise ConfigError(
                f"Unknown feature {name!r}.{nearest_match(name, offered)} The recordings and these options give: "
                f"{', '.join(offered)}."
            )
