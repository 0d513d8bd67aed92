"""One episode of a LeRobot dataset with the interface of a recording."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.core.config import VideoConfig
from demorec.core.errors import ExportError
from demorec.core.geometry import Pose
from demorec.datasets.lerobot.language import EpisodeLanguage, spoken_of
from demorec.datasets.lerobot.robots import DatasetRobot
from demorec.episode.episode import MAX_STAMP_NS, MAX_SUBTASK, Outcome, Table
from demorec.episode.features import DEPTH_SUFFIX
from demorec.episode.info import Camera, EpisodeInfo, Origin
from demorec.episode.protocol import Episode, SceneMotion
from demorec.episode.roles import Roles
from demorec.extensions.datasets.episode_places import are_on_grid
from demorec.extensions.datasets.folder import LeRobotFolder
from demorec.extensions.datasets.robots import described, recognised_robot, robot_of_motors
from demorec.extensions.datasets.videos import EpisodeVideo
from demorec.mcap.streams import frame_times
from demorec.mcap.transforms import measured_motion
from demorec.mcap.video import Rgb, VideoPacket, VideoSettings, make_encoder, settings_of_coded

_SUCCESS = "next.success"
_UNNAMED_ROBOT = "unknown"
_MAX_REASON = 10_000


class DatasetRecording(Episode):
    """One episode of a dataset, with the interface of `demorec.mcap.Recording`; frames are at multiples of 1/fps, or at
    measured timestamps.

    Reading episodes in order takes one pass.

    Args:
        number: Position of the episode in the dataset, from 0.
        finds_robot: Whether to describe also an arm that its joints' names identify, or that other episodes lack.

    Attributes:
        known: The sidecar's data about it; empty if there are none.

    Methods and properties raise ExportError for unreadable files.
    """

    def __init__(self, dataset: LeRobotFolder, number: int, *, finds_robot: bool = False) -> None:
        self.place = place = dataset.places[number]
        self.path, self.dataset, self._finds_robot = dataset.root, dataset, finds_robot
        self.num_frames = place.length
        self.known: Mapping[str, Any] = dataset.known.get(place.episode_index, {})
        self._is_depth = {name: dataset.info.features[key].is_depth for name, key in dataset.keys.items()}

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the colour cameras."""
        return tuple(name for name, is_depth in self._is_depth.items() if not is_depth)

    @property
    def depth_cameras(self) -> tuple[str, ...]:
        """Names of the cameras with distances."""
        return tuple(name for name, is_depth in self._is_depth.items() if is_depth)

    @cached_property
    def info(self) -> EpisodeInfo:
        """Description of the episode; its robot and cameras are those in the sidecar."""
        is_stated = self.known.get("robot_digest") is not None or self.dataset.motors is not None
        robot = self.robot if self.dataset.has_one_robot and is_stated else None
        links = set() if robot is None else {robot.model.root, *(joint.child for joint in robot.model.joints)}
        described = {camera["name"]: camera for camera in self.known.get("cameras") or () if camera is not None}
        cameras = [
            # The sidecar has no entry for a depth camera of a simulated episode.
            _described(
                self.dataset.camera(name), described.get(name, described.get(name.removesuffix(DEPTH_SUFFIX))), links
            )
            for name in self.dataset.keys
        ]
        info = EpisodeInfo(
            episode_index=self.place.episode_index,
            instruction=self._instruction(),
            robot_name=self.dataset.info.robot_type or _UNNAMED_ROBOT,
            fps=int(self.dataset.info.fps),
            features=self.dataset.features,
            cameras=tuple(cameras),
            origin=Origin(kind="dataset"),
        )
        robot = self.robot if robot is None and self._finds_robot else robot
        return info if robot is None else _with_robot(info, robot, self.dataset.roles)

    def _instruction(self) -> str:
        indices = dict.fromkeys(self._rows["task_index"][:, 0].tolist())
        tasks = self.dataset.tasks
        if any(not 0 <= index < len(tasks) for index in indices):
            raise ExportError(
                f"Episode {self.place.episode_index} names a task that is not in the table of tasks: {self.path}"
            )
        return "; ".join(" ".join(tasks[int(index)].split()) for index in indices)

    @cached_property
    def robot(self) -> DatasetRobot | None:
        """The arm in the sidecar, the arm of the named servos, or one of demorec's arms with joints of these names."""
        if (name := self.known.get("robot_digest")) is not None:
            return self.dataset.robot(str(name))
        if self.dataset.motors is not None:
            return robot_of_motors(self.dataset.motors)
        roles = self.dataset.roles
        return None if self.known else recognised_robot(roles.elements(roles.state))

    @cached_property
    def outcome(self) -> Outcome:
        """Outcome in the sidecar, otherwise by the last row."""
        success, reason = self.known.get("success"), self.known.get("failure_reason") or ""
        if len(reason) > _MAX_REASON or not reason.isprintable():
            reason = ""
        if not self.known and _SUCCESS in self._rows and self.num_frames:
            success = bool(self._rows[_SUCCESS][-1, 0])
        return Outcome(success=success, num_frames=self.num_frames, failure_reason=reason)

    @property
    def success(self) -> bool | None:
        """Success; None if unknown."""
        return self.outcome.success

    @cached_property
    def _rows(self) -> Mapping[str, NDArray[Any]]:
        rows, info = self.dataset.recorded_rows.numbers(self.place), self.dataset.info
        for feature in self.dataset.features:
            found, claimed = rows[feature.name].dtype, np.dtype(info.features[feature.name].dtype)
            are_floats = found.kind == claimed.kind == "f"  # read with info.json's type, as LeRobot does
            if self.num_frames and found != claimed and not are_floats:
                raise ExportError(f"The column {feature.name} holds {found}, not {claimed}: {self.path}")
        return rows

    @cached_property
    def measured_ns(self) -> NDArray[np.int64] | None:
        """(T,) ns of rows with measured timestamps; None for multiples of 1/fps."""
        seconds, fps = self._rows["timestamp"][:, 0].astype(np.float64), int(self.dataset.info.fps)
        if are_on_grid(seconds, fps):
            return None
        wrong = np.flatnonzero(
            ~(np.diff(seconds, prepend=-1.0) > 0) | ~(seconds >= 0) | ~(seconds < MAX_STAMP_NS / 1e9)
        )
        if len(wrong):
            raise ExportError(
                f"Row {wrong[0]} of episode {self.place.episode_index} is at {seconds[wrong[0]]:.4f} s, timestamps "
                f"must rise from 0 s or later: {self.path}"
            )
        return np.rint(seconds * 1e9).astype(np.int64)

    @property
    def time_ns(self) -> NDArray[np.int64]:
        """(T,) time of each frame, ns."""
        return self.table().time_ns

    def table(self) -> Table:
        """Read the features of every frame, in recordings' types."""
        return self._table

    @cached_property
    def _table(self) -> Table:
        return self.table_with({name: self.lead(name) for name in self.dataset.keys})

    def table_with(self, leads: Mapping[str, int]) -> Table:
        """Read the features of every frame, with this number of images for each camera before the first frame."""
        begin, fps = max(leads.values(), default=0), int(self.dataset.info.fps)
        times = frame_times(begin + self.num_frames, fps)
        if self.measured_ns is not None:  # after the images that precede the first frame
            times[begin:] = self.measured_ns + times[begin]
        features = {item.name: self._rows[item.name].astype(item.dtype) for item in self.dataset.features}
        return Table(
            time_ns=times[begin:],
            features=features,
            stamps=dict.fromkeys(features, times[begin:]),
            images={name: np.arange(lead, lead + self.num_frames) for name, lead in leads.items()},
            image_stamps={name: times[begin - lead :] for name, lead in leads.items()},
        )

    def motion(self) -> SceneMotion:
        """Motion of the known joints."""
        return measured_motion(self.info, self.table())

    def description(self, body: str = "") -> str:
        """URDF of the robot; "" if unknown, and for bodies."""
        return "" if body else self.info.urdf

    def lead(self, camera: str) -> int:
        """Count a camera's images before the first frame from which that frame is decoded."""
        video = self._video(camera) if self._has_packets(camera) else None
        return 0 if video is None else video.lead

    def _has_packets(self, camera: str) -> bool:
        return not self._is_depth[camera] and self.dataset.camera(camera).kept != ""

    def _video(self, camera: str) -> EpisodeVideo | None:
        """Video of a camera; None if its images are in table rows."""
        key = self.dataset.keys[camera]
        return self.dataset.video(key, self.place) if self.dataset.info.features[key].is_video else None

    def video_settings(self, camera: str) -> VideoSettings:
        """Encoding of a camera's images; images in rows, or with a codec that recordings cannot hold, are provided as
        JPEG.
        """
        found = self.dataset.camera(camera)
        return settings_of_coded(found.kept or "jpeg", found.width, found.height, int(self.dataset.info.fps))

    def packets(self, camera: str) -> Iterator[VideoPacket]:
        """Encoded images of a camera in order; `frame_index` is the image number to which frames refer."""
        lead, times = self.lead(camera), self.table().image_stamps[camera]
        video = self._video(camera)
        if video is not None and self._has_packets(camera):
            for frame, data, is_key in video.packets():
                number = min(frame + lead, len(times) - 1)
                yield VideoPacket(frame_index=number, time_ns=int(times[number]), data=data, is_keyframe=is_key)
            return
        found = self.dataset.camera(camera)
        encoder = make_encoder(
            video=VideoConfig(codec="jpeg"), width=found.width, height=found.height, fps=int(self.dataset.info.fps)
        )
        for number, image in enumerate(self.images(camera)):
            (data,) = encoder.encode(image)
            yield VideoPacket(frame_index=number, time_ns=int(times[number]), data=data, is_keyframe=True)

    def images(self, camera: str) -> Iterator[Rgb]:
        """Decoded images of a camera, (H, W, 3) uint8 RGB, in order."""
        if (video := self._video(camera)) is not None:
            return video.images(-self.lead(camera))
        return self.dataset.stored_images[self.dataset.keys[camera]].read(self.place)

    def images_at(self, camera: str, frames: Sequence[int]) -> Iterator[Rgb]:
        """Images of a camera at some frames, ascending, (H, W, 3) uint8 RGB."""
        if (video := self._video(camera)) is not None:
            return video.images_at(frames)
        return self.dataset.stored_images[self.dataset.keys[camera]].read(self.place, frames)

    def distances(self, camera: str) -> Iterator[NDArray[np.float32]]:
        """Images of a depth camera in order, (H, W) float32 metres, 0 where nothing was measured."""
        return self.dataset.video(self.dataset.keys[camera], self.place).distances()

    depth = distances

    @cached_property
    def spoken(self) -> EpisodeLanguage:
        """Content of its language columns; empty if the dataset has none."""
        rows = self.dataset.language_rows
        return EpisodeLanguage() if rows is None else spoken_of(rows.batches(self.place), self.path)

    @property
    def subtasks(self) -> tuple[tuple[int, str], ...]:
        """(first frame, subtask), in order; empty if unknown, or if a recording cannot hold one."""
        return tuple(sorted(self._subtasks[0].items()))

    @property
    def language_left_out(self) -> str:
        """Language that a recording cannot hold, "" if it can hold all."""
        return self._subtasks[1]

    @cached_property
    def _subtasks(self) -> tuple[dict[int, str], str]:
        texts: dict[int, str] = {}
        left_out = ""
        for row in self.spoken.persistent:
            text, begin = str(row.get("content")), row.get("timestamp")
            frame = begin * self.dataset.info.fps if isinstance(begin, float) else -1
            if row.get("style") != "subtask" or not 0 <= frame < self.num_frames:
                left_out = "all but its subtasks"
            elif len(text) > MAX_SUBTASK or not text.isprintable():
                return {}, f"a subtask is not a single line of at most {MAX_SUBTASK} characters"
            else:
                texts[round(frame)] = text
        return texts, left_out


