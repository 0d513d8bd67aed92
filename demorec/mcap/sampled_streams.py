"""Streams of an episode that demorec did not simulate: a topic for each feature.

`/frames` lists for each frame the timestamps of the features' samples, then the numbers of the cameras' images. Feature
messages are stored at the frame's time; those with a header have the sample's timestamp there.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from demorec.episode.episode import NO_IMAGE, SampledFrame
from demorec.episode.info import EpisodeInfo, Feature
from demorec.mcap import messages
from demorec.mcap.channels import FRAMES
from demorec.mcap.streams import (
    ColumnArrays,
    FrameStream,
    array_layout,
    concatenated,
    joint_layout,
)

if TYPE_CHECKING:
    pass


def sampled_streams(info: EpisodeInfo) -> tuple[FrameStream, ...]:
    """List the streams that become columns: one for each feature, then `/frames`."""
    return (*map(_feature, info.features), _frames(info))


def _frames(info: EpisodeInfo) -> FrameStream:
    """Build the stream of `/frames`."""
    features = [feature.name for feature in info.features]
    cameras = [camera.name for camera in info.cameras]

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
    """Build the stream of a feature: sensor_msgs/JointState for joints, otherwise std_msgs/Float64MultiArray."""
    name = feature.name
    if any(feature.joints):  # velocity and effort are empty: they are unknown, and zeros would be invented
        joints = [joint or name for name, joint in zip(feature.names, feature.joints, strict=True)]
        schema, laid_out = messages.JOINT_STATE, joint_layout(joints, only_positions=True)
    else:
        schema, laid_out = messages.FLOAT64_ARRAY, array_layout(messages.FLOAT64_ARRAY, feature.names)
    return FrameStream(
        "/" + name.replace(".", "/"),
        schema,
        laid_out,
        concatenated(lambda frame: (frame.samples[name].vector,)),  # float64 represents every bit of a float32
        lambda values: {"features": {name: values.astype(feature.dtype)}},
        stamp_ns=lambda frame: int(frame.samples[name].stamp_ns),
    )
