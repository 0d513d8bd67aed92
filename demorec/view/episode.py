"""An episode prepared for playback: images, motion, and numbers over time as curves."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from demorec.core.geometry import Array, Pose
from demorec.episode.episode import NO_IMAGE, Table
from demorec.episode.features import ACTION, DEPTH_SUFFIX, EE_POSE, STATE, VELOCITY
from demorec.episode.info import EpisodeInfo
from demorec.episode.protocol import Episode, SceneMotion
from demorec.episode.roles import ROLES, Roles
from demorec.episode.scene import Scene
from demorec.episode.simulated import on_request, scene_of

Distances = NDArray[np.uint16] | NDArray[np.float32]
"""(H, W) millimetres or metres."""
EFFORT_CURVES = "effort (N m)"
FORCE_CURVES = "contact_force (N)"
Statements = tuple[tuple[int, str, str], ...]
"""(frame, kind, sentence), each valid until the next one of its kind."""


class Curves(NamedTuple):
    """Several numbers over time: (T, n) values at the frames, n names."""

    values: Array
    names: tuple[str, ...]


@dataclass(frozen=True, kw_only=True, eq=False)
class Playback:
    """An open episode for playback.

    Attributes:
        name: Name in the list of recordings.
        group: Run or dataset that contains it.
        identity: Unique identifier.
        data: The episode.
        motion: Motion of its robot and scene.
        roles: Roles of its features.
        curves: Name -> measured values; for a simulated episode as in `simulated_curves`, for any other the elements of
            its features, by the features' names.
        statements: Language statements about it.
    """

    name: str
    group: str
    identity: str
    data: Episode
    motion: SceneMotion
    roles: Roles
    curves: Mapping[str, Curves]
    statements: Statements = ()

    @property
    def info(self) -> EpisodeInfo:
        """Description available before the first frame."""
        return self.data.info

    @property
    def scene(self) -> Scene | None:
        """Scene at the start, if known."""
        return scene_of(self.info)

    @property
    def world_from_base(self) -> Pose:
        """Pose of the robot's base; the origin if unknown."""
        return Pose() if self.scene is None else self.scene.robot.world_from_base

    @cached_property
    def time_ns(self) -> NDArray[np.int64]:
        """(T,) timestamps of the frames, ns since the first one."""
        times = self.data.time_ns
        return times - times[0] if len(times) else times

    @cached_property
    def videos(self) -> tuple[str, ...]:
        """Cameras with colour images."""
        return tuple(camera for camera in self.data.cameras if len(self._stamps[camera]))

    @cached_property
    def depth(self) -> Mapping[str, str]:
        """Camera -> its stream of distances; in datasets of simulated episodes its name differs from the camera's."""
        placed = () if self.scene is None else [camera.name for camera in self.scene.cameras]
        streams = [stream for stream in self.data.depth_cameras if len(self._stamps[stream])]
        owner = {stream: stream.removesuffix(DEPTH_SUFFIX) for stream in streams if stream not in placed}
        return {owner[stream] if owner.get(stream) in placed else stream: stream for stream in streams}

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras that have images or are in the scene."""
        placed = () if self.scene is None else (camera.name for camera in self.scene.cameras)
        return tuple(dict.fromkeys([*placed, *self.videos, *self.depth]))

    @property
    def _stamps(self) -> Mapping[str, NDArray[np.int64]]:
        return self.data.table().image_stamps

    def packets(self, camera: str) -> Iterator[tuple[int, bytes, bool]]:
        """Yield the encoded images of a camera: time_ns of display, data, whether it is a keyframe."""
        shown_ns = shown_at(self.data.table(), camera, self.time_ns)
        for packet in self.data.packets(camera):
            yield int(shown_ns[packet.frame_index]), packet.data, packet.is_keyframe

    def distances(self, camera: str) -> Iterator[tuple[int, Distances]]:
        """Yield the distance images of a camera, each with its time_ns."""
        stream = self.depth[camera]
        shown_ns = shown_at(self.data.table(), stream, self.time_ns)
        return zip(shown_ns.tolist(), self.data.distances(stream), strict=False)

    @property
    def num_frames(self) -> int:
        """Number of frames."""
        return self.data.num_frames

    @property
    def duration(self) -> float:
        """Duration in seconds from the first frame to the end of the last, which lasts one nominal frame."""
        return float(self.time_ns[-1]) / 1e9 + 1 / self.info.fps if self.num_frames else 0.0

    @property
    def verdict(self) -> str:
        """Outcome in one or two words."""
        outcome = self.data.outcome
        if outcome is None or outcome.success is None:
            return "outcome unknown"
        return "success" if outcome.success else f"failure: {outcome.failure_reason or 'no reason given'}"


def shown_at(table: Table, camera: str, time_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """Compute (P,) display times of a camera's images: at the first frame that shows each, or the next one after it.

    Their own timestamps may come from another clock.
    """
    frames = np.flatnonzero(table.images[camera] != NO_IMAGE)
    numbers = np.maximum.accumulate(table.images[camera][frames])
    count = len(table.image_stamps[camera])
    places = np.minimum(np.searchsorted(numbers, np.arange(count)), max(len(frames) - 1, 0))
    return time_ns[frames[places]] if len(frames) else np.zeros(count, dtype=np.int64)


def feature_curves(episode: Episode, roles: Roles) -> dict[str, Curves]:
    """List the elements of each feature, in the order of roles."""
    features = episode.table().features
    ordered = sorted(episode.info.features, key=lambda feature: ROLES.index(roles.of[feature.name]))
    return {feature.name: Curves(features[feature.name].astype(np.float64), feature.names) for feature in ordered}


def simulated_curves(episode: Episode) -> dict[str, Curves]:
    """Compute the curves of a simulated episode; a missing observation has none.

    They are "position" and "velocity" of the arm's joints, "gripper" (m), "ee" (m) and those of its sensors, split by
    unit ("wrench (N)"); "gripper target" and, if its actions are joint targets, "target" are the commands.
    """
    info = episode.info
    features = {name: values.astype(np.float64) for name, values in episode.table().features.items()}
    names = {feature.name: feature.names for feature in info.features}
    joints = info.simulated.robot.arm_joints
    count = len(joints)
    shown = {"position": Curves(features[STATE][:, :count], joints)}
    if VELOCITY in features:
        shown["velocity"] = Curves(features[VELOCITY][:, :count], joints)
    if names[ACTION] == names[STATE]:
        shown["target"] = Curves(features[ACTION][:, :count], joints)
    for feature in on_request(info):
        for unit in dict.fromkeys(feature.units) if feature.name in features else ():
            columns = [number for number, other in enumerate(feature.units) if other == unit]
            title = f"{feature.name.removeprefix('observation.')} ({unit})"
            shown[title] = Curves(features[feature.name][:, columns], tuple(feature.names[n] for n in columns))
    shown["gripper"] = Curves(features[STATE][:, count : count + 1], ("opening",))
    shown["gripper target"] = Curves(features[ACTION][:, -1:], ("target",))
    if EE_POSE in features:
        shown["ee"] = Curves(features[EE_POSE][:, :3], ("x", "y", "z"))
    return shown
