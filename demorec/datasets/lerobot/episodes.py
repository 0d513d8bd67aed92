"""The episodes of a LeRobot dataset, whoever wrote it, as recordings give theirs.

    dataset = LeRobotDataset(root)
    for number in range(len(dataset)):
        recording = dataset.recording(number)
        recording.info, recording.columns(), recording.packets("front"), recording.subtasks

Formats v3.0, v2.1 and v2.0 are read. What our own exports keep beside the tables (outcome, robot, cameras) is used
where it is there. Memory is that of an episode's numbers.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from demorec.core.config import VideoConfig
from demorec.core.errors import ConfigError, ExportError, in_words
from demorec.core.geometry import Pose
from demorec.datasets.lerobot.boxes import BOXES_DIR, ReadBox, read_boxes
from demorec.datasets.lerobot.depth import DepthScale
from demorec.datasets.lerobot.files import column_numbers, open_table, table_batches
from demorec.datasets.lerobot.language import COLUMNS, PERSISTENT, SpokenEpisode, spoken_of
from demorec.datasets.lerobot.layout import AUTOMATIC_FEATURES, DatasetFeature, DatasetInfo
from demorec.datasets.lerobot.paths import SIDECAR_DIR
from demorec.datasets.lerobot.reader import EpisodePlace, RowReader, RowStream, episode_places, read_tasks
from demorec.datasets.lerobot.robots import DatasetRobot, read_robot, recognised_robot
from demorec.datasets.lerobot.sidecar import EPISODE_SCHEMA
from demorec.datasets.lerobot.videos import EpisodeVideo, StoredImages, codec_of, opened_video
from demorec.episode.episode import Columns, Outcome, frame_time_ns
from demorec.episode.features import DEPTH_SUFFIX, IMAGE_PREFIX, STATE
from demorec.episode.info import Camera, EpisodeInfo, Feature, Kept, Origin
from demorec.mcap.frame_check import MAX_SUBTASK
from demorec.mcap.video import Rgb, VideoPacket, VideoSettings, make_encoder, settings_of_coded

_SUCCESS, _EPISODE = "next.success", "episode_index"
_TIME_TOLERANCE_S = 1e-4
"""By which LeRobot lets a row's time be off the grid."""
_UNNAMED_ROBOT = "unknown"
_MAX_ELEMENTS, _MAX_REASON = 4096, 10_000
_RECORDED: Mapping[str, Literal["float32", "float64"]] = {
    **dict.fromkeys(("bool", "int8", "uint8", "int16", "uint16", "float16", "float32"), "float32"),
    **dict.fromkeys(("int32", "uint32", "int64", "uint64", "float64"), "float64"),
}
"""Type of a column -> the type that holds all its numbers, of the largest integers only those up to `_EXACT`."""
_EXACT = 2**53
"""Up to which float64 holds every whole number."""
_KNOWN = ("episode_index", "source", "success", "failure_reason", "root_seed", "cameras", "robot_digest")
"""What is taken from the sidecar for a recording; the rest is of simulated episodes alone."""
_NO_PLACE = "imported recordings hold none"
_DONE, _REWARD = "next.done", "next.reward"
_NEXT: Mapping[str, str] = {
    _SUCCESS: "its last value becomes the outcome of the episode",
    _DONE: "an export writes it anew, true in the last row of an episode",
    _REWARD: "imported recordings hold an outcome, and no rewards",
}
"""Columns of LeRobot's environments -> what becomes of them."""


