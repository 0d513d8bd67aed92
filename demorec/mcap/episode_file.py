"""The file of an episode: its description, topics and images, encoded or decoded."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import RecordingError, without_path
from demorec.core.files import Closing
from demorec.core.plain import to_json
from demorec.episode.info import DEPTH_UNITS, EpisodeInfo
from demorec.episode.simulated import description_of, has_failed
from demorec.episode.validity import find_problems
from demorec.mcap import messages, metadata
from demorec.mcap.channels import camera_topic, description_topic, video_topic
from demorec.mcap.container import Container, damage_as_recording_error
from demorec.mcap.episode_layout import EpisodeLayout
from demorec.mcap.images import PixelCounter, PixelStatistics, read_pixel_statistics
from demorec.mcap.lossless import decode_distances
from demorec.mcap.messages import packet_reader
from demorec.mcap.metadata import CameraStreams
from demorec.mcap.streams import FrameStream
from demorec.mcap.video import Rgb, VideoPacket, VideoSettings, decode, is_keyframe


class EpisodeFile(Closing):
    """Context manager over the file of one episode: a `Recording` without its numbers."""

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
        self._layout = EpisodeLayout(self.info)
        self._read_end()
        if self.num_frames and len(self._cameras) != len(self.info.cameras):
            raise RecordingError("The recording has frames, but no camera of its scene was recorded")
        if urdf_sha256:
            self.info = self._with_urdf(urdf_sha256)

    def _read_end(self) -> None:
        outcome, recovered = self._container.metadata(metadata.OUTCOME), self._container.metadata(metadata.RECOVERED)
        self.outcome = None if outcome is None else metadata.read_outcome_metadata(outcome)
        self.num_frames = self._container.counts.get(self._layout.frame_topic, 0)
        self.is_recovered = recovered is not None
        if recovered is not None:
            metadata.check_seal(metadata.RECOVERED, recovered)
        if self.outcome is None and not self.is_recovered:
            raise RecordingError("The recording was never finished; recover its complete frames with demorec recover")
        if self.outcome is not None and self.outcome.num_frames != self.num_frames:
            raise RecordingError(
                f"The recording has {self.num_frames} frames, but its outcome states {self.outcome.num_frames}"
            )

    @property
    def streams(self) -> tuple[FrameStream, ...]:
        """Streams with one message per frame."""
        return self._layout.streams

    def _with_urdf(self, sha256: str) -> EpisodeInfo:
        urdf = ""
        for _, text in self._read(description_topic(), messages.read_string):
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

    def _digest_of_description(self) -> hashlib._Hash:
        """Digest of the metadata, to be continued; excludes the versions and the CPU that made them."""
        result = hashlib.sha256(json.dumps(description_of(self.info), sort_keys=True).encode())
        result.update(b"no outcome" if self.outcome is None else to_json(self.outcome).encode())
        return result

    @property
    def has_failed(self) -> bool:
        """Whether the outcome is a failure, or a crash cut off a simulated episode."""
        return has_failed(self.info, self.outcome)

    @property
    def success(self) -> bool | None:
        """Success of its attempt; None if unknown."""
        return False if self.has_failed else None if self.outcome is None else self.outcome.success

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
        for number, (time_ns, data) in enumerate(self._read_images(video_topic(camera, codec), packet_reader(codec))):
            yield VideoPacket(frame_index=number, time_ns=time_ns, data=data, is_keyframe=is_keyframe(codec, data))

    def _read_images[V](self, topic: str, read: Callable[[bytes], V]) -> Iterator[tuple[int, V]]:
        """Read as `_read`, for a topic of images; RecordingError unless they are at their due times."""
        due_ns = self._layout.due_ns(self.num_frames)
        due = None if due_ns is None else iter(due_ns)
        for time_ns, image in self._read(topic, read):
            if due is not None and time_ns != next(due, None):
                raise self._wrong_times(topic)
            yield time_ns, image
        if due is not None and next(due, None) is not None:
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
        read = packet_reader(codec)
        images = self._read_images(video_topic(camera, codec), lambda data: decode_distances(codec, read(data), size))
        return (distances for _, distances in images)

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
        """Yield some decoded images, in increasing order, each decoded from the preceding keyframe on.

        They are read in one pass; only the packets since the last keyframe are in memory.
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
        """Return histograms of a camera's images: the recorded ones, or counted now."""
        self.video_settings(camera)
        for _, statistics in self._read(camera_topic(camera, "histogram"), read_pixel_statistics):
            return statistics
        counter = PixelCounter()
        for image in self.images(camera):
            counter.add(image)
        return counter.statistics()
