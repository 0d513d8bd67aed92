"""Reads the recording of an external episode: numbers as columns, images as packets."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import RecordingError
from demorec.episode.external import DEPTH_UNITS, NO_PICTURE, Columns, EpisodeInfo
from demorec.episode.validity import find_problems
from demorec.mcap import messages, metadata
from demorec.mcap.channels import description_topic, video_topic
from demorec.mcap.chunks import Block
from demorec.mcap.container import damage_as_recording_error
from demorec.mcap.episode_file import EpisodeFile
from demorec.mcap.lossless import decode_distances
from demorec.mcap.metadata import EXTERNAL
from demorec.mcap.streams import FRAMES, SUBTASK, feature_streams, frames_layout
from demorec.mcap.video import Rgb, VideoSettings

_TABLE_BYTES = 1 << 20
"""Of chunks whose numbers are taken out together: taking out takes several times as much memory as they have."""


class _Table:
    """The numbers of a topic, while the chunks that hold them are read.

    Args:
        length: Of each message, bytes.
        decode: Of messages as rows of bytes: their numbers.
    """

    def __init__(self, length: int, decode: Callable[[NDArray[np.uint8]], NDArray[Any]]) -> None:
        self._length, self._decode = length, decode
        self._times: list[NDArray[np.int64]] = []
        self._values = [decode(np.empty((0, length), np.uint8))]  # states how many there are in a row

    def add(self, block: Block) -> None:
        """Take messages; ValueError for those of another layout."""
        self._times.append(block.time_ns)
        self._values.append(self._decode(block.rows(self._length)))

    def whole(self) -> tuple[NDArray[np.int64], NDArray[Any]]:
        """(N,) times and (N, D) numbers of all messages."""
        return np.concatenate([np.empty(0, np.int64), *self._times]), np.concatenate(self._values)


class Recording(EpisodeFile[VideoSettings]):
    """What one file holds of an external episode; a context manager.

    Attributes:
        path: Of the file.
        info: What was known before the first frame.
        outcome: How the episode ended; None when a crash cut it off (`is_recovered`).
        num_frames: Length.

    Raises:
        RecordingError: No recording of an external episode, cut off, damaged, or of an unknown format version; so do
            all methods.
    """

    _record = EXTERNAL
    info: EpisodeInfo

    def _other_file(self) -> RecordingError:
        return RecordingError(f"The file holds no external episode: {self.path}")

    def _read_metadata(self, found: Mapping[str, str]) -> None:
        info, self._cameras, urdf_sha256 = metadata.read_external_metadata(found)
        self._read_end(FRAMES)
        self.info = self._with_urdf(info, urdf_sha256)

    def _with_urdf(self, info: EpisodeInfo, sha256: str) -> EpisodeInfo:
        if not sha256:
            return info
        urdf = ""
        for _, text in self._read(description_topic(), messages.read_string):
            urdf = text  # the last one holds
        if metadata.urdf_sha256(urdf) != sha256:
            raise RecordingError("The URDF of the recording is not the one that its metadata tells of")
        described = dataclasses.replace(info, urdf=urdf)
        if wrong := find_problems(described):
            raise RecordingError(f"The URDF of the recording does not fit its metadata ({wrong[0]})")
        return described

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras that see colours."""
        return tuple(camera.name for camera in self.info.cameras if not camera.is_depth)

    @property
    def depth_cameras(self) -> tuple[str, ...]:
        """Names of the cameras that measure distances."""
        return tuple(camera.name for camera in self.info.cameras if camera.is_depth)

    @property
    def _cameras_in_order(self) -> tuple[str, ...]:
        """All of them, as `/frames` has them."""
        return tuple(camera.name for camera in self.info.cameras)

    @property
    def simulated(self) -> None:
        """No simulator of ours made it."""
        return

    @property
    def has_failed(self) -> bool:
        """Whether somebody said so."""
        return self.outcome is not None and self.outcome.success is False

    def phases(self) -> Sequence[str]:
        """Nobody states any."""
        return ()

    def video_settings(self, camera: str) -> VideoSettings:
        """How the images of a camera were encoded."""
        return self._camera(camera)

    def columns(self) -> Columns:
        """All numbers, one row a frame, bit-exact as they were written, and which images the frames hold."""
        return self._columns

    @cached_property
    def _columns(self) -> Columns:
        """Read once: an export and a check look at them from several sides."""
        streams = feature_streams(self.info)
        picture_topics = {camera: self._picture_topic(camera) for camera in self._cameras_in_order}
        layout = frames_layout(self.info)
        tables = {FRAMES: _Table(len(layout.constant), layout.decode_rows)}
        for stream in streams.values():
            tables[stream.topic] = _Table(len(stream.layout.constant), stream.decode_rows)
        with damage_as_recording_error(self.path):
            for blocks in self._container.blocks_by_chunk(tables, num_bytes=_TABLE_BYTES):
                for topic, table in tables.items():
                    table.add(blocks[topic])
        time_ns, rows = tables[FRAMES].whole()
        if len(time_ns) > 1 and int(np.diff(time_ns).min()) <= 0:
            raise RecordingError(f"The frames of the recording are not in the order of their times: {self.path}")
        features = {}
        for name, stream in streams.items():
            times, features[name] = tables.pop(stream.topic).whole()
            if not np.array_equal(times, time_ns):
                raise RecordingError(
                    f"The recording has {len(times)} messages on {stream.topic} at other times than its "
                    f"{len(time_ns)} frames: {self.path}"
                )
        stamps = {name: rows[:, index].copy() for index, name in enumerate(streams)}
        pictures = {name: rows[:, len(streams) + index].copy() for index, name in enumerate(self._cameras_in_order)}
        picture_stamps = {name: self._stamps(topic) for name, topic in picture_topics.items()}
        for name, numbers in pictures.items():
            count = len(picture_stamps[name])
            if len(numbers) and not NO_PICTURE <= int(numbers.min()) <= int(numbers.max()) < count:
                raise RecordingError(
                    f"A frame holds an image of the camera {name!r} that is none of its {count}: {self.path}"
                )
        return Columns(
            time_ns=time_ns, features=features, stamps=stamps, pictures=pictures, picture_stamps=picture_stamps
        )

    @cached_property
    def subtasks(self) -> tuple[tuple[int, str], ...]:
        """(frame, what is begun there), in order; empty where nobody said any."""
        found = []
        for time_ns, text in self._read(SUBTASK, messages.read_string):
            frame = int(np.searchsorted(self._columns.time_ns, time_ns))
            if frame == self.num_frames or self._columns.time_ns[frame] != time_ns:
                raise RecordingError(f"A subtask of the recording begins where no frame is: {self.path}")
            found.append((frame, text))
        return tuple(found)

    def _stamps(self, topic: str) -> NDArray[np.int64]:
        """(N,) of the messages of a topic, one chunk of them in memory at a time: images may take gigabytes."""
        return np.fromiter((message.time_ns for message in self._container.messages((topic,))), dtype=np.int64)

    def _picture_topic(self, camera: str) -> str:
        return video_topic(camera, self.video_settings(camera).codec)

    def images(self, camera: str) -> Iterator[Rgb]:
        """The decoded images of a camera, (H, W, 3) uint8 RGB, in order; RecordingError for a depth camera."""
        if camera in self.depth_cameras:
            raise RecordingError(f"The camera {camera!r} measures distances and sees no colours: {self.path}")
        return super().images(camera)

    def distances(self, camera: str) -> Iterator[NDArray[np.uint16] | NDArray[np.float32]]:
        """The images of a depth camera in order, as they came: (H, W) uint16 millimetres or float32 metres."""
        if camera not in self.depth_cameras:
            raise RecordingError(f"The recording has no depth camera {camera!r}: {self.path}")
        settings = self.video_settings(camera)
        for packet in self.packets(camera):
            with damage_as_recording_error(self.path):
                yield decode_distances(settings.codec, packet.data, (settings.height, settings.width))

    def depth(self, camera: str) -> Iterator[NDArray[np.float32]]:
        """The same in metres, (H, W) float32."""
        unit = np.float32(DEPTH_UNITS[self.video_settings(camera).codec])
        for values in self.distances(camera):
            yield values.astype(np.float32) / unit

    def coded_pictures(self, cameras: Sequence[str]) -> dict[str, Block]:
        """camera -> all its encoded images, in memory together."""
        topics = {camera: self._picture_topic(camera) for camera in cameras}
        blocks = self._container.blocks(tuple(topics.values()))
        with damage_as_recording_error(self.path):
            return {
                camera: messages.coded_pictures(blocks[topic], self.video_settings(camera).codec)
                for camera, topic in topics.items()
            }

    def image(self, camera: str, frame: int) -> Rgb | None:
        """The decoded image that a frame holds, (H, W, 3) uint8 RGB; None where it has none of this camera.

        Raises:
            IndexError: There is no such frame; negative ones count from the end.
        """
        number = int(self.columns().pictures[camera][range(self.num_frames)[frame]])
        return None if number == NO_PICTURE else self.picture(camera, number)

    def num_images(self, camera: str) -> int:
        """How many images there are of a camera."""
        return len(self.columns().picture_stamps[camera])

    def images_at(self, camera: str, frames: Sequence[int]) -> Iterator[Rgb]:
        """What some frames show of a camera; one without an image shows the last before it, or else the first."""
        held = np.maximum(np.maximum.accumulate(self.columns().pictures[camera]), 0)
        return self._images(camera, held[list(frames)].tolist())

    def digest(self) -> str:
        """SHA-256 (hex) of the content: metadata, numbers, stamps, encoded images; not of what versions wrote it."""
        result = self._digest_of_description()
        columns = self.columns()
        result.update(columns.time_ns.tobytes())
        for mapping in (columns.features, columns.stamps, columns.pictures, columns.picture_stamps):
            for name in sorted(mapping):
                result.update(name.encode() + mapping[name].tobytes())
        for frame, text in self.subtasks:
            result.update(f"subtask {frame} {text}".encode())
        for camera in self._cameras_in_order:
            for packet in self.packets(camera):
                result.update(hashlib.sha256(packet.data).digest())
        return result.hexdigest()