class LeRobotDataset:
    """An opened dataset.

    Attributes:
        root: Its folder.
        info: meta/info.json.
        places: Where its episodes lie, in order.
        features: What its recordings have of numbers.
        keys: Camera, as recordings call it -> feature.
        left_out: What no recording can hold, by its name in the dataset -> why.

    Raises:
        ExportError: There is none, or it is damaged.
        ConfigError: Two cameras would get one name.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self.info = DatasetInfo.load(root)
        self.places = list(episode_places(root, self.info))
        self.features: tuple[Feature, ...] = ()
        self.keys: dict[str, str] = {}
        self.left_out: dict[str, str] = {}
        for name, feature in self.info.features.items():
            if reason := _why_left_out(name, feature):
                self.left_out[name] = reason
            elif feature.dtype in ("video", "image"):
                # "top" for "observation.images.top", "image" for "observation.image".
                camera = name.removeprefix(IMAGE_PREFIX).removeprefix("observation.").replace(".", "_")
                if camera in self.keys:
                    raise ConfigError(f"Two cameras of the dataset would be called {camera!r}: {root}")
                self.keys[camera] = name
            elif name not in AUTOMATIC_FEATURES:
                self.features += (_feature(name, feature),)
        self.left_out |= dict(self._left_out_beside())
        if missing := [name for name in ("timestamp", "task_index") if name not in self.info.features]:
            raise ExportError(f"The dataset has no {', '.join(missing)}: {root}")
        self._cameras: dict[str, Camera] = {}
        self._videos: dict[tuple[str, int], EpisodeVideo] = {}
        self._stored: dict[str, StoredImages] = {}
        self._robots: dict[str, DatasetRobot] = {}

    def __len__(self) -> int:
        return len(self.places)

    def _left_out_beside(self) -> Iterator[tuple[str, str]]:
        """What stands beside the tables, and is not read."""
        if self.language_stream is not None:
            self.left_out.pop(PERSISTENT)
        for place in (BOXES_DIR, "sarm_progress.parquet"):
            if (self.root / place).exists():
                yield place, _NO_PLACE
        if not self.has_one_robot:
            yield f"{SIDECAR_DIR}/robots", "not all episodes have the same robot there, as those of a run have"
        if any(row["root_seed"] is not None for row in self.known.values()):
            yield f"{SIDECAR_DIR}/episodes", "scenes, phases and conditions of success are not read back"

    def leave_out(self, feature: str, reason: str) -> None:
        """Let no recording have a feature; before the first one is asked for."""
        self.features = tuple(found for found in self.features if found.name != feature)
        self.left_out[feature] = reason

    def inexact(self) -> Iterator[str]:
        """Features of whole numbers that float64 cannot hold all of; ExportError when they cannot be read."""
        for feature in self.features:
            if self.info.features[feature.name].dtype in ("int64", "uint64") and not self._is_exact(feature.name):
                yield feature.name

    def _is_exact(self, name: str) -> bool:
        for path in sorted((self.root / "data").glob("*/*.parquet")):
            try:
                for batch in table_batches(path, [name], rows=4096):
                    numbers = column_numbers(batch.column(name))
                    if ((numbers > _EXACT) | (numbers < -_EXACT)).any():
                        return False
            except (ValueError, TypeError, pa.ArrowException) as error:
                raise ExportError(f"The column {name} cannot be read ({in_words(error)}): {path}") from error
        return True

    @cached_property
    def tasks(self) -> list[str]:
        """Instructions."""
        return read_tasks(self.root)

    @cached_property
    def rows(self) -> RowReader:
        """Of the features, of times, tasks and outcomes."""
        names = [*(feature.name for feature in self.features), "timestamp", "task_index"]
        names += [name for name in (_SUCCESS, _EPISODE) if name in self.info.features]
        return RowReader(self.root, replace(self.info, features={name: self.info.features[name] for name in names}))

    @cached_property
    def language_stream(self) -> RowStream | None:
        """The language columns; None in a dataset without them."""
        spoken = {name for name, feature in self.info.features.items() if feature.dtype == "language"}
        return RowStream(self.root, self.info, COLUMNS) if spoken >= set(COLUMNS) else None

    @cached_property
    def known(self) -> Mapping[int, dict[str, Any]]:
        """Episode -> what the sidecar says of it, as far as recordings can hold it; empty without a sidecar."""
        found: dict[int, dict[str, Any]] = {}
        for path in sorted((self.root / SIDECAR_DIR / "episodes").glob("*/*.parquet")):
            schema = open_table(path).schema_arrow
            names = [name for name in _KNOWN if name in schema.names]
            for name in names:
                if schema.field(name).type != EPISODE_SCHEMA.field(name).type:
                    raise ExportError(f"The column {name} of the sidecar is {schema.field(name).type}: {path}")
            for batch in table_batches(path, names):
                for row in batch.to_pylist():
                    found[row["episode_index"]] = {**dict.fromkeys(_KNOWN), **row}
        return found

    @cached_property
    def has_one_robot(self) -> bool:
        """Whether the sidecar describes the same robot for all episodes, or none for any."""
        return len({self.known.get(place.episode_index, {}).get("robot_digest") for place in self.places}) <= 1

    def sidecar_rows(self, table: str, episode_index: int) -> list[dict[str, Any]]:
        """All that a table of the sidecar has of an episode; ExportError when it cannot be read."""
        found: list[dict[str, Any]] = []
        for path in sorted((self.root / SIDECAR_DIR / table).glob("*/*.parquet")):
            for batch in table_batches(path):
                found += batch.filter(pc.equal(batch.column("episode_index"), episode_index)).to_pylist()
        return found

    def camera(self, name: str) -> Camera:
        """A camera, as the head of its first file or image says, for all episodes."""
        if name not in self._cameras:
            self._cameras[name] = self._look_at(name, self.keys[name])
        return self._cameras[name]

    def _look_at(self, name: str, key: str) -> Camera:
        feature, place = self.info.features[key], self.places[0]
        kept: Kept = ""
        if feature.is_depth:
            (height, width), kept = feature.shape[:2], "32FC1"
        elif feature.is_video:
            with opened_video(self.video(key, place).path) as (_, stream):
                kept, width, height = codec_of(stream), stream.codec_context.width, stream.codec_context.height
        else:
            height, width = next(StoredImages(self.root, self.info, key).read(place)).shape[:2]
        return Camera(name=name, width=width, height=height, kept=kept, source=key)

    def robot(self, digest: str) -> DatasetRobot:
        """The arm that episodes call by this digest; ExportError when it cannot be used."""
        if digest not in self._robots:
            self._robots[digest] = read_robot(self.root, digest)
        return self._robots[digest]

    def video(self, key: str, place: EpisodePlace) -> EpisodeVideo:
        """The images of a video feature in an episode."""
        found = self._videos.get((key, place.episode_index))
        if found is None:
            found = self._videos[key, place.episode_index] = EpisodeVideo(self.root, self.info, key, place)
        return found

    def stored_images(self, key: str, place: EpisodePlace, frames: Collection[int] | None = None) -> Iterator[Rgb]:
        """(H, W, 3) uint8 RGB of some frames of an episode, of all by default, of an image feature."""
        if key not in self._stored:
            self._stored[key] = StoredImages(self.root, self.info, key)
        return self._stored[key].read(place, frames)

    def recording(self, number: int) -> DatasetRecording:
        """The episode of a place, counted from 0; one after the other they are read in one pass."""
        return DatasetRecording(self, self.places[number])


class DatasetRecording:
    """One episode of a dataset, with the interface of `demorec.mcap.Recording`; frames are at multiples of 1/fps.

    Attributes:
        path: The dataset's folder.
        dataset, place: Where it lies.
        known: What the sidecar says of it; empty where none is.
        num_frames: T.

    Methods and properties raise ExportError where the files cannot be read.
    """

    def __init__(self, dataset: LeRobotDataset, place: EpisodePlace) -> None:
        self.path, self.dataset, self.place = dataset.root, dataset, place
        self.num_frames = place.length
        self.known: Mapping[str, Any] = dataset.known.get(place.episode_index, {})
        is_depth = {name: dataset.info.features[key].is_depth for name, key in dataset.keys.items()}
        self.cameras = tuple(name for name, depth in is_depth.items() if not depth)
        self.depth_cameras = tuple(name for name, depth in is_depth.items() if depth)

    @cached_property
    def info(self) -> EpisodeInfo:
        """What is known of it; its robot and cameras as the sidecar describes them."""
        robot = self.robot if self.dataset.has_one_robot and self.known.get("robot_digest") is not None else None
        links = set() if robot is None else {robot.model.root, *(joint.child for joint in robot.model.joints)}
        described = {camera["name"]: camera for camera in self.known.get("cameras") or () if camera is not None}
        cameras = [
            # A depth camera of a simulated episode has no entry of its own there.
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
        return info if robot is None else with_robot(info, robot)

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
        """The arm that the sidecar keeps, or one of ours that has joints of these names; None for neither."""
        if (name := self.known.get("robot_digest")) is not None:
            return self.dataset.robot(str(name))
        state = self.dataset.info.features.get(STATE)
        return recognised_robot(state.names) if state is not None and state.names and not self.known else None

    @cached_property
    def outcome(self) -> Outcome:
        """As the sidecar has it, or else as the last row says."""
        success, reason = self.known.get("success"), self.known.get("failure_reason") or ""
        if len(reason) > _MAX_REASON or not reason.isprintable():
            reason = ""
        if not self.known and _SUCCESS in self._rows and self.num_frames:
            success = bool(self._rows[_SUCCESS][-1, 0])
        return Outcome(success=success, num_frames=self.num_frames, failure_reason=reason)

    @property
    def success(self) -> bool | None:
        """How it ended; None where nobody said."""
        return self.outcome.success

    @cached_property
    def _rows(self) -> Mapping[str, NDArray[Any]]:
        rows, info, number = self.dataset.rows.read(self.place), self.dataset.info, self.place.episode_index
        if _EPISODE in rows and (rows[_EPISODE] != number).any():
            raise ExportError(
                f"The rows of episode {number} are those of others, by its place in the table: {self.path}"
            )
        off = np.abs(rows["timestamp"][:, 0].astype(np.float64) - np.arange(self.num_frames) / int(info.fps))
        if len(wrong := np.flatnonzero(~(off <= _TIME_TOLERANCE_S))):
            raise ExportError(
                f"Row {wrong[0]} of episode {number} is at {rows['timestamp'][wrong[0], 0]:.4f} s, which is no "
                f"multiple of 1/{info.fps} s: {self.path}"
            )
        for feature in self.dataset.features:
            found, claimed = rows[feature.name].dtype, info.features[feature.name].dtype
            if self.num_frames and found != claimed:
                raise ExportError(f"The column {feature.name} holds {found}, not {claimed}: {self.path}")
        return rows

    def columns(self) -> Columns:
        """All numbers, one row a frame, each feature in the type that recordings hold it in."""
        return self._columns

    @cached_property
    def _columns(self) -> Columns:
        leads = {name: self._lead(name) for name in self.dataset.keys}
        begin, fps = max(leads.values(), default=0), int(self.dataset.info.fps)
        times = np.array([frame_time_ns(index, fps) for index in range(begin + self.num_frames)], dtype=np.int64)
        features = {item.name: self._rows[item.name].astype(item.dtype) for item in self.dataset.features}
        return Columns(
            time_ns=times[begin:],
            features=features,
            stamps=dict.fromkeys(features, times[begin:]),
            pictures={name: np.arange(lead, lead + self.num_frames) for name, lead in leads.items()},
            picture_stamps={name: times[begin - lead :] for name, lead in leads.items()},
        )

    def _lead(self, camera: str) -> int:
        """How many images of a camera come before the first frame: what that is decoded from."""
        key = self.dataset.keys[camera]
        feature = self.dataset.info.features[key]
        return self.dataset.video(key, self.place).lead if feature.is_video and not feature.is_depth else 0

    def video_settings(self, camera: str) -> VideoSettings:
        """How the images of a camera are encoded; those in rows of tables are given as JPEG."""
        found = self.dataset.camera(camera)
        return settings_of_coded(found.kept or "jpeg", found.width, found.height, int(self.dataset.info.fps))

    def packets(self, camera: str) -> Iterator[VideoPacket]:
        """The encoded images of a camera in order; `frame_index` is their number, by which frames hold them."""
        key, lead, times = self.dataset.keys[camera], self._lead(camera), self.columns().picture_stamps[camera]
        if self.dataset.info.features[key].is_video:
            for frame, data, is_key in self.dataset.video(key, self.place).packets():
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
        """The decoded images of a camera, (H, W, 3) uint8 RGB, in order."""
        key = self.dataset.keys[camera]
        if self.dataset.info.features[key].is_video:
            return self.dataset.video(key, self.place).images(-self._lead(camera))
        return self.dataset.stored_images(key, self.place)

    def images_at(self, camera: str, frames: Sequence[int]) -> Iterator[Rgb]:
        """What some frames, in rising order, show of a camera, (H, W, 3) uint8 RGB."""
        key = self.dataset.keys[camera]
        if self.dataset.info.features[key].is_video:
            return self.dataset.video(key, self.place).images_at(frames)
        return self.dataset.stored_images(key, self.place, frames)

    def distances(self, camera: str) -> Iterator[NDArray[np.float32]]:
        """The images of a depth camera in order, (H, W) float32 metres, 0 where nothing was measured."""
        return self.dataset.video(self.dataset.keys[camera], self.place).distances()

    depth = distances

    @cached_property
    def spoken(self) -> SpokenEpisode:
        """What its language columns hold; nothing in a dataset without them."""
        stream = self.dataset.language_stream
        return SpokenEpisode(persistent=[]) if stream is None else spoken_of(stream.batches(self.place), self.path)

    @cached_property
    def subtasks(self) -> tuple[tuple[int, str], ...]:
        """(frame, what is begun there), in order; empty where nobody said any.

        What else is said, or cannot be held, is noted among what the dataset leaves out.
        """
        texts: dict[int, str] = {}
        for row in self.spoken.persistent:
            text, begin = str(row.get("content")), row.get("timestamp")
            frame = begin * self.dataset.info.fps if isinstance(begin, float) else -1
            if row.get("style") != "subtask" or not 0 <= frame < self.num_frames:
                self.dataset.left_out.setdefault(PERSISTENT, "all but its subtasks")
            elif len(text) > MAX_SUBTASK or not text.isprintable():
                self.dataset.left_out[PERSISTENT] = f"a subtask is no single line of at most {MAX_SUBTASK} characters"
                return ()
            else:
                texts[round(frame)] = text
        return tuple(sorted(texts.items()))

    def boxes(self, camera: str) -> Iterator[tuple[int, ReadBox]]:
        """(frame, box) of what a camera sees, of a dataset with boxes beside it."""
        path = self.path / BOXES_DIR / f"{self.dataset.keys[camera]}.json"
        for item in read_boxes(path) if path.exists() else ():
            if 0 <= (frame := item.index - self.place.from_index) < self.num_frames:
                yield frame, item


def with_robot(info: EpisodeInfo, robot: DatasetRobot) -> EpisodeInfo:
    """The description with an arm, and which of its joints the features move."""
    joints, units = robot.record.joints, robot.record.units

    def fitting(found: Mapping[str, tuple[str, ...]], feature: Feature) -> tuple[str, ...]:
        values = found.get(feature.name, ())
        return values if len(values) == len(feature.names) else ()

    features = tuple(
        replace(feature, joints=fitting(joints, feature), units=fitting(units, feature)) for feature in info.features
    )
    return replace(info, urdf=robot.urdf, features=features)


def _described(camera: Camera, found: Mapping[str, Any] | None, links: set[str]) -> Camera:
    """A camera with what the sidecar says of it."""
    if found is None:
        return camera
    intrinsics, pose = found["intrinsics"], found["mount_from_camera"]
    if intrinsics is not None and len(intrinsics) == 9 and all(map(_is_finite, intrinsics)):
        camera = replace(camera, intrinsics=tuple(intrinsics))
    # A camera that stands in the world of a simulation hangs on no link, and where the arm stands there is not said.
    is_pose = (
        pose is not None and len(pose) == 7 and all(map(_is_finite, pose)) and abs(math.hypot(*pose[3:]) - 1) < 1e-3
    )
    if found["mount"] in links and is_pose:
        placed = Pose(position=np.array(pose[:3]), quat_xyzw=np.array(pose[3:]))
        camera = replace(camera, mount=found["mount"], mount_from_camera=placed)
    return camera


def _is_finite(value: object) -> bool:
    return isinstance(value, float) and math.isfinite(value)


def _why_left_out(name: str, feature: DatasetFeature) -> str:
    """Why a feature is in no recording, "" for one that is."""
    if name in AUTOMATIC_FEATURES:
        return ""
    if name.startswith("next."):
        return _NEXT.get(name, _NO_PLACE)
    if feature.is_depth:
        return _why_no_distances(feature)
    if feature.dtype in ("video", "image"):
        return ""
    if feature.dtype not in _RECORDED:
        return f"it is {feature.dtype}, and recordings of other robots hold numbers"
    if feature.shape[0] > _MAX_ELEMENTS:
        return f"it has {feature.shape[0]:,} numbers a row, and recordings of other robots hold up to {_MAX_ELEMENTS:,}"
    if len(feature.shape) > 1:
        return f"it is an array of {'x'.join(map(str, feature.shape))}, and recordings of other robots hold vectors"
    return ""


def _why_no_distances(feature: DatasetFeature) -> str:
    """Why the distances of a depth feature cannot be read, "" when they can."""
    if not feature.is_video:
        return "its depth is in images, and depth is read from videos"
    try:
        DepthScale.of(feature.info or {})
    except ValueError as error:
        return str(error)
    return ""


def _feature(name: str, feature: DatasetFeature) -> Feature:
    count = int(np.prod(feature.shape))
    names = tuple(name.replace(",", " ") for name in feature.names or ())
    if len(names) != count or len(set(names)) != count or not all(text and text.isprintable() for text in names):
        names = tuple(str(number) for number in range(count))
    return Feature(name=name, dtype=_RECORDED[feature.dtype], names=names, source=name)
