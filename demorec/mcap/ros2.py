"""The ROS 2 message definitions of recordings, as text: a recording is self-describing without ROS.

Source: common_interfaces, rcl_interfaces, geometry2, vision_msgs and foxglove_msgs (field names and order are the
format).
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import cache
from typing import NamedTuple


def _definition(fields: str, *dependencies: str) -> str:
    return ("=" * 80 + "\n").join((fields, *dependencies))


_TIME = "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
_HEADER = _definition("MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n", _TIME)
_VECTOR3 = "MSG: geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n"
_QUATERNION = "MSG: geometry_msgs/Quaternion\nfloat64 x\nfloat64 y\nfloat64 z\nfloat64 w\n"
_POINT = "MSG: geometry_msgs/Point\nfloat64 x\nfloat64 y\nfloat64 z\n"
_POSE = "MSG: geometry_msgs/Pose\ngeometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n"
_WRENCH = "MSG: geometry_msgs/Wrench\ngeometry_msgs/Vector3 force\ngeometry_msgs/Vector3 torque\n"
_TRANSFORM = "MSG: geometry_msgs/Transform\ngeometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n"
_TRANSFORM_STAMPED = (
    "MSG: geometry_msgs/TransformStamped\nstd_msgs/Header header\nstring child_frame_id\n"
    "geometry_msgs/Transform transform\n"
)
_ROI = (
    "MSG: sensor_msgs/RegionOfInterest\nuint32 x_offset\nuint32 y_offset\nuint32 height\nuint32 width\n"
    "bool do_rectify\n"
)
_ARRAY_LAYOUT = "MSG: std_msgs/MultiArrayLayout\nstd_msgs/MultiArrayDimension[] dim\nuint32 data_offset\n"
_ARRAY_DIMENSION = "MSG: std_msgs/MultiArrayDimension\nstring label\nuint32 size\nuint32 stride\n"
_VISION_CLASS = "MSG: vision_msgs/VisionClass\nuint16 class_id\nstring class_name\n"


DEFINITIONS: dict[str, str] = {
    "std_msgs/msg/String": "string data\n",
    "std_msgs/msg/Bool": "bool data\n",
    "std_msgs/msg/Int64MultiArray": _definition(
        "std_msgs/MultiArrayLayout layout\nint64[] data\n", _ARRAY_LAYOUT, _ARRAY_DIMENSION
    ),
    "std_msgs/msg/Float64MultiArray": _definition(
        "std_msgs/MultiArrayLayout layout\nfloat64[] data\n", _ARRAY_LAYOUT, _ARRAY_DIMENSION
    ),
    "sensor_msgs/msg/JointState": _definition(
        "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort\n", _HEADER
    ),
    "geometry_msgs/msg/PoseStamped": _definition(
        "std_msgs/Header header\ngeometry_msgs/Pose pose\n", _HEADER, _POSE, _POINT, _QUATERNION
    ),
    "geometry_msgs/msg/WrenchStamped": _definition(
        "std_msgs/Header header\ngeometry_msgs/Wrench wrench\n", _HEADER, _WRENCH, _VECTOR3
    ),
    "tf2_msgs/msg/TFMessage": _definition(
        "geometry_msgs/TransformStamped[] transforms\n", _TRANSFORM_STAMPED, _TRANSFORM, _HEADER, _VECTOR3, _QUATERNION
    ),
    "sensor_msgs/msg/CameraInfo": _definition(
        "std_msgs/Header header\nuint32 height\nuint32 width\nstring distortion_model\nfloat64[] d\nfloat64[9] k\n"
        "float64[9] r\nfloat64[12] p\nuint32 binning_x\nuint32 binning_y\nsensor_msgs/RegionOfInterest roi\n",
        _HEADER,
        _ROI,
    ),
    "sensor_msgs/msg/Image": _definition(
        "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step\n"
        "uint8[] data\n",
        _HEADER,
    ),
    "sensor_msgs/msg/CompressedImage": _definition("std_msgs/Header header\nstring format\nuint8[] data\n", _HEADER),
    "foxglove_msgs/msg/CompressedVideo": _definition(
        "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format\n", _TIME
    ),
    "rcl_interfaces/msg/Log": _definition(
        "byte DEBUG=10\nbyte INFO=20\nbyte WARN=30\nbyte ERROR=40\nbyte FATAL=50\nbuiltin_interfaces/Time stamp\n"
        "uint8 level\nstring name\nstring msg\nstring file\nstring function\nuint32 line\n",
        _TIME,
    ),
    "vision_msgs/msg/LabelInfo": _definition(
        "std_msgs/Header header\nvision_msgs/VisionClass[] class_map\nfloat32 threshold\n", _HEADER, _VISION_CLASS
    ),
}
_FIELD = re.compile(r"^([\w/]+)(\[(\d*)\])?\s+(\w+)$")


class FieldType(NamedTuple):
    """A field of a message; `length` is that of an array, None if stored in each message."""

    name: str
    kind: str
    is_array: bool
    length: int | None


Types = Mapping[str, tuple[FieldType, ...]]
"""Type -> its fields; "" is the message itself."""


@cache
def types_of(schema: str) -> Types:
    """Parse the definition of a type."""
    first, *others = re.split(r"^=+\n", DEFINITIONS[schema], flags=re.MULTILINE)
    types = {"": _fields(first)}
    for text in others:
        head, _, body = text.partition("\n")
        types[head.removeprefix("MSG: ")] = _fields(body)
    return types


def _fields(text: str) -> tuple[FieldType, ...]:
    found = (_FIELD.match(line) for line in text.splitlines())  # constants, which have a value, do not match
    return tuple(
        FieldType(match[4], match[1], match[2] is not None, int(match[3]) if match[3] else None)
        for match in found
        if match is not None
    )
