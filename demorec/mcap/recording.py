"""A recording: numbers as columns, images as packets or decoded, and its frames."""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import fields, replace
from functools import cached_property
from itertools import repeat
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import RecordingError, without_path
from demorec.core.files import Closing
from demorec.core.plain import to_json, to_plain
from demorec.episode.episode import NO_IMAGE, CameraImages, Event, Frame, JointSample, Table, Trajectory
from demorec.episode.info import DEPTH_UNITS, NOT_SIMULATED, EpisodeInfo
from demorec.episode.protocol import SceneMotion
from demorec.episode.simulated import simulated_table
from demorec.episode.validity import find_problems
from demorec.mcap import channels, messages, metadata
from demorec.mcap.columns import TimedMessages, read_columns
from demorec.mcap.container import Container, damage_as_recording_error
from demorec.mcap.frames import frames_of, pandas_table, pose_of
from demorec.mcap.images import PixelCounter, PixelStatistics, read_pixel_statistics
from demorec.mcap.lossless import LabelDecoder, decode_distances, from_labels
from demorec.mcap.metadata import CameraStreams
from demorec.mcap.scan import Block
from demorec.mcap.streams import frame_streams, frame_times, frame_topic
from demorec.mcap.transforms import measured_motion
from demorec.mcap.video import Rgb, VideoPacket, VideoSettings, decode, is_keyframe
from demorec.robots.urdf import check_primitives

if TYPE_CHECKING:
    import pandas as pd


