"""What the readers of all recordings share: an open MCAP file, its topics and its encoded images."""

from __future__ import annotations

import hashlib
import json
from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import ClassVar

from demorec.core.errors import RecordingError, without_path
from demorec.core.files import Closing
from demorec.core.plain import to_json, to_plain
from demorec.episode.episode import Outcome, SimulatedInfo
from demorec.episode.external import EpisodeInfo
from demorec.mcap import messages, metadata
from demorec.mcap.channels import camera_topic, video_topic
from demorec.mcap.chunks import Block
from demorec.mcap.container import Container, damage_as_recording_error
from demorec.mcap.pictures import PixelCounter, PixelStatistics, read_pixel_statistics
from demorec.mcap.video import Rgb, VideoPacket, VideoSettings, decode, is_keyframe

_READERS = {"av1": messages.read_protobuf_video, "32FC1": messages.read_image}
"""Codec -> what takes a packet out of its message, where that is no CompressedImage."""


class EpisodeFile[C](Closing):
    """Context manager over the file of one episode.

    Attributes:
        path: Of the file.
        info: What was known before the first frame.
        outcome: How the episode ended; None when a crash cut it off.
        num_frames: Length.
        is_recovered: Whether a crash cut it off.
    """

    info: SimulatedInfo | EpisodeInfo
    outcome: Outcome | None
    num_frames: int
    is_recovered: bool
    _record: ClassVar[str]
    """Name of the metadata record that makes the file a recording."""
    _cameras: Mapping[str, C]
    """What is known of each camera."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._container = Container(self.path)
        try:
            found = self._container.metadata(self._record)
            if found is None:
                raise self._other_file()
            try:
                self._read_metadata(found)
            except RecordingError as error:
                raise RecordingError(f"{without_path(error, self.path)}: {self.path}") from error
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the file; harmless when called twice."""
        self._container.close()

    @abstractmethod
    def _other_file(self) -> RecordingError:
        """That the file is no recording of this kind."""

    @abstractmethod
    def _read_metadata(self, found: Mapping[str, str]) -> None:
        """Read what is known without reading the numbers."""

    def _read_end(self, topic: str) -> None:
        """Read how it ended; RecordingError unless its end is that of as many frames as `topic` has messages."""
        outcome, recovered = self._container.metadata(metadata.OUTCOME), self._container.metadata(metadata.RECOVERED)
        self.outcome = None if outcome is None else metadata.read_outcome_metadata(self._record, outcome)
        self.num_frames = self._container.counts.get(topic, 0)
        if recovered is not None:
            metadata.check_seal(metadata.RECOVERED, recovered)
        self.is_recovered = recovered is not None
        if self.outcome is None and not self.is_recovered:
            raise RecordingError("The recording was never finished; demorec recover keeps what is whole")
        if self.outcome is not None and self.outcome.num_frames != self.num_frames:
            raise RecordingError(
                f"The recording has {self.num_frames} frames, but its outcome says {self.outcome.num_frames}"
            )

    def _camera(self, name: str) -> C:
        if name not in self._cameras:
            raise RecordingError(
                f"The recording has no camera {name!r}, its cameras are {', '.join(self._cameras) or 'none'}: "
                f"{self.path}"
            )
        return self._cameras[name]

    def _digest_of_description(self) -> hashlib._Hash:
        """That of the metadata, to go on with: not of what versions wrote them."""
        described = to_plain(self.info)
        del described["versions"], described["format_version"]
        result = hashlib.sha256(json.dumps(described, sort_keys=True).encode())
        result.update(
            b"no outcome"
            if self.outcome is None
            else to_json(metadata.plain_outcome(self._record, self.outcome)).encode()
        )
        return result

    @property
    @abstractmethod
    def simulated(self) -> SimulatedInfo | None:
        """What is known of an episode that demorec simulated: task, seed, scene; None of any other."""

    @property
    @abstractmethod
    def has_failed(self) -> bool:
        """Whether its attempt failed."""

    @property
    def success(self) -> bool | None:
        """How its attempt ended; None where nobody said."""
        return False if self.has_failed else None if self.outcome is None else self.outcome.success

    @abstractmethod
    def phases(self) -> Sequence[str]:
        """Phase of each frame; empty where nobody stated any."""

    @property
    def topics(self) -> dict[str, tuple[str, int]]:
        """topic -> (type, number of messages), sorted by topic."""
        container = self._container
        return {
            topic: (container.schemas[container.channels[topic].schema_id].name, container.counts[topic])
            for topic in sorted(container.channels)
        }

    def _read[V](self, topic: str, read: Callable[[bytes], V]) -> Iterator[tuple[int, V]]:
        """(time_ns, what was read) of the messages of a topic, in order."""
        for message in self._container.messages((topic,)):
            with damage_as_recording_error(self.path):
                found = read(message.data)
            yield message.time_ns, found

    @abstractmethod
    def video_settings(self, camera: str) -> VideoSettings:
        """How the images of a camera were encoded."""

    def packets(self, camera: str) -> Iterator[VideoPacket]:
        """The encoded images of a camera, in order; `frame_index` is their number, by which frames hold them."""
        codec = self.video_settings(camera).codec
        read = _READERS.get(codec, messages.read_compressed_image)
        for number, (time_ns, data) in enumerate(self._pictures(video_topic(camera, codec), read)):
            yield VideoPacket(frame_index=number, time_ns=time_ns, data=data, is_keyframe=is_keyframe(codec, data))

    def _pictures[V](self, topic: str, read: Callable[[bytes], V]) -> Iterator[tuple[int, V]]:
        """As `_read`, of a topic of images."""
        return self._read(topic, read)

    @abstractmethod
    def coded_pictures(self, cameras: Sequence[str]) -> dict[str, Block]:
        """camera -> all its encoded images, in memory together."""

    def images(self, camera: str) -> Iterator[Rgb]:
        """The decoded images of a camera, (H, W, 3) uint8 RGB, in order."""
        return decode(self.video_settings(camera), self.packets(camera))

    @abstractmethod
    def num_images(self, camera: str) -> int:
        """How many images there are of a camera."""

    @abstractmethod
    def images_at(self, camera: str, frames: Sequence[int]) -> Iterator[Rgb]:
        """What some frames, in rising order, show of a camera that has images, (H, W, 3) uint8 RGB; in one pass."""

    def picture(self, camera: str, number: int) -> Rgb:
        """One decoded image of a camera, (H, W, 3) uint8 RGB, by its own number."""
        return next(self._images(camera, [number]))

    def _images(self, camera: str, numbers: Sequence[int]) -> Iterator[Rgb]:
        """Some decoded images, in rising order, each decoded from the keyframe before it on.

        They are read in one pass, with no more in memory than the packets since the last keyframe.
        """
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
        """Histograms of a camera's images: as written, or counted now where none were written."""
        self.video_settings(camera)
        for _, statistics in self._read(camera_topic(camera, "histogram"), read_pixel_statistics):
            return statistics
        counter = PixelCounter()
        for picture in self.images(camera):
            counter.add(picture)
        return counter.statistics()
