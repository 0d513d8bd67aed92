"""Layout of an episode that demorec did not simulate: a topic for each feature, images at the camera's own times.

`/frames` lists for each frame the stamps of the features' samples, then the numbers of the cameras' images. Messages of
features are stored with the frame's time; those that begin with a header have the sample's stamp there.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import RecordingError
from demorec.episode.episode import NO_IMAGE, SampledFrame, Table
from demorec.episode.info import EpisodeInfo, Feature
from demorec.mcap import messages
from demorec.mcap.channels import FRAMES, TF
from demorec.mcap.container import Container
from demorec.mcap.streams import (
    ColumnArrays,
    FrameStream,
    TimedMessages,
    array_layout,
    concatenated,
    joint_layout,
    read_columns,
)

if TYPE_CHECKING:
    from demorec.mcap.metadata import CameraStreams
    from demorec.mcap.scan import ScannedMessage


class SampledLayout:
    """Topics of one episode, and what its file holds at which time; methods as of `SimulatedLayout`.

    Attributes:
        frame_topic: Topic whose messages are counted as frames.
        event_topics: Topics of events.
    """

    frame_topic = FRAMES
    event_topics = ()

    def __init__(self, info: EpisodeInfo) -> None:
        self._info = info

    @cached_property
    def streams(self) -> tuple[FrameStream, ...]:
        """Streams that become columns."""
        return (*map(_feature, self._info.features), self._frames)

    def due_ns(self, num_frames: int) -> None:
        """Return None: images are at times of their own."""

    def read(
        self, container: Container, num_frames: int, image_topics: Mapping[str, str]
    ) -> tuple[Table, TimedMessages]:
        """Read the numbers, without events. Raises RecordingError also for a frame that shows an unknown image."""
        columns, _ = read_columns(container, self.streams, frame_topic=self.frame_topic)
        image_stamps = _image_stamps(container, image_topics)
        for name, numbers in columns["images"].items():
            count = len(image_stamps[name])
            if len(numbers) and not NO_IMAGE <= int(numbers.min()) <= int(numbers.max()) < count:
                raise RecordingError(
                    f"A frame holds an image of the camera {name!r} that is none of its {count}: {container.path}"
                )
        return Table(**columns, image_stamps=image_stamps), []

    def whole_frames(
        self, counts: Counter[str], cameras: Mapping[str, CameraStreams]
    ) -> tuple[int, Callable[[ScannedMessage, int], bool]]:
        """Find what a crash left whole; whole frames have their images, which are in front of them."""
        topics = {stream.topic for stream in self.streams}
        num_frames = min(counts[topic] for topic in topics)
        topics.add(TF)
        return num_frames, lambda message, count: message.channel.topic not in topics or count <= num_frames

    @property
    def _frames(self) -> FrameStream:
        """The stream of `/frames`."""
        features = [feature.name for feature in self._info.features]
        cameras = [camera.name for camera in self._info.cameras]

        def rows(frames: Sequence[SampledFrame]) -> NDArray[np.int64]:
            table = [
                [int(frame.samples[name].stamp_ns) for name in features]
                + [int(frame.images.get(name, NO_IMAGE)) for name in cameras]
                for frame in frames
            ]
            return np.array(table, dtype=np.int64)

        def columns(values: NDArray[Any]) -> ColumnArrays:
            stamps, images = np.split(values.T.copy(), [len(features)])
            return {
                "stamps": dict(zip(features, stamps, strict=True)),
                "images": dict(zip(cameras, images, strict=True)),
            }

        laid_out = array_layout(messages.INT64_ARRAY, [*features, *cameras])
        return FrameStream(FRAMES, messages.INT64_ARRAY, laid_out, rows, columns)


def _feature(feature: Feature) -> FrameStream:
    """Stream of a feature: sensor_msgs/JointState for joints, otherwise std_msgs/Float64MultiArray."""
    name = feature.name
    if any(feature.joints):  # velocity and effort are empty: they are not known, and zeros would be invented
        joints = [joint or name for name, joint in zip(feature.names, feature.joints, strict=True)]
        schema, laid_out = messages.JOINT_STATE, joint_layout(joints, only_positions=True)
    else:
        schema, laid_out = messages.FLOAT64_ARRAY, array_layout(messages.FLOAT64_ARRAY, feature.names)
    return FrameStream(
        "/" + name.replace(".", "/"),
        schema,
        laid_out,
        concatenated(lambda frame: (frame.samples[name].vector,)),  # float64 holds every bit of a float32
        lambda values: {"features": {name: values.astype(feature.dtype)}},
        stamp_ns=lambda frame: int(frame.samples[name].stamp_ns),
    )


def _image_stamps(container: Container, topics: Mapping[str, str]) -> dict[str, NDArray[np.int64]]:
    """Camera -> (P,) stamps of its images. One chunk of images is in memory at a time: all may take gigabytes."""
    found = defaultdict[str, list[NDArray[np.int64]]](list)
    for blocks in container.blocks_by_chunk(topics.values()):
        for name, topic in topics.items():
            found[name].append(blocks[topic].time_ns)
    return {name: np.concatenate(times) for name, times in found.items()}
