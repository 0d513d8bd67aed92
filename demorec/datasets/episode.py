"""The exported part of an episode: frames, features and images, for any format."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import ConfigError, ExportError
from demorec.core.plain import digest
from demorec.core.registry import nearest_match
from demorec.core.tables import EXTRA_FILES
from demorec.datasets.options import CommonOptions
from demorec.episode.episode import NO_IMAGE, Table, interventions
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
    observation_names,
    observation_vectors,
)
from demorec.episode.info import EpisodeInfo
from demorec.episode.simulated import on_request, scene_of
from demorec.mcap import Recording

REWARD = "next.reward"
DONE = "next.done"
SUCCESS = "next.success"
INTERVENTION = "intervention"
"""Whether the expert acts in an episode that a policy began; LeRobot's DAgger uses the same name."""
SCALARS: Mapping[str, Literal["float32", "bool"]] = {
    INTERVENTION: "bool",
    REWARD: "float32",
    DONE: "bool",
    SUCCESS: "bool",
}
"""Features with one number per frame, and their type."""


@dataclass(frozen=True, kw_only=True)
class ExportCamera:
    """A stream of images of the dataset.

    Attributes:
        name: Name of the camera in the recording.
        feature: Name of the stream in the dataset.
        is_depth: Whether its images are distances.
    """

    name: str
    feature: str
    is_depth: bool = False


