"""What the readers of all recordings share: an open MCAP file, its topics and its coded pictures."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path
from types import TracebackType
from typing import Self

from demorec.errors import RecordingError
from demorec.recording import messages, metadata
from demorec.recording.channels import camera_topic
from demorec.recording.container import Container, damage_as_recording_error
from demorec.recording.pixels import PixelCounter, PixelStatistics
from demorec.recording.video import Rgb, VideoPacket, VideoSettings, decode


class EpisodeFile(ABC):
    """Context manager over the file of one episode.

    Attributes:
        path: Of the file.
        is_recovered: Whether a crash cut it off.
    """

    is_recovered: bool

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._container = Container(self.path)
        try:
            self._read_metadata()
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the file; harmless when called twice."""
        self._container.close()

    @abstractmethod
    def _read_metadata(self) -> None:
        """Read what is known without reading messages."""

    def _check_end(self, num_frames: int, outcome_frames: int | None) -> None:
        """Note whether it was recovered; RecordingError unless its end is that of so many frames."""
        recovered = self._container.metadata(metadata.RECOVERED)
        if recovered is not None:
            metadata.check_seal(metadata.RECOVERED, recovered)
        self.is_recovered = recovered is not None
        if outcome_frames is None and not self.is_recovered:
            raise RecordingError("The recording was never finished; demorec recover keeps what is whole")
        if outcome_frames is not None and outcome_frames != num_frames:
            raise RecordingError(f"The recording has {num_frames} frames, but its outcome says {outcome_frames}")

    @property
    def topics(self) -> dict[str, tuple[str, int]]:
        """topic -> (type, number of messages), sorted by topic."""
        container = self._container
        return {
            topic: (container.schemas[container.channels[topic].schema_id].name, container.counts[topic])
            for topic in sorted(container.channels)
        }

    @abstractmethod
    def video_settings(self, camera: str) -> VideoSettings:
        """How the pictures of a camera were coded."""

    @abstractmethod
    def packets(self, camera: str) -> Iterator[VideoPacket]:
        """The coded pictures of a camera, in order."""

    def images(self, camera: str) -> Iterator[Rgb]:
        """The decoded pictures of a camera, (H, W, 3) uint8 RGB, in order."""
        return decode(self.video_settings(camera), self.packets(camera))

    def _images(self, camera: str, numbers: Sequence[int]) -> Iterator[Rgb]:
        """Some decoded pictures, read in one pass, each decoded from the keyframe before it on."""
        packets = list(islice(self.packets(camera), max(numbers, default=-1) + 1))
        for number in numbers:
            keyframe = max(index for index, packet in enumerate(packets[: number + 1]) if packet.is_keyframe)
            *_, picture = decode(self.video_settings(camera), packets[keyframe : number + 1])
            yield picture

    def pixel_statistics(self, camera: str) -> PixelStatistics:
        """Histograms of a camera's pictures: as written, or counted now where none were written."""
        self.video_settings(camera)
        for message in self._container.messages((camera_topic(camera, "histogram"),)):
            with damage_as_recording_error(self.path):
                return messages.read_pixel_statistics(message.data)
        counter = PixelCounter()
        for picture in self.images(camera):
            counter.add(picture)
        return counter.statistics()
