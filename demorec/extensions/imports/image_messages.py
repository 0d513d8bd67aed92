"""Image messages of ROS and Foxglove: their format, integrity and pixels.

Reordering of bytes changes no value. Bayer patterns and YUV are converted by the simplest method that other
implementations agree on: bilinear interpolation, and ITU-R BT.601 with limited range."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple, cast

import av
import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from demorec.core.config import MAX_PIXELS
from demorec.core.errors import describe_error
from demorec.extensions.imports.fields import FieldError, image_bytes, whole
from demorec.mcap.cdr import Values
from demorec.mcap.lossless import decode_millimetres
from demorec.mcap.video import DECODERS, deep_gray, is_keyframe, nal_units

_PIXELS: dict[str, tuple[str, int]] = {
    "rgb8": ("rgb24", 3),
    "bgr8": ("bgr24", 3),
    "rgba8": ("rgba", 4),
    "bgra8": ("bgra", 4),
    "8UC3": ("bgr24", 3),  # OpenCV's own names mean blue first
    "mono8": ("gray", 1),
    "8UC1": ("gray", 1),
    "bayer_rggb8": ("bayer_rggb8", 1),
    "bayer_grbg8": ("bayer_grbg8", 1),
    "bayer_gbrg8": ("bayer_gbrg8", 1),
    "bayer_bggr8": ("bayer_bggr8", 1),
    "yuyv": ("yuyv422", 2),
    "yuv422_yuy2": ("yuyv422", 2),
    "uyvy": ("yuyv422", 2),
    "yuv422": ("yuyv422", 2),
}
"""Encoding -> FFmpeg's pixel format, and bytes per pixel."""
_LUMA_SECOND = ("uyvy", "yuv422")
"""Encodings with each two bytes exchanged."""
_DEPTH = {"16UC1": "u2", "32FC1": "f4"}
"""Depth encoding -> type of a value."""
_PIXEL_BYTES = {encoding: count for encoding, (_, count) in _PIXELS.items()} | {"16UC1": 2, "32FC1": 4}


def raw_image(values: Values) -> NDArray[Any]:
    """(H, W, 3) uint8 of a message, or (H, W) unchanged depth: uint16 (16UC1) or float32 (32FC1).

    Raises:
        FieldError: Its bytes do not match its size and encoding.
    """
    encoding, height = str(values["encoding"]), whole(values, "height")
    rows = _rows(values)
    if encoding in _DEPTH:
        kind = np.dtype(_DEPTH[encoding]).newbyteorder(">" if values.get("is_bigendian") else "<")
        stored = np.ascontiguousarray(rows).view(kind)
        return stored.astype(stored.dtype.newbyteorder("="))
    form, channels = _PIXELS[encoding]
    pixels = rows.reshape(height, -1, channels) if channels > 1 else rows
    pixels = pixels[:, :, ::-1] if encoding in _LUMA_SECOND else pixels
    return av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels), format=form).to_ndarray(format="rgb24")


def _check_raw(values: Values) -> tuple[int, int]:
    """Bytes per row, with and without padding; FieldError if a message's bytes do not match its size."""
    encoding, width, height = str(values["encoding"]), whole(values, "width"), whole(values, "height")
    if encoding not in _PIXEL_BYTES:
        raise FieldError(f"its encoding {encoding[:40]!r} is not supported; {', '.join(_PIXEL_BYTES)} are")
    is_bayer, is_paired = encoding.startswith("bayer"), _PIXELS.get(encoding, ("", 0))[0] == "yuyv422"
    if (width % 2 and (is_bayer or is_paired)) or (height % 2 and is_bayer):
        raise FieldError(f"its {encoding} image has {width}x{height} pixels, this encoding needs even sides")
    used = width * _PIXEL_BYTES[encoding]
    step = whole(values, "step") if values.get("step") and height > 1 else used
    data = values["data"]
    count = len(data) if isinstance(data, bytes | np.ndarray) else len(image_bytes(values))
    if step < used or count < step * (height - 1) + used:
        raise FieldError(f"its image has {count:,} bytes, too few for {width}x{height} {encoding}")
    return step, used