def _with_robot(info: EpisodeInfo, robot: DatasetRobot, roles: Roles) -> EpisodeInfo:
    """Add an arm and the joints that the features move to a description."""
    features = tuple(described(robot, feature, roles.usual_name(feature.name)) for feature in info.features)
    return replace(info, urdf=robot.urdf, features=features)


def _described(camera: Camera, found: Mapping[str, Any] | None, links: set[str]) -> Camera:
    if found is None:
        return camera
    intrinsics, pose = found["intrinsics"], found["mount_from_camera"]
    if intrinsics is not None and len(intrinsics) == 9 and all(map(_is_finite, intrinsics)):
        camera = replace(camera, intrinsics=tuple(intrinsics))
    # A camera fixed in a simulated world has no link, and the sidecar does not record the arm's position in it.
    is_pose = (
        pose is not None and len(pose) == 7 and all(map(_is_finite, pose)) and abs(math.hypot(*pose[3:]) - 1) < 1e-3
    )
    if found["mount"] in links and is_pose:
        placed = Pose(position=np.array(pose[:3]), quat_xyzw=np.array(pose[3:]))
        camera = replace(camera, mount=found["mount"], mount_from_camera=placed)
    return camera


def _is_finite(value: object) -> bool:
    return isinstance(value, float) and math.isfinite(value)
