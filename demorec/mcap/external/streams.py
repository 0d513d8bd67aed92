"""The streams of a collected episode that have one message a frame: a topic for each feature, and `/frames`.

`/frames` says which sample of every feature and which picture of every camera a frame holds: the features' stamps, then
the cameras' picture numbers. Messages of features are stored with the frame's time; those that begin with a header have
the sample's stamp there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.episode.external import EpisodeInfo, Feature
from demorec.mcap import messages
from demorec.mcap.cdr import Layout, Slot, layout

FRAMES = "/frames"
SUBTASK = "/language/subtask"
"""What is begun at a frame, where somebody said it: std_msgs/String."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FeatureStream:
    """The messages of a feature, one a frame.

    Attributes:
        topic: Where: "/observation/state".
        schema: ROS 2 type.
        layout: Of its messages, which hold D values.
        dtype: Of the feature.
    """

    topic: str
    schema: str
    layout: Layout
    dtype: str

    def encode(self, stamps: Sequence[int], vectors: Sequence[NDArray[Any]]) -> list[bytes]:
        """One message for each sample; float64 holds every bit of a float32."""
        return self.layout.encode(np.array(stamps, dtype=np.int64), np.array(vectors, dtype=np.float64))

    def decode_rows(self, rows: NDArray[np.uint8]) -> NDArray[Any]:
        """(T, D) in the feature's dtype, of T messages; ValueError for messages of another layout."""
        return self.layout.decode_rows(rows).astype(self.dtype)


def feature_streams(info: EpisodeInfo) -> dict[str, FeatureStream]:
    """Feature -> its messages: sensor_msgs/JointState where there are joints, else std_msgs/Float64MultiArray."""
    streams = {}
    for feature in info.features:
        schema = messages.JOINT_STATE if any(feature.joints) else messages.FLOAT64_ARRAY
        streams[feature.name] = FeatureStream(
            topic="/" + feature.name.replace(".", "/"),
            schema=schema,
            layout=_joints_layout(feature) if any(feature.joints) else _array_layout(schema, feature.names),
            dtype=feature.dtype,
        )
    return streams


def frames_layout(info: EpisodeInfo) -> Layout:
    """Of `/frames`: std_msgs/Int64MultiArray, whose label names the columns."""
    columns = [feature.name for feature in info.features] + [camera.name for camera in info.cameras]
    return _array_layout(messages.INT64_ARRAY, columns)


def _joints_layout(feature: Feature) -> Layout:
    """Velocity and effort are empty: they are not known, and zeros would be invented."""
    names = tuple(joint or name for name, joint in zip(feature.names, feature.joints, strict=True))
    return layout(messages.JOINT_STATE, (Slot.TIME, ""), names, (Slot.VALUE,) * len(names), (), ())


def _array_layout(schema: str, columns: Sequence[str]) -> Layout:
    count = len(columns)
    dimension = (",".join(columns), count, count)
    return layout(schema, ((dimension,), 0), (Slot.VALUE,) * count)
