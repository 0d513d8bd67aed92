"""A recording: numbers as columns, images as packets or decoded, and the sequence of its frames."""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, replace
from functools import cached_property
from itertools import islice, repeat
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import RecordingError
from demorec.core.plain import to_json
from demorec.episode.episode import NO_IMAGE, CameraImages, Event, Frame, JointSample, Table, Trajectory
from demorec.episode.info import NOT_SIMULATED
from demorec.episode.protocol import Box, SceneMotion
from demorec.episode.simulated import simulated_table
from demorec.mcap import channels, messages
from demorec.mcap.container import damage_as_recording_error
from demorec.mcap.episode_file import EpisodeFile
from demorec.mcap.episode_layout import TimedMessages
from demorec.mcap.frames import frames_of, pandas_table, pose_of, summary_line
from demorec.mcap.lossless import LabelDecoder, from_labels
from demorec.mcap.scan import Block
from demorec.mcap.transforms import measured_motion
from demorec.mcap.video import Rgb, is_keyframe
from demorec.robots.urdf import check_primitives

if TYPE_CHECKING:
    import pandas as pd


class Recording(EpisodeFile):
    """Context manager over one recording, and the sequence of its frames; one chunk is in memory at a time.

    `for frame in recording` yields numbers and images together; `recording[120]` and `recording[-1]` select a frame;
    `table` and `trajectory` return all numbers at once, which is much faster if images are not needed. Frames exist
    only for simulations: other episodes have just a `table`.

    Attributes:
        path: Path of the file.
        info: Description of the episode.
        outcome: Outcome of the episode; None if a crash cut it off.
        num_frames: Number of frames.
        is_recovered: Whether a crash cut it off.

    Raises:
        RecordingError: Not a recording, cut off, damaged, or of another format version; raised by all methods.
    """

    def table(self) -> Table:
        """Read the features of every frame, and which images the frames show."""
        return self._table

    @cached_property
    def _table(self) -> Table:
        return simulated_table(self._numbers, self.info) if isinstance(self._numbers, Trajectory) else self._numbers

    def trajectory(self) -> Trajectory:
        """Read the simulation, one row per frame, bit-exact.

        Raises:
            RecordingError: demorec did not simulate this episode.
        """
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
            return self._layout.read(self._container, self.num_frames, topics)

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
        images, due_ns = {}, self._layout.due_ns(self.num_frames)
        for camera, topic in topics.items():
            if due_ns is not None and not np.array_equal(found[topic].time_ns, due_ns):
                raise self._wrong_times(topic)
            with damage_as_recording_error(self.path):
                images[camera] = messages.coded_images(found[topic], self.video_settings(camera).codec)
        return images

    def keyframes(self, camera: str) -> NDArray[np.int64]:
        """Find the numbers of a camera's images that are decodable on their own; its images are in memory together."""
        codec = self.video_settings(camera).codec
        return np.flatnonzero([is_keyframe(codec, image) for image in self.coded_images([camera])[camera].messages()])

    def segmentation(self, camera: str) -> Iterator[NDArray[np.int32]]:
        """Yield segmentation images, (H, W) int32 as in `CameraImages`, one per frame; see `segment_names`."""
        if not self.has_segmentation(camera):
            raise RecordingError(f"The recording has no segmentation images of the camera {camera!r}: {self.path}")
        topic, decoder = channels.camera_topic(camera, "segmentation"), LabelDecoder(self._size(camera))
        for _, labels in self._read_images(topic, lambda data: decoder.decode(messages.read_compressed_image(data))):
            yield labels

    def segment_names(self) -> dict[int, str]:
        """Return segmentation value -> name of the body, or ROBOT/LINK; empty if segmentation was not recorded."""
        for _, names in self._read(channels.LABELS, messages.read_label_info):
            values = from_labels(np.array(list(names), dtype=np.uint16)).tolist()
            return dict(zip(values, names.values(), strict=True))
        return {}

    def boxes(self, camera: str) -> Iterator[Box]:
        """Yield nothing: recordings have no boxes."""
        return iter(())

    def _shown(self, camera: str) -> NDArray[np.int64]:
        """Return (T,) number of the camera's image at each frame."""
        self._camera(camera)
        return self._table.images[camera]

    def image(self, camera: str, frame: int) -> Rgb | None:
        """Decode a frame's image, (H, W, 3) uint8 RGB; None if the frame has no image of this camera.

        Decoding starts at the preceding keyframe.

        Raises:
            IndexError: The frame does not exist; negative ones count from the end.
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
        `joint_position.panda_joint1` (rad, fingers m), `base_from_tcp.x` (m), `base_from_tcp.qw`, `wrench.hand.force.z`
        (N) if recorded, `object_poses.red_cube.z` (m, world frame), `phase`. `time_ns` is simulated time since the
        episode's start. An external episode has the timestamps of its frames and its features:
        `observation.state.shoulder`.

        Raises:
            MissingDependencyError: pandas is not installed.
        """
        return pandas_table(self.info, self._numbers)

    def __len__(self) -> int:
        return self.num_frames

    def __iter__(self) -> Iterator[Frame]:
        images = self._images_from(0, {name: self.images(name) for name in self.cameras})
        for frame in frames_of(self.trajectory(), self.events(), self.joint_samples()):
            yield replace(frame, images=next(images))

    def __getitem__(self, index: int) -> Frame:
        frame = self._frames[index]
        first = frame.frame_index
        colors = {name: self.images_at(name, [first]) for name in self.cameras}  # from the preceding keyframe on
        return replace(frame, images=next(self._images_from(first, colors)))

    @cached_property
    def _frames(self) -> list[Frame]:
        """All frames without images, cached at first use."""
        return list(frames_of(self.trajectory(), self.events(), self.joint_samples()))

    def _images_from(self, first: int, colors: Mapping[str, Iterator[Rgb]]) -> Iterator[Mapping[str, CameraImages]]:
        """Yield the decoded images of a frame and of those after it, given the colours from that frame on."""
        nothing: Iterator[None] = repeat(None)
        streams = {
            name: (
                color,
                islice(self.depth(name), first, None) if self.has_depth(name) else nothing,
                islice(self.segmentation(name), first, None) if self.has_segmentation(name) else nothing,
            )
            for name, color in colors.items()
        }
        for index in range(first, self.num_frames):
            yield {
                name: CameraImages(
                    color=next(color),
                    depth=next(depth),
                    segmentation=next(labels),
                    world_from_camera=pose_of(self.trajectory().world_from_camera[name][index]),
                )
                for name, (color, depth, labels) in streams.items()
            }

    def __repr__(self) -> str:
        return f"Recording({str(self.path)!r}: {summary_line(self.info, self.outcome, self.num_frames)})"

    def digest(self) -> str:
        """Compute SHA-256 (hex) of the content: metadata, numbers, phases, events, encoded images.

        File layout and software versions are excluded: two recordings with the same digest contain the same episode,
        bit-exact.
        """
        result, numbers = self._digest_of_description(), self._numbers
        for name, data in _content(numbers):
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
    """Open the recording of an episode simulated by demorec.

    Raises:
        RecordingError: As `Recording`, or it was recorded by another robot or program.
    """
    recording = Recording(path)
    if recording.info.simulation is None:
        recording.close()
        raise RecordingError(f"{NOT_SIMULATED}: {recording.path}")
    return recording