class ExportEpisode[O: CommonOptions]:
    """The frames, features and images of a recording for a dataset with given options. Raises ConfigError for options
    that the recording does not support.

    Args:
        info: Description of the episode; default: the recording's.
        read_table: Reads the features that `info` lists; default: the recording's.

    Attributes:
        scene: World at the start; None if unknown.
        state: Form of `observation.state`.
        names: Vector feature of the dataset -> names of its elements.
        scalars: Features of `SCALARS` in the dataset.
        depth_left_out: Cameras with depth only, if depth was not requested.
    """

    def __init__(
        self,
        recording: Recording,
        options: O,
        *,
        info: EpisodeInfo | None = None,
        read_table: Callable[[], Table] | None = None,
    ) -> None:
        self.recording, self.options = recording, options
        self.info = info or recording.info
        self._read_table = read_table or recording.table
        self.scene = scene_of(self.info)
        self.state: StateKind = getattr(options, "state", "joint")  # an option of LeRobot datasets only
        if self.scene is None:
            _refuse_without_scene(options, recording)
        names, cameras, scalars = self._offered_names(), self._offered_cameras(), self._offered_scalars()
        offered = [*names, *(camera.feature for camera in cameras), *scalars]
        _check_feature_names(options, dict.fromkeys([*offered, *(feature.name for feature in self.info.features)]))
        self.names = {name: elements for name, elements in names.items() if options.takes(name)}
        self.scalars = tuple(name for name in scalars if options.takes(name))
        self.cameras = tuple(camera for camera in cameras if options.takes(camera.feature))
        only_depth = [name for name in recording.depth_cameras if name not in recording.cameras]
        self.depth_left_out = () if options.depth else tuple(only_depth)

    def _offered_names(self) -> dict[str, tuple[str, ...]]:
        if self.scene is None:
            return {feature.name: feature.names for feature in self.info.features}
        robot, options = self.info.simulated.robot, self.options
        sensed = [feature for feature in on_request(self.info) if feature.name in options.features]
        names = observation_names(robot, self.scene, privileged=options.privileged, state=self.state, sensed=sensed)
        if COMMAND in options.features:
            names[COMMAND] = action_names(robot, "joint")
        return {**names, ACTION: action_names(robot, options.action)}

    def _offered_scalars(self) -> tuple[str, ...]:
        if getattr(self.options, "motor_units", None) is not None:  # same as LeRobot's recording of the real arm
            return ()
        if self.scene is None:
            return (DONE,)
        first = (INTERVENTION,) if getattr(self.options, "intervention", False) else ()
        return (*first, REWARD, DONE, SUCCESS)

    def _offered_cameras(self) -> list[ExportCamera]:
        colors, depths = self.recording.cameras, self.recording.depth_cameras if self.options.depth else ()
        if self.options.depth and not depths:
            raise ConfigError(
                "depth needs recordings with depth images (generate --depth), and no camera of "
                f"this one has them: {self.recording.path}"
            )
        cameras = []
        for name in colors:
            cameras.append(ExportCamera(name=name, feature=IMAGE_PREFIX + name))
            if name in depths:
                cameras.append(ExportCamera(name=name, feature=IMAGE_PREFIX + name + DEPTH_SUFFIX, is_depth=True))
        only_depth = [name for name in depths if name not in colors]
        return cameras + [ExportCamera(name=name, feature=IMAGE_PREFIX + name, is_depth=True) for name in only_depth]

    @property
    def num_frames(self) -> int:
        """T."""
        return self.recording.num_frames

    @property
    def urdf(self) -> str:
        """The robot's URDF as text; "" if unknown."""
        return self.info.urdf or self.recording.description()

    def traits(self) -> dict[str, str]:
        """Return the properties that all recordings of a dataset share: name -> text."""
        info = self.info
        traits = {"kind of episode": "external" if self.scene is None else "simulated", "fps": str(info.fps)}
        if self.scene is None:
            traits |= {"robot": info.robot_name, "features": " ".join(self.names)}
            traits |= {f"feature {name}": ", ".join(elements) for name, elements in self.names.items()}
        else:
            # A scaled arm (the tutorial's) has the same joints and limits; the sidecar has its lengths.
            traits["robot"] = f"{info.robot_name} ({digest(info.simulated.robot.scaled(0.0))})"
        traits["cameras"] = " ".join(camera.feature.removeprefix(IMAGE_PREFIX) for camera in self.cameras) or "none"
        for name in dict.fromkeys(camera.name for camera in self.cameras):
            settings = self.recording.video_settings(name)
            traits[f"size of camera {name}"] = f"{settings.width}x{settings.height}"
            traits[f"codec of camera {name}"] = settings.codec
        if self.options.privileged and ENVIRONMENT_STATE in self.names:
            elements = self.names[ENVIRONMENT_STATE]
            traits["objects and goals"] = " ".join(dict.fromkeys(name.partition(".")[0] for name in elements))
            traits["components of the environment state"] = f"{len(elements)} ({digest(list(elements))})"
        return traits

    @cached_property
    def table(self) -> Table:
        """Features of every frame of the recording. Raises ExportError if it has none."""
        if self.num_frames == 0:
            raise ExportError(f"The recording has no frames: {self.recording.path}")
        return self._read_table()

    @cached_property
    def vectors(self) -> Mapping[str, NDArray[np.floating[Any]]]:
        """Feature of `names` -> (T, D), in the recording's precision. Raises ExportError if the recording has no
        frames, or a number that is not finite, and RecordingError if it is damaged.
        """
        vectors = {name: values for name, values in self.table.features.items() if name in self.names}
        if self.options.privileged or self.state != "joint":
            vectors |= self._scene_observations()
        if self.options.action != "joint":
            scene = self.info.simulated.scene
            vectors[ACTION] = action_vectors(self.recording.trajectory(), scene, self.options.action, dtype=np.float64)
        for name, values in vectors.items():
            self._check_finite(name, values)
        return vectors

    def _scene_observations(self) -> dict[str, NDArray[np.floating[Any]]]:
        vectors = observation_vectors(
            self.recording.trajectory(),
            self.info.simulated.robot,
            self.info.simulated.scene,
            privileged=self.options.privileged,
            state=self.state,
            dtype=np.float64,
        )
        taken = [name for name in (STATE, ENVIRONMENT_STATE) if name in vectors and name in self.names]
        return {name: vectors[name] for name in taken}

    @cached_property
    def columns(self) -> Mapping[str, NDArray[np.generic]]:
        """Feature of `names` -> (T, D) float32, feature of `scalars` -> (T,). Raises ExportError for a number that
        float32 cannot hold, and as in `vectors`.
        """
        columns: dict[str, NDArray[np.generic]] = {}
        for name, values in self.vectors.items():
            with np.errstate(over="ignore"):
                columns[name] = single = values.astype(np.float32)
            self._check_finite(name, single)
        return columns | {name: self._scalar(name) for name in self.scalars}

    def _scalar(self, name: str) -> NDArray[np.generic]:
        if name == INTERVENTION:
            return interventions(self.recording.phases)
        values = self.is_last if name == DONE else self.is_last & bool(self.recording.success)
        return values.astype(SCALARS[name])

    @property
    def is_last(self) -> NDArray[np.bool_]:
        """(T,) whether each frame is the last one."""
        return np.asarray(np.arange(self.num_frames) == self.num_frames - 1)

    def _check_finite(self, name: str, values: NDArray[np.floating[Any]]) -> None:
        if len(wrong := np.flatnonzero(~np.isfinite(values).all(axis=1))):
            why = "too large for float32" if values.dtype == np.float32 else "not finite"
            raise ExportError(
                f"The feature {name} is {why} in frame {wrong[0]}, leave the recording out: {self.recording.path}"
            )

    def numbers(self, camera: ExportCamera) -> NDArray[np.int64]:
        """(T,) number of the image that each frame shows, in the order of `recording.packets`. Raises ExportError if a
        frame has no image.
        """
        numbers = self.table.images[camera.name]
        without = np.flatnonzero(numbers == NO_IMAGE)
        if len(without):
            raise ExportError(
                f"Frame {without[0]} has no image of the camera {camera.name}, like {len(without)} of {len(numbers)} "
                f"frames: leave the camera (--features) or the episode (--episodes) out: {self.recording.path}"
            )
        return numbers

    def images(self, camera: ExportCamera) -> Iterator[NDArray[Any]]:
        """Yield one image per frame: (H, W, 3) uint8 RGB, or (H, W) float32 metres for a depth camera. Raises
        ExportError if the frames show the images in another order than the camera, and as in `numbers`.
        """
        wanted, recording = self.numbers(camera), self.recording
        if (np.diff(wanted) < 0).any():
            raise ExportError(
                f"The images of the camera {camera.name} are not in the order of the frames: {recording.path}"
            )
        images: Iterator[tuple[int, NDArray[Any]]]
        images = enumerate(recording.depth(camera.name) if camera.is_depth else recording.images(camera.name))
        number, image = next(images)
        for due in wanted.tolist():
            while number < due:
                number, image = next(images)
            yield image


def _refuse_without_scene(options: CommonOptions, recording: Recording) -> None:
    """Raise ConfigError for options that only an episode with a known scene can serve."""
    state = getattr(options, "state", "joint")
    named = {f"action {options.action}": options.action != "joint", f"state {state}": state != "joint"}
    named |= {f"language {kind}": kind != "subtask" for kind in getattr(options, "language", None) or ()}
    # all but the first exist only for LeRobot datasets
    named |= {name: getattr(options, name, False) for name in ("privileged", "intervention", *EXTRA_FILES.names())}
    if needs_scene := [name for name, is_wanted in named.items() if is_wanted]:
        raise ConfigError(
            f"{', '.join(needs_scene)} needs the scene of a simulated episode, leave it out: {recording.path}"
        )


def _check_feature_names(options: CommonOptions, offered: Collection[str]) -> None:
    for name in options.features:
        if name == ENVIRONMENT_STATE and name not in offered:
            raise ConfigError(f"The feature {name} is named in --features, but only --privileged adds it.")
        if name not in offered:
            raise ConfigError(
                f"Unknown feature {name!r}.{nearest_match(name, offered)} The recordings and these options provide: "
                f"{', '.join(offered)}."
            )
