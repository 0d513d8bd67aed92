"""What a bag says about a topic, and a message as it lies there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from demorec.core.errors import DemorecError

MAX_SCHEMA_BYTES = 1 << 20
"""Of a message type's definition; the largest of ROS with all that it refers to have some 30 kB."""

MAX_CHANNELS = 4096
"""Of a bag; large systems have some hundred topics."""
MAX_TIME_NS = 1 << 62
"""Of a message, in the year 2116: the difference of two fits 64 bits."""


class BagError(DemorecError):
    """A bag cannot be read, or does not hold what its mapping says."""


@dataclass(frozen=True, kw_only=True)
class BagChannel:
    """Messages of one topic, type and encoding; a bag may have several channels of a topic.

    Attributes:
        topic: "/joint_states".
        type: "sensor_msgs/msg/JointState", "foxglove.CompressedImage".
        encoding: Of its messages: cdr, ros1, protobuf, json.
        schema_encoding: Of the definition: ros2msg, ros2idl, ros1msg, protobuf, jsonschema; "" for none.
        schema: The definition: data, never code.
    """

    topic: str
    type: str
    encoding: str
    schema_encoding: str
    schema: bytes


class BagMessage(NamedTuple):
    """A message as the bag has it.

    Attributes:
        channel: Of which topic and type it is.
        log_ns: When it was recorded, nanoseconds.
        data: Its bytes.
    """

    channel: BagChannel
    log_ns: int
    data: bytes
