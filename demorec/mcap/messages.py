"""Messages written individually (images, text, latched ones), and decoding of any message by its fields."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from demorec.core.geometry import Array, Pose
from demorec.episode.episode import Event
from demorec.mcap.cdr import decode, encode
from demorec.mcap.ros2 import DEFINITIONS
from demorec.mcap.scan import Block

JOINT_STATE = "sensor_msgs/msg/JointState"
POSE = "geometry_msgs/msg/PoseStamped"
WRENCH = "geometry_msgs/msg/WrenchStamped"
STRING = "std_msgs/msg/String"
BOOL = "std_msgs/msg/Bool"
LOG = "rcl_interfaces/msg/Log"
FLOAT64_ARRAY = "std_msgs/msg/Float64MultiArray"
INT64_ARRAY = "std_msgs/msg/Int64MultiArray"
IMAGE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
PROTOBUF_VIDEO = "foxglove.CompressedVideo"
COMPRESSED_VIDEO = "foxglove_msgs/msg/CompressedVideo"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
LABEL_INFO = "vision_msgs/msg/LabelInfo"

_LOG_LEVELS = {"info": 20, "warning": 30, "error": 40}


def read_string(data: bytes) -> str:
    """Decode the text of a std_msgs/String."""
    text: str = decode(STRING, data)[0]["data"]
    return text


def read_boolean(data: bytes) -> bool:
    """Decode the value of a std_msgs/Bool."""
    return bool(decode(BOOL, data)[0]["data"])


def log(time_ns: int, event: Event) -> bytes:
    """Encode rcl_interfaces/Log, without file, function and line."""
    return encode(LOG, _stamp(time_ns), _LOG_LEVELS[event.level], event.name, event.message, "", "", 0)


def read_log(data: bytes) -> Event:
    """Decode the message of `log`; ValueError for an unknown level."""
    values, _ = decode(LOG, data)
    for level, number in _LOG_LEVELS.items():
        if number == values["level"]:
            return Event(name=values["name"], message=values["msg"], level=level)  # type: ignore[arg-type]
    raise ValueError(f"a log message of level {values['level']}")


def _stamp(time_ns: int) -> tuple[int, int]:
    """Build builtin_interfaces/Time."""
    return divmod(time_ns, 1_000_000_000)


_U32 = struct.Struct("<I")
_head = lru_cache(maxsize=256)(encode)
"""Cached constant beginning of messages that differ only in their timestamp and last field."""


def _stamped(head: bytes, time_ns: int, data: bytes) -> bytes:
    """Complete a message from its constant beginning, which ends with an empty array: insert timestamp and data."""
    return b"".join((head[:4], struct.pack("<II", *_stamp(time_ns)), head[12:-4], _U32.pack(len(data)), data))


def compressed_image(time_ns: int, frame_id: str, image_format: str, data: bytes) -> bytes:
    """Encode sensor_msgs/CompressedImage."""
    return _stamped(_head(COMPRESSED_IMAGE, (_stamp(0), frame_id), image_format, b""), time_ns, data)


def compressed_video(time_ns: int, frame_id: str, video_format: str, data: bytes) -> bytes:
    """Encode foxglove_msgs/CompressedVideo."""
    message = _stamped(_head(COMPRESSED_VIDEO, _stamp(0), frame_id, b""), time_ns, data)
    text = video_format.encode() + b"\x00"
    return message + b"\x00" * (-len(message) % 4) + _U32.pack(len(text)) + text


def image(time_ns: int, frame_id: str, encoding: str, size: tuple[int, int], data: bytes) -> bytes:
    """Encode sensor_msgs/Image of (height, width) pixels in little endian."""
    head = _head(IMAGE, (_stamp(0), frame_id), *size, encoding, False, len(data) // size[0], b"")
    return _stamped(head, time_ns, data)


def _compressed_image_start(data: bytes) -> int:
    """Find the offset of the image in a message; the four bytes before are its length."""
    # Encapsulation (4 bytes) and timestamp (8), then two strings and the octets, each after its length, which starts at
    # a multiple of four.
    position = 12
    for _ in range(2):
        (length,) = _U32.unpack_from(data, position)
        position = (position + 4 + length + 3) & ~3
    return position + 4


def coded_images(block: Block, codec: str) -> Block:
    """Extract the encoded images from the messages of a camera; ValueError if one is not an image."""
    if codec in ("av1", "32FC1"):
        read = read_protobuf_video if codec == "av1" else _read_pixels
        images = [read(message) for message in block.messages()]
        lengths = np.array([len(image) for image in images], dtype=np.int64)
        return replace(block, content=b"".join(images), starts=np.cumsum(lengths) - lengths, lengths=lengths)
    if not len(block):
        return block
    start = _compressed_image_start(next(iter(block.messages())))
    heads = block.heads(start)
    constant = np.ones(start, dtype=np.bool_)
    constant[4:12] = constant[-4:] = False  # timestamp, length of the image
    if not (heads[:, constant] == heads[0, constant]).all():
        raise ValueError("images in different formats")
    lengths = np.ascontiguousarray(heads[:, -4:]).view("<u4").reshape(-1).astype(np.int64)
    if (lengths > block.lengths - start).any():
        raise ValueError("a truncated image")
    return replace(block, starts=block.starts + start, lengths=lengths)


def _read_pixels(data: bytes) -> bytes:
    return bytes(decode(IMAGE, data)[0]["data"])


def protobuf_video(time_ns: int, frame_id: str, video_format: str, data: bytes) -> bytes:
    """Encode foxglove.CompressedVideo in protobuf, the only form of AV1 that Rerun plays from an MCAP file."""
    from foxglove.messages import CompressedVideo, Timestamp

    stamp = Timestamp(sec=time_ns // 1_000_000_000, nsec=time_ns % 1_000_000_000)
    message = CompressedVideo(timestamp=stamp, frame_id=frame_id, data=data, format=video_format)
    return bytes(message.encode())


def read_protobuf_video(data: bytes) -> bytes:
    """Decode the encoded image of a `protobuf_video`."""
    for name, value in protobuf_fields(data):
        if name == "data":
            return value
    raise ValueError("a video message without an image")


_VIDEO_FIELDS = {1: "timestamp", 2: "frame_id", 3: "data", 4: "format"}


def protobuf_fields(data: bytes) -> Iterator[tuple[str, bytes]]:
    """Yield (name, bytes) of the fields of a foxglove.CompressedVideo, all of which are length-delimited."""
    position = 0
    while position < len(data):
        tag, position = _varint(data, position)
        if tag & 7 != 2:
            raise ValueError(f"a video message with a field of wire type {tag & 7}")
        length, position = _varint(data, position)
        if position + length > len(data):
            raise ValueError("a video message that ends within a field")
        yield _VIDEO_FIELDS.get(tag >> 3, f"field {tag >> 3}"), data[position : position + length]
        position += length


def _varint(data: bytes, position: int) -> tuple[int, int]:
    value = shift = 0
    while position < len(data):
        byte = data[position]
        position += 1
        value |= (byte & 127) << shift
        if byte < 128:
            return value, position
        shift += 7
    raise ValueError("a video message that ends within a number")


def camera_info(frame_id: str, size: tuple[int, int], k: Array, distortion: Sequence[float] = (0.0,) * 5) -> bytes:
    """Encode sensor_msgs/CameraInfo of (height, width) pixels and K (3, 3), with plumb bob distortion."""
    projection = np.hstack((k, np.zeros((3, 1))))
    matrices = (matrix.reshape(-1) for matrix in (k, np.eye(3), projection))
    whole_image = (0, 0, 0, 0, False)  # as the region of interest; without binning
    header = (_stamp(0), frame_id)
    return encode(CAMERA_INFO, header, *size, "plumb_bob", distortion, *matrices, 0, 0, whole_image)


def transforms(rows: Sequence[tuple[str, str, Pose]]) -> bytes:
    """Encode tf2_msgs/TFMessage at time 0 from (parent frame, child frame, parent_from_child) each."""
    return encode(
        TRANSFORMS,
        [((_stamp(0), parent), child, (pose.position, pose.quat_xyzw)) for parent, child, pose in rows],
    )


def label_info(labels: Sequence[tuple[int, str]]) -> bytes:
    """Encode vision_msgs/LabelInfo: the meaning of each number in segmentation images."""
    return encode(LABEL_INFO, (_stamp(0), ""), labels, 0.0)


def read_label_info(data: bytes) -> dict[int, str]:
    """Decode the message of `label_info`."""
    return {item["class_id"]: item["class_name"] for item in decode(LABEL_INFO, data)[0]["class_map"]}


def message_fields(schema: str, data: bytes) -> dict[str, Any]:
    """Decode a message to its fields, in order; ValueError unless it is of this type, which recordings use."""
    if schema == PROTOBUF_VIDEO:
        return dict(protobuf_fields(data))
    if schema not in DEFINITIONS:
        raise ValueError(f"recordings have no messages of the type {schema!r}")
    values, num_left = decode(schema, data)
    if num_left:
        raise ValueError(f"a message with {num_left} excess bytes")
    return values