class Recording(Closing):
    """Context manager over one recording; one chunk is in memory at a time.

    `for frame in recording` yields numbers and images together; `table` and `trajectory` return all numbers at once,
    which is much faster if images are not needed. Frames exist only for simulations: other episodes have just a
    `table`.

    Attributes:
        path: Path of the file.
        info: Description of the episode.
        outcome: Outcome of the episode; None if a crash cut it off.
        streams: Streams with one message per frame.
        num_frames: Number of frames.
        is_recovered: Whether a crash cut it off.

    Raises:
        RecordingError: Not a recording, cut off, damaged, or of another format version; raised by all methods.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._container = Container(self.path)
        try:
            self._read_metadata()
        except BaseException as error:
            self.close()
            if isinstance(error, RecordingError):
                raise RecordingError(f"{without_path(error, self.path)}: {self.path}") from error
            raise

    def close(self) -> None:
        """Close the file; safe to call twice."""
        self._container.close()

    def _read_metadata(self) -> None:
        """Read everything that is known without reading the numbers."""
        found = self._container.metadata(metadata.EPISODE)
        if found is None:
            raise RecordingError("The MCAP file is not a demorec recording, since it lacks episode metadata")
        self.info, cameras, urdf_sha256 = metadata.read_episode_metadata(found)
        self._cameras = {camera.name: cameras[camera.name] for camera in self.info.cameras if camera.name in cameras}
        self.streams = frame_streams(self.info)
        self._read_end()
        if self.num_frames and len(self._cameras) != len(self.info.cameras):
            raise RecordingError("The recording has frames, but no camera of its scene was recorded")
        if urdf_sha256:
            self.info = self._with_urdf(urdf_sha256)

    def _read_end(self) -> None:
        outcome, recovered = self._container.metadata(metadata.OUTCOME), self._container.metadata(metadata.RECOVERED)
        self.outcome = None if outcome is None else metadata.read_outcome_metadata(outcome)
        self.num_frames = self._container.counts.get(frame_topic(self.info), 0)
        self.is_recovered = recovered is not None
        if recovered is not None:
            metadata.check_seal(metadata.RECOVERED, recovered)
        if self.outcome is None and not self.is_recovered:
            raise RecordingError("The recording was never finished; recover its complete frames with demorec recover")
        if self.outcome is not None and self.outcome.num_frames != self.num_frames:
            raise RecordingError(
                f"The recording has {self.num_frames} frames, but its outcome states {self.outcome.num_frames}"
            )

    def _with_urdf(self, sha256: str) -> EpisodeInfo:
        urdf = ""
        for _, text in self._read(channels.description_topic(), messages.read_string):
            urdf = text  # the last one applies
        if metadata.urdf_sha256(urdf) != sha256:
            raise RecordingError("The URDF of the recording is not the one in its metadata")
        described = replace(self.info, urdf=urdf)
        if wrong := find_problems(described):
            raise RecordingError(f"The URDF of the recording does not fit its metadata ({wrong[0]})")
        return described

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the recorded colour cameras."""
        return tuple(name for name, streams in self._cameras.items() if streams.video.codec not in DEPTH_UNITS)

    @property
    def depth_cameras(self) -> tuple[str, ...]:
        """Names of the recorded cameras that measure distances, with or without colour."""
        return tuple(name for name, streams in self._cameras.items() if streams.depth)

    def _camera(self, name: str) -> CameraStreams:
        if name not in self._cameras:
            raise RecordingError(
                f"The recording has no camera {name!r}; its cameras are {', '.join(self._cameras) or 'none'}: "
                f"{self.path}"
            )
        return self._cameras[name]

    def video_settings(self, camera: str) -> VideoSettings:
        """Return the encoding settings of a camera's images."""
        return self._camera(camera).video

    def has_depth(self, camera: str) -> bool:
        """Check whether distances were recorded for a camera, with or without colour."""
        return self._camera(camera).depth

    def has_segmentation(self, camera: str) -> bool:
        """Check whether segmentation images were recorded for a camera."""
        return self._camera(camera).segmentation

    def _size(self, camera: str) -> tuple[int, int]:
        settings = self.video_settings(camera)
        return settings.height, settings.width

    @property
    def success(self) -> bool | None:
        """Success of its attempt; None if unknown, False for a simulation that a crash cut off."""
        if self.outcome is None:
            return None if self.info.simulation is None else False
        return self.outcome.success

    @property
    def topics(self) -> dict[str, tuple[str, int]]:
        """topic -> (type, number of messages), sorted by topic."""
        container = self._container
        return {
            topic: (container.schemas[container.channels[topic].schema_id].name, container.counts[topic])
            for topic in sorted(container.channels)
        }

    def _read[V](self, topic: str, read: Callable[[bytes], V]) -> Iterator[tuple[int, V]]:
        """Yield (time_ns, value) of the messages of a topic, in order."""
        with damage_as_recording_error(self.path):
            for _, time_ns, data in self._container.messages((topic,)):
                yield time_ns, read(data)

    def packets(self, camera: str) -> Iterator[VideoPacket]:
        """Yield the encoded images of a camera, in order; `frame_index` is the image number that frames refer to."""
        codec = self.video_settings(camera).codec
        images = self._read_images(self._image_topic(camera), codec)
        for number, (time_ns, data) in enumerate(images):
            yield VideoPacket(frame_index=number, time_ns=time_ns, data=data, is_keyframe=is_keyframe(codec, data))

    def _due_ns(self) -> NDArray[np.int64] | None:
        """Compute (T,) due times of all images of a simulation; elsewhere the cameras decide."""
        return None if self.info.simulation is None else frame_times(self.num_frames, self.info.fps)

    def _read_images(self, topic: str, codec: str = "png") -> Iterator[tuple[int, bytes]]:
        """Yield (time_ns, encoded image) of a topic of images; RecordingError unless they are at their due times."""
        due_ns, count = self._due_ns(), 0
        with damage_as_recording_error(self.path):
            for blocks in self._container.blocks_by_chunk((topic,)):
                block = messages.coded_images(blocks[topic], codec)
                if due_ns is not None and not np.array_equal(block.time_ns, due_ns[count : count + len(block)]):
                    raise self._wrong_times(topic)
                count += len(block)
                yield from zip(block.time_ns.tolist(), block.messages(), strict=True)
        if due_ns is not None and count != len(due_ns):
            raise self._wrong_times(topic)

    def _wrong_times(self, topic: str) -> RecordingError:
        return RecordingError(f"The recording's images on {topic} do not match the times of the frames: {self.path}")

    def images(self, camera: str) -> Iterator[Rgb]:
        """Yield the decoded images of a camera, (H, W, 3) uint8 RGB, in order; RecordingError for a depth camera."""
        if self.video_settings(camera).codec in DEPTH_UNITS:
            raise RecordingError(f"The camera {camera!r} measures distances, not colours: {self.path}")
        return decode(self.video_settings(camera), self.packets(camera))

    def distances(self, camera: str) -> Iterator[NDArray[np.uint16] | NDArray[np.float32]]:
        """Yield distances in order, as recorded: (H, W) uint16 millimetres or float32 metres."""
        codec, size = self._distance_codec(camera), self._size(camera)
        with damage_as_recording_error(self.path):
            for _, data in self._read_images(channels.video_topic(camera, codec), codec):
                yield decode_distances(codec, data, size)

    def depth(self, camera: str) -> Iterator[NDArray[np.float32]]:
        """Yield distances in metres, (H, W) float32; in simulations in steps of a millimetre, 0 for the background."""
        unit = np.float32(DEPTH_UNITS[self._distance_codec(camera)])
        for values in self.distances(camera):
            yield values.astype(np.float32) / unit

    def _distance_codec(self, camera: str) -> str:
        if not self.has_depth(camera):
            raise RecordingError(f"The recording has no depth images of the camera {camera!r}: {self.path}")
        codec = self.video_settings(camera).codec
        return codec if codec in DEPTH_UNITS else "16UC1"

    def numbered_image(self, camera: str, number: int) -> Rgb:
        """Decode one image of a camera, (H, W, 3) uint8 RGB, by its number."""
        return next(self._images(camera, [number]))

    def _images(self, camera: str, numbers: Sequence[int]) -> Iterator[Rgb]:
        """Yield some decoded images, in increasing order, in one pass, each decoded from the keyframe before it."""
        waiting, group = list(numbers), list[VideoPacket]()
        for number, packet in enumerate(self.packets(camera)):
            if not waiting:
                return
            if packet.is_keyframe:
                group.clear()
            group.append(packet)
            if number == waiting[0]:
                *_, image = decode(self.video_settings(camera), group)
                while waiting and waiting[0] == number:
                    yield image
                    waiting.pop(0)

    def pixel_statistics(self, camera: str) -> PixelStatistics:
        """Return histograms of a camera's images: the recorded ones, or counted now."""
        self.video_settings(camera)
        for _, statistics in self._read(channels.camera_topic(camera, "histogram"), read_pixel_statistics):
            return statistics
        counter = PixelCounter()
        for image in self.images(camera):
            counter.add(image)
        return counter.statistics()

    def table(self) -> Table:
        """Read the features of every frame, and which images the frames show."""
        return self._table

    @cached_property
    def _table(self) -> Table:
        return simulated_table(self._numbers, self.info) if isinstance(self._numbers, Trajectory) else self._numbers

    def trajectory(self) -> Trajectory:
        """Read the simulation, one row per frame, bit-exact; RecordingError for any other episode."""
        if not isinstance(self._numbers, Trajectory):
            raise RecordingError(f"{NOT_SIMULATED}: {self.path}")
        return self._numbers

    @property
    def time_ns(self) -> NDArray[np.int64]:
        """(T,) timestamps of the frames."""
        return self._numbers.time_ns

    @property
    def phases(self) -> tuple[str, ...]:
        """T phases of the motion; empty if unknown."""
        return self._numbers.phase if isinstance(self._numbers, Trajectory) else ()

    @property
    def _numbers(self) -> Table | Trajectory:
        return self._numbers_and_events[0]

    @cached_property
    def _numbers_and_events(self) -> tuple[Table | Trajectory, TimedMessages]:
        topics = {name: self._image_topic(name) for name in self._cameras}
        with damage_as_recording_error(self.path):
            return read_columns(self._container, self.info, self.streams, self._due_ns(), topics)

    @cached_property
    def subtasks(self) -> tuple[tuple[int, str], ...]:
        """(frame, subtask that begins there), in order; empty if the source has none."""
        found = []
        for time_ns, text in self._read(channels.SUBTASK, messages.read_string):
            frame = int(np.searchsorted(self.time_ns, time_ns))
            if frame == self.num_frames or self.time_ns[frame] != time_ns:
                raise RecordingError(f"A subtask of the recording begins between frames: {self.path}")
            found.append((frame, text))
        return tuple(found)

    def _image_topic(self, camera: str) -> str:
        return channels.video_topic(camera, self.video_settings(camera).codec)

    def motion(self) -> SceneMotion:
        """Read the motion of the robot, and of a simulated scene."""
        if not isinstance(self._numbers, Trajectory):
            return measured_motion(self.info, self._numbers)
        trajectory = self._numbers
        return SceneMotion(
            joint_position=dict(zip(self.info.simulated.robot.joint_names, trajectory.joint_position.T, strict=True)),
            base_from_tcp=trajectory.base_from_tcp,
            object_poses=trajectory.object_poses,
            world_from_camera=trajectory.world_from_camera,
        )

    def description(self, body: str = "") -> str:
        """Return the URDF of the robot, or of a body: primitives only, complete without other files; "" if unknown."""
        for _, text in self._read(channels.description_topic(body), messages.read_string):
            with damage_as_recording_error(self.path):
                check_primitives(text)
            return text
        return ""

    def joint_samples(self) -> Iterator[JointSample]:
        """Yield every recorded joint state of a simulation in order of time: at and between the frames."""
        for stream in self.streams:
            if stream.is_dense:
                for blocks in self._container.blocks_by_chunk((stream.topic,)):
                    block = blocks[stream.topic]
                    with damage_as_recording_error(self.path):
                        states = np.split(stream.layout.decode(block.rows(len(stream.layout.constant))), 3, axis=1)
                    for time_ns, position, velocity, effort in zip(block.time_ns.tolist(), *states, strict=True):
                        yield JointSample(
                            time_ns=time_ns, joint_position=position, joint_velocity=velocity, joint_effort=effort
                        )

    def events(self) -> Iterator[tuple[int, Event]]:
        """Yield (time_ns, event) in order of time; phase changes are in `phases`."""
        for time_ns, data in self._numbers_and_events[1]:
            with damage_as_recording_error(self.path):
                event = messages.read_log(data)
            if event.name != channels.PHASE_EVENT:
                yield time_ns, event

    def coded_images(self, cameras: Sequence[str]) -> dict[str, Block]:
        """Read camera -> all its encoded images in one pass; they are in memory together."""
        topics = {camera: self._image_topic(camera) for camera in cameras}
        (found,) = self._container.blocks_by_chunk(tuple(topics.values()), num_bytes=sys.maxsize)
        images, due_ns = {}, self._due_ns()
        for camera, topic in topics.items():
            if due_ns is not None and not np.array_equal(found[topic].time_ns, due_ns):
                raise self._wrong_times(topic)
            with damage_as_recording_error(self.path):
                images[camera] = messages.coded_images(found[topic], self.video_settings(camera).codec)
        return images

    def segmentation(self, camera: str) -> Iterator[NDArray[np.int32]]:
        """Yield segmentation images, (H, W) int32 as in `CameraImages`, one per frame; see `segment_names`."""
        if not self.has_segmentation(camera):
            raise RecordingError(f"The recording has no segmentation images of the camera {camera!r}: {self.path}")
        topic, decoder = channels.camera_topic(camera, "segmentation"), LabelDecoder(self._size(camera))
        with damage_as_recording_error(self.path):
            for _, data in self._read_images(topic):
                yield decoder.decode(data)

    def segment_names(self) -> dict[int, str]:
        """Return segmentation value -> name of the body, or ROBOT/LINK; empty if segmentation was not recorded."""
        for _, names in self._read(channels.LABELS, messages.read_label_info):
            values = from_labels(np.array(list(names), dtype=np.uint16)).tolist()
            return dict(zip(values, names.values(), strict=True))
        return {}

    def _shown(self, camera: str) -> NDArray[np.int64]:
        """Return (T,) number of the camera's image at each frame."""
        self._camera(camera)
        return self._table.images[camera]

    def image(self, camera: str, frame: int) -> Rgb | None:
        """Decode a frame's image, (H, W, 3) uint8 RGB; None if the frame has no image of this camera.

        Negative frames count from the end; IndexError if there is no such frame.
        """
        number = int(self._shown(camera)[range(self.num_frames)[frame]])
        return None if number == NO_IMAGE else self.numbered_image(camera, number)

    def num_images(self, camera: str) -> int:
        """Return the number of a camera's images."""
        return self._container.counts.get(self._image_topic(camera), 0)

    def images_at(self, camera: str, frames: Sequence[int]) -> Iterator[Rgb]:
        """Yield the images of a camera at some frames, in increasing order, (H, W, 3) uint8 RGB; in one pass.

        A frame without an image shows the last one before it, or else the first.
        """
        held = np.maximum(np.maximum.accumulate(self._shown(camera)), 0)
        return self._images(camera, held[list(frames)].tolist())

    def to_pandas(self) -> pd.DataFrame:
        """Convert all numbers to a table, one row per frame, bit-exact float64; the index is `frame_index`.

        Columns are named as in `demorec.episode.episode.Trajectory`, vectors with their component:
        `joint_position.panda_joint1` (rad, fingers m), `base_from_tcp.x` (m), `wrench.hand.force.z` (N),
        `object_poses.red_cube.z` (m, world frame). An external episode has the timestamps of its frames and its
        features: `observation.state.shoulder`. MissingDependencyError without pandas.
        """
        return pandas_table(self.info, self._numbers)

    def __len__(self) -> int:
        return self.num_frames

    def __iter__(self) -> Iterator[Frame]:
        cameras = {name: self._images_of(name) for name in self.cameras}
        for frame in frames_of(self.trajectory(), self.events(), self.joint_samples()):
            yield replace(frame, images={name: next(images) for name, images in cameras.items()})

    def _images_of(self, camera: str) -> Iterator[CameraImages]:
        """Yield the decoded images of a camera, frame by frame."""
        nothing: Iterator[None] = repeat(None)
        depth = self.depth(camera) if self.has_depth(camera) else nothing
        labels = self.segmentation(camera) if self.has_segmentation(camera) else nothing
        for color, pose in zip(self.images(camera), self.trajectory().world_from_camera[camera], strict=True):
            yield CameraImages(
                color=color, depth=next(depth), segmentation=next(labels), world_from_camera=pose_of(pose)
            )

    def digest(self) -> str:
        """Compute SHA-256 (hex) of the content: metadata, numbers, phases, events, encoded images.

        File layout and software versions are excluded: two recordings with the same digest contain the same episode,
        bit-exact.
        """
        plain = to_plain(self.info)
        del plain["versions"]
        (plain["simulation"] or {}).pop("cpu", None)
        result = hashlib.sha256(json.dumps(plain, sort_keys=True).encode())
        result.update(b"no outcome" if self.outcome is None else to_json(self.outcome).encode())
        for name, data in _content(self._numbers):
            result.update(name.encode() + data)
        for frame, text in self.subtasks:
            result.update(f"subtask {frame} {text}".encode())
        for sample in self.joint_samples():
            result.update(sample.time_ns.to_bytes(8, "little"))
            for vector in (sample.joint_position, sample.joint_velocity, sample.joint_effort):
                result.update(vector.tobytes())
        for time_ns, event in self.events():
            result.update(f"{time_ns} {to_json(event)}".encode())
        for name, streams in self._cameras.items():
            result.update(name.encode())
            for packet in self.packets(name):
                result.update(hashlib.sha256(packet.data).digest())
            for depth in self.depth(name) if streams.depth and name in self.cameras else ():
                result.update(depth.tobytes())
            for labels in self.segmentation(name) if streams.segmentation else ():
                result.update(labels.tobytes())
        return result.hexdigest()


def _content(numbers: Table | Trajectory) -> Iterator[tuple[str, bytes]]:
    """Yield name and bytes of every array."""
    for field in fields(numbers):
        value = getattr(numbers, field.name)
        if isinstance(value, Mapping):
            for key in sorted(value):
                yield f"{field.name}/{key}", value[key].tobytes()
        else:
            yield field.name, value.tobytes() if isinstance(value, np.ndarray) else "\n".join(value).encode()


def open_recording(path: str | Path) -> Recording:
    """Open a recording; raises as `Recording`."""
    return Recording(path)


def open_simulated(path: str | Path) -> Recording:
    """Open the recording of an episode that demorec simulated; RecordingError for any other."""
    recording = Recording(path)
    if recording.info.simulation is None:
        recording.close()
        raise RecordingError(f"{NOT_SIMULATED}: {recording.path}")
    return recording
