"""Messages that hold a picture, as ROS and Foxglove define them: what is in them, without decoding it."""

from __future__ import annotations

import base64
import binascii
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from demorec.ingest.fields import FieldError
from demorec.ingest.ros_types import Values
from demorec.recording.video import is_keyframe

VIDEO_FORMATS = ("h264", "h265", "av1")
_ALIASES = {"hevc": "h265", "avc": "h264", "jpg": "jpeg"}


class PictureHead(NamedTuple):
    """What is known of a picture before it is decoded.

    Attributes:
        format: raw, jpeg, png, compressedDepth or a codec of `VIDEO_FORMATS`.
        encoding: Of raw pixels: "rgb8", "bayer_rggb8", "16UC1"; else "".
        width, height: Pixels of a raw picture; 0 where only decoding tells.
        is_keyframe: Whether it can be decoded without those before it.
    """

    format: str
    encoding: str
    width: int
    height: int
    is_keyframe: bool


def picture_head(values: Values) -> PictureHead:
    """Of a message; FieldError when it holds no picture, or one in a format that is not read."""
    if "data" not in values:
        raise FieldError("it holds no picture")
    if "encoding" in values and "width" in values and "height" in values:
        width, height = int(values["width"]), int(values["height"])
        return PictureHead("raw", str(values["encoding"]), width, height, True)
    if "format" not in values:
        raise FieldError("it holds no picture")
    data = picture_bytes(values)
    name = str(values["format"]).lower()
    if "compresseddepth" in name:
        return PictureHead("compressedDepth", name.split(";")[0].strip(), 0, 0, True)
    if data.startswith(b"\xff\xd8\xff"):
        return PictureHead("jpeg", "", 0, 0, True)
    if data.startswith(b"\x89PNG\r\n\x1a\n"):
        return PictureHead("png", "", 0, 0, True)
    codec = _ALIASES.get(name, name)
    if codec not in VIDEO_FORMATS:
        raise FieldError(f"its format {name[:40]!r} is not read; jpeg, png, {', '.join(VIDEO_FORMATS)} are")
    return PictureHead(codec, "", 0, 0, _is_keyframe(codec, data))


def picture_bytes(values: Mapping[str, Any]) -> bytes:
    """The bytes of a picture; JSON has them in base64."""
    data = values["data"]
    if isinstance(data, str):
        try:
            return base64.b64decode(data, validate=True)
        except binascii.Error as error:
            raise FieldError("its picture is no base64") from error
    if isinstance(data, np.ndarray):
        return data.tobytes()
    if isinstance(data, bytes):
        return data
    raise FieldError("it holds no picture")


def _is_keyframe(codec: str, data: bytes) -> bool:
    if codec != "h265":
        return is_keyframe(codec, data)
    # H.265, table 7-1: NAL unit types 16 to 23 are pictures that can be decoded by themselves.
    position = data.find(b"\x00\x00\x01")
    while 0 <= position < len(data) - 3:
        kind = (data[position + 3] >> 1) & 63
        if kind < 32:
            return 16 <= kind <= 23
        position = data.find(b"\x00\x00\x01", position + 3)
    return False