def _rows(values: Values) -> NDArray[np.uint8]:
    """(H, B) bytes, without row padding."""
    step, used = _check_raw(values)
    height, data = whole(values, "height"), np.frombuffer(image_bytes(values), np.uint8)
    if step == used:
        return data[: used * height].reshape(height, used)
    padded = np.zeros(step * height, np.uint8)
    padded[: min(len(data), len(padded))] = data[: len(padded)]
    return padded.reshape(height, step)[:, :used]


VIDEO_FORMATS = tuple(DECODERS)
KEPT_FORMATS = ("jpeg", *VIDEO_FORMATS)
"""Formats that pass through, byte for byte."""
_JPEG, _PNG = b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n"
_SEQUENCE_BYTES = 24
"""Length of an AV1 keyframe's beginning that contains its sequence header."""
_ALIASES = {"hevc": "h265", "avc": "h264", "jpg": "jpeg"}

_HEAD_BYTES = 12
"""ConfigHeader: a format and two parameters, which apply only to 32FC1."""


class ImageHead(NamedTuple):
    """Properties of an image known without decoding it.

    Attributes:
        format: raw, jpeg, png, compressedDepth or a codec of `VIDEO_FORMATS`.
        encoding: Encoding of raw pixels and depth: "rgb8", "bayer_rggb8", "16UC1"; else "".
        width, height: Pixels; 0 in video between keyframes.
        is_keyframe: Whether it can be decoded independently: in video a keyframe with its parameter sets.
    """

    format: str
    encoding: str
    width: int
    height: int
    is_keyframe: bool


def image_head(values: Values) -> ImageHead:
    """Parse a message's head; FieldError if it has no image, a damaged one, or an unsupported format."""
    if "data" not in values:
        raise FieldError("it holds no image")
    if "encoding" in values and "width" in values and "height" in values:
        size = whole(values, "width"), whole(values, "height")
        head = _checked(ImageHead("raw", str(values["encoding"]), *size, True))
        _check_raw(values)
        return head
    if "format" not in values:
        raise FieldError("it holds no image")
    data = image_bytes(values)
    name = str(values["format"]).lower()
    if "compresseddepth" in name:
        encoding = str(values["format"]).split(";")[0].strip()
        if encoding != "16UC1":
            raise FieldError(
                f"its compressedDepth is {encoding[:20]!r}, which loses measured values; 16UC1 and uncompressed 32FC1 "
                "are supported"
            )
        height, width = _compressed_depth(data).shape
        return _checked(ImageHead("compressedDepth", encoding, width, height, True))
    if data.startswith((_JPEG, _PNG)):
        return _file_head(data)
    codec = _ALIASES.get(name, name)
    if codec not in VIDEO_FORMATS:
        raise FieldError(f"its format {name[:40]!r} is not supported; jpeg, png, {', '.join(VIDEO_FORMATS)} are")
    if not _starts_by_itself(codec, data):
        return ImageHead(codec, "", 0, 0, False)
    return _checked(ImageHead(codec, "", *_keyframe_size(codec, data), True))


def _checked(head: ImageHead) -> ImageHead:
    _check_size(head.width, head.height)
    return head


def _check_size(width: int, height: int) -> None:
    if width < 1 or height < 1 or width * height > MAX_PIXELS:
        raise FieldError(f"its image has {width}x{height} pixels, at most {MAX_PIXELS} are supported")


@contextmanager
def _opened(data: bytes, formats: list[str], problem: str) -> Iterator[Image.Image]:
    """Open an image file; FieldError, which begins with `problem`, if it is damaged."""
    try:
        with Image.open(io.BytesIO(data), formats=formats) as image:
            yield image
    except UnidentifiedImageError as error:
        raise FieldError(f"{problem} (no whole {' or '.join(formats)} file)") from error
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise FieldError(f"{problem} ({describe_error(error)})") from error


def _file_head(data: bytes) -> ImageHead:
    """Head of a JPEG or PNG file; FieldError if it is another file, damaged, or too large."""
    kind = "jpeg" if data.startswith(_JPEG) else "png"
    with _opened(data, [kind.upper()], "its image is damaged") as image:
        width, height = image.size
        if kind == "png":  # images that pass through are not checked further; those to be decoded must be complete
            _check_mode(image)
            image.verify()
    end = b"\xff\xd9" if kind == "jpeg" else b"IEND\xaeB`\x82"
    if end not in data[-64:]:  # some cameras pad their images
        raise FieldError("its image is cut off")
    return _checked(ImageHead(kind, "", width, height, True))


