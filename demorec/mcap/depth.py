"""Depth pictures: 16 bits a pixel in millimetres, coded without loss by RVL.

RVL (A. D. Wilson, Fast Lossless Depth Image Compression, ISS 2017): alternating run lengths of empty and of measured
pixels, the measured ones as differences to the one before (zigzag), every number in groups of three bits with a
continuation bit, eight groups to a 32-bit word. In the frame of ROS's compressed_depth_image_transport it is what
Rerun draws as depth and RViz shows; PNG in that frame Rerun takes for a broken picture.
"""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

FORMAT = "16UC1; compressedDepth rvl"
MAX_METRES = 65.535
DEPTH_TYPES: dict[str, type[np.uint16] | type[np.float32]] = {"16UC1": np.uint16, "32FC1": np.float32}
"""Encodings of collected episodes, which keep distances to the bit: millimetres as RVL, or metres as they are."""
_HEAD = struct.Struct("<iffii")
"""ConfigHeader (format, two parameters of inverse depth, both unused here), then width and height."""


def encode_depth(metres: NDArray[np.float32]) -> bytes:
    """Depth (H, W) in metres, 0 (or not finite) where nothing was hit; farther than 65.535 m counts as nothing."""
    with np.errstate(invalid="ignore"):
        known = (metres > 0) & (metres <= MAX_METRES)
    return encode_millimetres(np.where(known, np.rint(np.where(known, metres, 0) * 1000), 0).astype(np.uint16))


def encode_millimetres(millimetres: NDArray[np.uint16]) -> bytes:
    """Depth (H, W) in whole millimetres, 0 where nothing was measured."""
    from demorec.mcap import kernels

    height, width = millimetres.shape
    flat = millimetres.reshape(-1)
    words = np.zeros(len(flat) * 2 + 4, dtype=np.uint32)  # at most 7 groups a pixel and 6 + 6 a pair of runs
    count = kernels.rvl_encode(flat, words)
    return _HEAD.pack(0, 0.0, 0.0, width, height) + words[:count].astype("<u4").tobytes()


def decode_depth(data: bytes, size: tuple[int, int]) -> NDArray[np.float32]:
    """Inverse of `encode_depth`, to half a millimetre; ValueError for no RVL picture of that (height, width)."""
    return np.asarray(decode_millimetres(data, size) / np.float32(1000), dtype=np.float32)


def decode_millimetres(data: bytes, size: tuple[int, int]) -> NDArray[np.uint16]:
    """Inverse of `encode_millimetres`; ValueError for no RVL picture of that (height, width)."""
    from demorec.mcap import kernels

    if len(data) < _HEAD.size or (len(data) - _HEAD.size) % 4:
        raise ValueError(f"a depth picture of {len(data)} bytes")
    _, _, _, width, height = _HEAD.unpack_from(data)
    if (height, width) != size:
        raise ValueError(f"a depth picture of {width}x{height} pixels, expected {size[1]}x{size[0]}")
    words = np.frombuffer(data, dtype="<u4", offset=_HEAD.size).astype(np.uint32)
    flat = np.zeros(width * height, dtype=np.uint16)
    if not kernels.rvl_decode(words, flat):
        raise ValueError("a depth picture whose runs do not fit its size")
    return flat.reshape(height, width)


def encode_distances(values: NDArray[Any]) -> bytes:
    """The packet of distances (H, W) uint16 or float32."""
    return encode_millimetres(values) if values.dtype == np.uint16 else values.astype("<f4").tobytes()


def decode_distances(encoding: str, data: bytes, size: tuple[int, int]) -> NDArray[np.uint16] | NDArray[np.float32]:
    """(H, W) of a packet, uint16 or float32; ValueError when it is none of that (height, width)."""
    if encoding == "16UC1":
        return decode_millimetres(data, size)
    if len(data) != 4 * size[0] * size[1]:
        raise ValueError(f"a depth picture of {len(data)} bytes, expected {size[1]}x{size[0]} pixels of 4")
    return np.frombuffer(data, "<f4").astype(np.float32).reshape(size)
