"""Pixels as cameras send them, to RGB or distances: the encodings of sensor_msgs/Image and foxglove.RawImage.

Reordering of bytes changes no value. Bayer patterns and YUV are computed, in the plainest way that others agree on:
bilinear interpolation, ITU-R BT.601 with limited range.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.sources.fields import FieldError, picture_bytes, whole
from demorec.sources.ros_types import Values

Rgb = NDArray[np.uint8]
_CHANNELS: dict[str, tuple[int, tuple[int, int, int]]] = {
    "rgb8": (3, (0, 1, 2)),
    "bgr8": (3, (2, 1, 0)),
    "rgba8": (4, (0, 1, 2)),
    "bgra8": (4, (2, 1, 0)),
    "8UC3": (3, (2, 1, 0)),
    "mono8": (1, (0, 0, 0)),
    "8UC1": (1, (0, 0, 0)),
}
"""Encoding -> bytes of a pixel, which of them are red, green, blue; OpenCV's own names mean blue first."""
_BAYER = {"bayer_rggb8": (0, 0), "bayer_grbg8": (0, 1), "bayer_gbrg8": (1, 0), "bayer_bggr8": (1, 1)}
"""Encoding -> row and column of the first red pixel."""
_YUV = {"uyvy": (1, 0, 2), "yuv422": (1, 0, 2), "yuyv": (0, 1, 3), "yuv422_yuy2": (0, 1, 3)}
"""Encoding -> where the first luma, U and V of a pair of pixels are, of its four bytes."""
_DEPTH = {"16UC1": "u2", "32FC1": "f4"}
"""Encoding of distances -> type of one."""
_PIXEL_BYTES = (
    {encoding: count for encoding, (count, _) in _CHANNELS.items()}
    | dict.fromkeys(_BAYER, 1)
    | dict.fromkeys(_YUV, 2)
    | {encoding: np.dtype(kind).itemsize for encoding, kind in _DEPTH.items()}
)
RAW_ENCODINGS = tuple(_PIXEL_BYTES)


def raw_picture(values: Values) -> NDArray[Any]:
    """(H, W, 3) uint8 of a message, or (H, W) distances as they are: uint16 (16UC1) or float32 (32FC1).

    Raises:
        FieldError: Its bytes are not those of its size and encoding.
    """
    encoding, height = str(values["encoding"]), whole(values, "height")
    rows = _rows(values)
    if encoding in _DEPTH:
        kind = np.dtype(_DEPTH[encoding]).newbyteorder(">" if values.get("is_bigendian") else "<")
        stored = np.ascontiguousarray(rows).view(kind)
        return stored.astype(stored.dtype.newbyteorder("="))
    if encoding in _CHANNELS:
        channels, order = _CHANNELS[encoding]
        return np.ascontiguousarray(rows.reshape(height, -1, channels)[:, :, list(order)])
    return _from_bayer(rows, *_BAYER[encoding]) if encoding in _BAYER else _from_yuv(rows, *_YUV[encoding])


def check_raw(values: Values) -> tuple[int, int]:
    """Bytes of a row, with and without what pads it; FieldError when a message's are not those of its size."""
    encoding, width, height = str(values["encoding"]), whole(values, "width"), whole(values, "height")
    used = _bytes_of_row(encoding, width)
    step = whole(values, "step") if values.get("step") and height > 1 else used
    data = values["data"]
    count = len(data) if isinstance(data, bytes | np.ndarray) else len(picture_bytes(values))
    if step < used or count < step * (height - 1) + used:
        raise FieldError(f"its picture has {count:,} bytes, too few for {width}x{height} {encoding}")
    return step, used


def _bytes_of_row(encoding: str, width: int) -> int:
    if encoding in _PIXEL_BYTES and not (encoding in _YUV and width % 2):
        return width * _PIXEL_BYTES[encoding]
    raise FieldError(f"its encoding {encoding[:40]!r} is not read; {', '.join(RAW_ENCODINGS)} are")


def _rows(values: Values) -> NDArray[np.uint8]:
    """(H, B) bytes, without what pads each row."""
    step, used = check_raw(values)
    height, data = whole(values, "height"), np.frombuffer(picture_bytes(values), np.uint8)
    if step == used:
        return data[: used * height].reshape(height, used)
    padded = np.zeros(step * height, np.uint8)
    padded[: min(len(data), len(padded))] = data[: len(padded)]
    return padded.reshape(height, step)[:, :used]


def _from_bayer(pixels: NDArray[np.uint8], red_row: int, red_column: int) -> Rgb:
    height, width = pixels.shape
    rows, columns = np.indices((height, width))
    is_red = ((rows % 2) == red_row) & ((columns % 2) == red_column)
    is_blue = ((rows % 2) != red_row) & ((columns % 2) != red_column)
    masks = (is_red, ~(is_red | is_blue), is_blue)
    return np.stack([_filled(pixels, mask) for mask in masks], axis=2)


def _filled(pixels: NDArray[np.uint8], mask: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """A colour at every pixel: its own, or the mean of the neighbours that have it, the nearer ones counting double."""
    known, weights = np.pad(np.where(mask, pixels, 0).astype(np.float64), 1), np.pad(mask.astype(np.float64), 1)

    def blurred(plane: NDArray[np.float64]) -> NDArray[np.float64]:
        lines = plane[:-2] + 2 * plane[1:-1] + plane[2:]
        return np.asarray(lines[:, :-2] + 2 * lines[:, 1:-1] + lines[:, 2:])

    mean = blurred(known) / np.maximum(blurred(weights), 1e-9)
    return np.where(mask, pixels, np.rint(mean)).astype(np.uint8)


def _from_yuv(pixels: NDArray[np.uint8], luma: int, u: int, v: int) -> Rgb:
    quads = pixels.reshape(pixels.shape[0], -1, 4).astype(np.float64)
    y = np.repeat(quads[:, :, [luma]], 2, axis=2)
    y[:, :, 1] = quads[:, :, luma + 2]
    scaled = 1.164383 * (y - 16)
    blue, red = quads[:, :, [u]] - 128, quads[:, :, [v]] - 128
    channels = (scaled + 1.596027 * red, scaled - 0.391762 * blue - 0.812968 * red, scaled + 2.017232 * blue)
    rgb = np.stack([channel.reshape(len(pixels), -1) for channel in channels], axis=2)
    return np.clip(np.rint(rgb), 0, 255).astype(np.uint8)