def _check_mode(image: Image.Image) -> None:
    if image.mode not in ("RGB", "RGBA", "L", "P", "1"):
        raise FieldError(f"its pixels are {image.mode!r}, which is not 8-bit colour")


def decode_image(values: Values) -> NDArray[Any]:
    """Decode (H, W, 3) RGB or depth (H, W) of an image, except video; FieldError if it cannot be decoded."""
    if "encoding" in values:
        return raw_image(values)
    if "compresseddepth" in str(values["format"]).lower():
        return _compressed_depth(image_bytes(values))
    with _opened(image_bytes(values), ["JPEG", "PNG"], "its image cannot be decoded") as image:
        _check_mode(image)
        return np.asarray(image.convert("RGB"))


def _starts_by_itself(codec: str, data: bytes) -> bool:
    if codec == "av1":
        return is_keyframe(codec, data)
    kinds = [kind for kind, _ in nal_units(codec, data)]
    if codec == "h264":  # ITU-T H.264, table 7-1
        return 5 in kinds and 7 in kinds
    return 33 in kinds and any(16 <= kind <= 23 for kind in kinds)  # ITU-T H.265, table 7-1


_shapes: dict[tuple[str, bytes], tuple[int, int, str]] = {}
"""(codec, parameter sets) -> width, height and `deep_gray` of the keyframes, from one decoded keyframe."""


class NoColorError(FieldError):
    """Encoded images hold a measurement with unknown unit instead of colour."""


def _keyframe_size(codec: str, data: bytes) -> tuple[int, int]:
    """Return width and height of a keyframe.

    Raises:
        FieldError: It decodes to no image.
        NoColorError: Its pixels are not colours.
    """
    key = (codec, data[:_SEQUENCE_BYTES] if codec == "av1" else _parameter_sets(codec, data))
    if key not in _shapes:
        try:
            context = cast(av.VideoCodecContext, av.CodecContext.create(DECODERS[codec], "r"))
            context.thread_count = 1
            context.options = {"max_pixels": str(MAX_PIXELS)}
            frames = [*context.decode(av.Packet(data)), *context.decode(None)]
        except (av.FFmpegError, ValueError) as error:
            raise FieldError(f"its {codec} video cannot be decoded") from error
        if not frames:
            raise FieldError(f"its {codec} keyframe cannot be decoded")
        _shapes[key] = (frames[0].width, frames[0].height, deep_gray(codec, frames[0].format.name, key[1]))
    width, height, measurement = _shapes[key]
    if measurement:
        raise NoColorError(
            f"its {codec} video holds {measurement}, which is depth or another measurement and not colour: leave the "
            "topic out, or record the distances as 16UC1 or 32FC1 images"
        )
    return width, height


def _parameter_sets(codec: str, data: bytes) -> bytes:
    """Parameter sets before a keyframe's image, without adjacent units that may differ between images."""
    units = list(nal_units(codec, data))
    kinds = (7, 8) if codec == "h264" else (32, 33, 34)
    places = [place for _, place in units[1:]] + [units[-1][1]]
    return b"".join(data[at:end] for (kind, at), end in zip(units, places, strict=True) if kind in kinds)


def _compressed_depth(data: bytes) -> NDArray[np.uint16]:
    """(H, W) millimetres; FieldError if there are too many pixels, or they cannot be decoded."""
    if data.startswith(_PNG, _HEAD_BYTES):
        with _opened(data[_HEAD_BYTES:], ["PNG"], "its distances cannot be decoded") as image:
            _check_size(*image.size)
            if image.mode not in ("I;16", "I"):
                raise ValueError(f"its pixels are {image.mode}, not 16-bit")
            return np.asarray(image).astype(np.uint16)
    size = data[_HEAD_BYTES : _HEAD_BYTES + 8]
    if len(size) < 8:
        raise FieldError("its distances are cut off")
    width, height = (int.from_bytes(part, "little") for part in (size[:4], size[4:]))
    _check_size(width, height)
    try:
        return decode_millimetres(data, (height, width))
    except ValueError as error:
        raise FieldError(f"its distances cannot be decoded ({describe_error(error)})") from error
