"""Reads a recording: numbers as columns, images as packets, one chunk in memory at a time."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import RecordingError
from demorec.core.plain import to_json
from demorec.episode.episode import Event, JointSample, SimulatedColumns, SimulatedInfo, frame_time_ns
from demorec.mcap import channels, messages, metadata
from demorec.mcap.chunks import Block
from demorec.mcap.container import damage_as_recording_error
from demorec.mcap.episode_file import EpisodeFile
from demorec.mcap.lossless import LabelDecoder, decode_depth, from_labels
from demorec.mcap.streams import ColumnArrays, FrameStream, frame_streams, merged_columns
from demorec.mcap.video import Rgb, VideoSettings
from demorec.robots.urdf import check_primitives


class NotSimulatedError(RecordingError):
    """The recording is one of an external episode, which `Recording` reads."""


class RecordingReader(EpisodeFile[metadata.CameraStreams]):
    """What one file holds: numbers as columns, images as packets or decoded, labels; a context manager.

    Attributes:
        path: Of the file.
        info: What was known before the first frame.
        outcome: How the episode ended; None when a crash cut it off (`is_recovered`).
        num_frames: Length.

    Raises:
        RecordingError: No recording, cut off, damaged, or of an unknown format version; so do all methods.
    """

    _record = metadata.EPISODE
    info: SimulatedInfo
    _said: tuple[tuple[int, bytes], ...] | None = None
    """(time_ns, message) of all events, once `columns` has come by them: they lie among the numbers in the file."""
    _packed_labels: Mapping[str, Block] = MappingProxyType({})
    """topic -> segmentation images and the names in them, once `coded_pictures` has come by them."""

    def _other_file(self) -> RecordingError:
        if metadata.EXTERNAL in self._container.metadata_names:
            return NotSimulatedError(
                "This needs an episode that demorec simulated; this one was recorded by another robot or program "
                f"and has no scene: {self.path}"
            )
        return RecordingError(f"The MCAP file is no demorec recording, it has no episode metadata: {self.path}")

    def _read_metadata(self, found: Mapping[str, str]) -> None:
        self.info, self._cameras = metadata.read_episode_metadata(found)
        self._read_end(channels.GRIPPER)
        if self.num_frames and len(self._cameras) != len(self.info.scene.cameras):
            raise RecordingError("The recording has frames, but none of its scene's cameras was recorded")

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the recorded cameras, in the scene's order."""
        return tuple(camera.name for camera in self.info.scene.cameras if camera.name in self._cameras)

    def video_settings(self, camera: str) -> VideoSettings:
        """How the images of a camera were encoded."""
        return self._camera(camera).video

    def has_depth(self, camera: str) -> bool:
        """Whether depth images of a camera were recorded."""
        return self._camera(camera).depth

    def has_segmentation(self, camera: str) -> bool:
        """Whether segmentation images of a camera were recorded."""
        return self._camera(camera).segmentation

    @property
    def simulated(self) -> SimulatedInfo:
        """Its `info`."""
        return self.info

    @property
    def has_failed(self) -> bool:
        """Whether it did not succeed, or a crash cut it off."""
        return self.outcome is None or not self.outcome.success

    def phases(self) -> Sequence[str]:
        """Phase of each frame."""
        return self.columns().phase

    def _frame_times(self) -> NDArray[np.int64]:
        """(T,) `frame_time_ns` of every frame."""
        fps = self.info.fps
        return (np.arange(self.num_frames, dtype=np.int64) * 2_000_000_000 + fps) // (2 * fps)

    def columns(self) -> SimulatedColumns:
        """All numbers, one row a frame, bit-exact as they were written."""
        streams = frame_streams(self.info)
        times = self._frame_times()
        topics = [stream.topic for stream in streams]
        blocks = self._container.blocks((*topics, channels.PHASE, channels.DELIBERATE_MISS, channels.EVENTS))
        said = blocks[channels.EVENTS]
        self._said = tuple(zip(said.time_ns.tolist(), said.messages(), strict=True))
        joint_states = blocks[channels.JOINT_STATES]  # there may be more of these between the frames
        blocks[channels.JOINT_STATES] = joint_states.select(np.isin(joint_states.time_ns, times))
        with damage_as_recording_error(self.path):
            columns = merged_columns(self._columns_of(stream, blocks[stream.topic], times) for stream in streams)
            phases = _held(blocks[channels.PHASE], messages.read_string, times, "")
            misses = _held(blocks[channels.DELIBERATE_MISS], messages.read_boolean, times, False)
        # Before the first frame nobody knows which cameras there are.
        columns["world_from_camera"] = {name: columns["world_from_camera"][name] for name in self.cameras}
        return SimulatedColumns(
            time_ns=times, phase=tuple(phases), is_deliberate_miss=np.array(misses, dtype=np.bool_), **columns
        )

    def _columns_of(self, stream: FrameStream, block: Block, times: NDArray[np.int64]) -> ColumnArrays:
        """The columns of a stream, which must have one message at each of `times` (T,)."""
        if not np.array_equal(block.time_ns, times):
            raise RecordingError(
                f"The recording has {len(block)} messages on {stream.topic} at other times than its "
                f"{len(times)} frames: {self.path}"
            )
        return stream.columns(stream.layout.decode_rows(block.rows(len(stream.layout.constant))))

    def description(self, body: str = "") -> str:
        """URDF of the robot, or of the body of that name: primitives only, complete without any other file."""
        topic = channels.description_topic(body)
        for _, text in self._read(topic, messages.read_string):
            with damage_as_recording_error(self.path):
                check_primitives(text)
            return text
        raise RecordingError(f"The recording has no description on {topic}: {self.path}")

    def joint_samples(self) -> Iterator[JointSample]:
        """Every recorded joint state in order of time: the frames' own and those between them."""
        stream = next(row for row in frame_streams(self.info) if row.topic == channels.JOINT_STATES)
        read = self._read(channels.JOINT_STATES, lambda data: stream.layout.decode([data]).reshape(3, -1))
        for time_ns, (position, velocity, effort) in read:
            yield JointSample(time_ns=time_ns, joint_position=position, joint_velocity=velocity, joint_effort=effort)

    def events(self) -> Iterator[tuple[int, Event]]:
        """(time_ns, event) in order of time; changes of phase are in `columns().phase`."""
        read = ((message.time_ns, message.data) for message in self._container.messages((channels.EVENTS,)))
        for time_ns, data in read if self._said is None else self._said:
            with damage_as_recording_error(self.path):
                event = messages.read_log(data)
            if event.name != channels.PHASE_EVENT:
                yield time_ns, event

    def coded_pictures(self, cameras: Sequence[str]) -> dict[str, Block]:
        """camera -> its encoded images, one a frame, all read in one pass; they are in memory together."""
        codecs = {camera: self.video_settings(camera).codec for camera in cameras}
        topics = {camera: channels.video_topic(camera, codec) for camera, codec in codecs.items()}
        labels = [self._segmentation_topic(camera) for camera in cameras if self.has_segmentation(camera)]
        labels += [channels.LABELS] if labels else []
        found = self._container.blocks((*topics.values(), *labels))
        self._packed_labels = {topic: found[topic] for topic in labels}
        times = self._frame_times()
        pictures = {}
        for camera, topic in topics.items():
            block = found[topic]
            known = block.time_ns[: self.num_frames]
            wrong = np.flatnonzero(known != times[: len(known)])
            if len(wrong) or len(block) > self.num_frames:
                index = int(wrong[0]) if len(wrong) else self.num_frames
                raise RecordingError(
                    f"Image {index} of {topic} is at {block.time_ns[index]} ns, not at its frame's time: {self.path}"
                )
            if len(block) != self.num_frames:
                raise RecordingError(
                    f"The recording has {self.num_frames} frames, but {len(block)} images of camera {camera}: "
                    f"{self.path}"
                )
            with damage_as_recording_error(self.path):
                pictures[camera] = messages.coded_pictures(block, codecs[camera])
        return pictures

    def depth(self, camera: str) -> Iterator[NDArray[np.float32]]:
        """Depth images, (H, W) float32 metres in steps of a millimetre, 0 where nothing was hit, one a frame."""
        if not self.has_depth(camera):
            raise RecordingError(f"The recording has no depth images of the camera {camera!r}: {self.path}")
        topic, size = channels.camera_topic(camera, "depth"), self._size(camera)
        for _, depth in self._pictures(topic, lambda data: decode_depth(messages.read_compressed_image(data), size)):
            yield depth

    def segmentation(self, camera: str) -> Iterator[NDArray[np.int32]]:
        """Segmentation images, (H, W) int32 as in `CameraImages`, one a frame; `segment_names` tells what is what."""
        topic, decoder = self._segmentation_topic(camera), LabelDecoder(self._size(camera))
        for _, labels in self._pictures(topic, lambda data: decoder.decode(messages.read_compressed_image(data))):
            yield labels

    def segmentation_at(
        self, cameras: Sequence[str], frames: Collection[int]
    ) -> Iterator[tuple[str, int, NDArray[np.uint16]]]:
        """(camera, frame, (H, W) labels) of some frames, read in one pass; the other images stay packed.

        Labels are what `segment_labels` tells, less to compute than the values of `segmentation`.

        Those of one camera come in the order of its frames; how those of several cameras alternate is not said.
        """
        topics = {camera: self._segmentation_topic(camera) for camera in cameras}
        decoders = {camera: LabelDecoder(self._size(camera)) for camera in cameras}
        times, counts = self._frame_times(), dict.fromkeys(cameras, 0)
        is_read = self._packed_labels.keys() >= set(topics.values())
        for blocks in [self._packed_labels] if is_read else self._container.blocks_by_chunk(topics.values()):
            for camera, topic in topics.items():
                block, first = blocks[topic], counts[camera]
                counts[camera] += len(block)
                if not np.array_equal(block.time_ns, times[first : counts[camera]]):
                    raise RecordingError(f"Images of {topic} are not at the times of the frames: {self.path}")
                chosen = np.array([index for index in range(len(block)) if first + index in frames], dtype=np.intp)
                for index, message in zip(chosen.tolist(), block.select(chosen).messages(), strict=True):
                    with damage_as_recording_error(self.path):
                        labels = decoders[camera].labels(messages.read_compressed_image(message))
                    yield camera, first + index, labels
        for camera, count in counts.items():
            self._check_num_pictures(topics[camera], count)

    def _segmentation_topic(self, camera: str) -> str:
        if not self.has_segmentation(camera):
            raise RecordingError(f"The recording has no segmentation images of the camera {camera!r}: {self.path}")
        return channels.camera_topic(camera, "segmentation")

    def _size(self, camera: str) -> tuple[int, int]:
        """(height, width) of all images of a camera."""
        settings = self.video_settings(camera)
        return settings.height, settings.width

    def segment_names(self) -> dict[int, str]:
        """Segmentation value -> name of the body, or ROBOT/LINK; empty when no segmentation was recorded."""
        labels = self.segment_labels()
        values = from_labels(np.array(list(labels), dtype=np.uint16)).tolist()
        return dict(zip(values, labels.values(), strict=True))

    def segment_labels(self) -> dict[int, str]:
        """Label in the files -> name, as of `segment_names`."""
        if packed := self._packed_labels.get(channels.LABELS):
            with damage_as_recording_error(self.path):
                return messages.read_label_info(next(packed.messages()))
        for _, names in self._read(channels.LABELS, messages.read_label_info):
            return names
        return {}

    def _pictures[V](self, topic: str, read: Callable[[bytes], V]) -> Iterator[tuple[int, V]]:
        """As `_read`; RecordingError unless there is one image at the time of each frame."""
        count = 0
        for time_ns, picture in self._read(topic, read):
            if count >= self.num_frames or time_ns != frame_time_ns(count, self.info.fps):
                raise RecordingError(
                    f"Image {count} of {topic} is at {time_ns} ns, not at its frame's time: {self.path}"
                )
            yield time_ns, picture
            count += 1
        self._check_num_pictures(topic, count)

    def _check_num_pictures(self, topic: str, count: int) -> None:
        if count != self.num_frames:
            raise RecordingError(
                f"The recording has {self.num_frames} frames, but {count} images on {topic}: {self.path}"
            )

    def image(self, camera: str, frame: int) -> Rgb:
        """The decoded image of one frame, (H, W, 3) uint8 RGB, decoded from the keyframe before it on.

        Raises:
            IndexError: There is no such frame; negative ones count from the end.
        """
        return next(self.images_at(camera, [frame]))

    def num_images(self, camera: str) -> int:
        """How many images there are of a camera: one a frame."""
        self._camera(camera)
        return self.num_frames

    def images_at(self, camera: str, frames: Sequence[int]) -> Iterator[Rgb]:
        """As `image`, of several frames, read in one pass."""
        return self._images(camera, [range(self.num_frames)[frame] for frame in frames])

    def calibration(self, camera: str) -> messages.Calibration:
        """What the calibration message of a camera says, which is what other programs go by."""
        for _, found in self._read(channels.camera_topic(camera, "camera_info"), messages.read_camera_info):
            return found
        raise RecordingError(f"The recording has no calibration of the camera {camera!r}: {self.path}")

    def digest(self) -> str:
        """SHA-256 (hex) of the content: metadata, numbers, phases, events, encoded images.

        Not of how a file lays it out, nor of the versions that wrote it: two recordings of one digest hold bit for bit
        the same episode. A column that the format version does not have is not part of it, so that recordings of
        older versions keep their digests.
        """
        result = self._digest_of_description()
        for name, value in _column_bytes(self.columns()):
            result.update(name.encode() + value)
        for sample in self.joint_samples():
            result.update(sample.time_ns.to_bytes(8, "little"))
            for vector in (sample.joint_position, sample.joint_velocity, sample.joint_effort):
                result.update(vector.tobytes())
        for time_ns, event in self.events():
            result.update(f"{time_ns} {to_json(event)}".encode())
        for camera in self.cameras:
            result.update(camera.encode())
            for packet in self.packets(camera):
                result.update(hashlib.sha256(packet.data).digest())
            for depth in self.depth(camera) if self.has_depth(camera) else ():
                result.update(depth.tobytes())
            for labels in self.segmentation(camera) if self.has_segmentation(camera) else ():
                result.update(labels.tobytes())
        return result.hexdigest()


def _column_bytes(columns: SimulatedColumns) -> Iterator[tuple[str, bytes]]:
    """Name and bytes of every column that was recorded."""
    for field in dataclasses.fields(columns):
        value = getattr(columns, field.name)
        if isinstance(value, Mapping):
            for key in sorted(value):
                yield key if field.name == "sensed" else f"{field.name}/{key}", value[key].tobytes()
        else:
            yield field.name, value.tobytes() if isinstance(value, np.ndarray) else "\n".join(value).encode()


def _held[V](block: Block, read: Callable[[bytes], V], times: NDArray[np.int64], first: V) -> list[V]:
    """The value that holds at each time, given the messages that tell its changes."""
    values = [first, *map(read, block.messages())]
    numbers = np.searchsorted(np.maximum.accumulate(block.time_ns), times, side="right")
    return [values[number] for number in numbers.tolist()]
