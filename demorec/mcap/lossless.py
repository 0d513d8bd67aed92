"""Lossless encoding of depth and segmentation images.

Depth: 16 bits a pixel in millimetres, encoded by RVL (A. D. Wilson, Fast Lossless Depth Image Compression, ISS 2017):
alternating run lengths of empty and of measured pixels, the measured ones as differences to the previous one (zigzag),
every number in groups of three bits with a continuation bit, eight groups per 32-bit word. In the frame of ROS's
compressed_depth_image_transport, Rerun draws it as depth and RViz shows it; Rerun treats PNG in that frame as a broken
image.

Segmentation: body and link of each pixel, as 16-bit PNG files with a table of names. Rerun would interpret uncompressed
single-channel images as depth, and place them in the scene.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Iterator
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from demorec.core.errors import RecordingError
from demorec.episode.info import EpisodeInfo
from demorec.robots.assets import asset_path
from demorec.robots.urdf import Urdf

DEPTH_FORMAT = "16UC1; compressedDepth rvl"
MAX_METRES = 65.535
DEPTH_TYPES: dict[str, type[np.uint16] | type[np.float32]] = {"16UC1": np.uint16, "32FC1": np.float32}
"""Encodings of external episodes, which keep distances bit-exact: millimetres as RVL, or raw metres."""
_RVL_HEAD = struct.Struct("<iffii")
"""ConfigHeader (format, two parameters of inverse depth, both unused here), then width and height."""


def encode_depth(metres: NDArray[np.float32]) -> bytes:
    """Encode depth (H, W) in metres; 0, not finite or farther than 65.535 m becomes empty."""
    with np.errstate(invalid="ignore"):
        known = (metres > 0) & (metres <= MAX_METRES)
    return encode_millimetres(np.where(known, np.rint(np.where(known, metres, 0) * 1000), 0).astype(np.uint16))


def encode_millimetres(millimetres: NDArray[np.uint16]) -> bytes:
    """Encode depth (H, W) in whole millimetres, 0 where nothing was measured."""
    from demorec.mcap import kernels

    height, width = millimetres.shape
    flat = millimetres.reshape(-1)
    words = np.zeros(len(flat) * 2 + 4, dtype=np.uint32)  # at most 7 groups a pixel and 6 + 6 a pair of runs
    count = kernels.rvl_encode(flat, words)
    return _RVL_HEAD.pack(0, 0.0, 0.0, width, height) + words[:count].astype("<u4").tobytes()


def decode_millimetres(data: bytes, size: tuple[int, int]) -> NDArray[np.uint16]:
    """Decode `encode_millimetres`; ValueError unless it is an RVL image of that (height, width)."""
    from demorec.mcap import kernels

    if len(data) < _RVL_HEAD.size or (len(data) - _RVL_HEAD.size) % 4:
        raise ValueError(f"a depth image of {len(data)} bytes")
    _, _, _, width, height = _RVL_HEAD.unpack_from(data)
    if (height, width) != size:
        raise ValueError(f"a depth image of {width}x{height} pixels, not {size[1]}x{size[0]}")
    words = np.frombuffer(data, dtype="<u4", offset=_RVL_HEAD.size).astype(np.uint32)
    flat = np.zeros(width * height, dtype=np.uint16)
    if not kernels.rvl_decode(words, flat):
        raise ValueError("a depth image with runs that do not fit its size")
    return flat.reshape(height, width)


def encode_distances(values: NDArray[Any]) -> bytes:
    """Encode distances (H, W) uint16 or float32 as a packet."""
    return encode_millimetres(values) if values.dtype == np.uint16 else values.astype("<f4").tobytes()


def decode_distances(encoding: str, data: bytes, size: tuple[int, int]) -> NDArray[np.uint16] | NDArray[np.float32]:
    """Decode a packet to (H, W) uint16 or float32; ValueError if it does not have that (height, width)."""
    if encoding == "16UC1":
        return decode_millimetres(data, size)
    if len(data) != 4 * size[0] * size[1]:
        raise ValueError(f"a depth image of {len(data)} bytes, expected {size[1]}x{size[0]} pixels of 4")
    return np.frombuffer(data, "<f4").astype(np.float32).reshape(size)


BACKGROUND = -1
LABELS_FORMAT = "mono16; png compressed "
"""In the notation of ROS's compressed_image_transport, including the blank."""
_LINK_SHIFT = 24
_BODY_MASK = (1 << _LINK_SHIFT) - 1


def to_labels(segmentation: NDArray[np.int32]) -> NDArray[np.uint16]:
    """Convert (H, W) body + ((link + 1) << 24), background -1, to 256 (body + 1) + link + 1, background 0.

    RecordingError for more than 255 bodies, or links of a body.
    """
    values = segmentation.astype(np.int64)
    body, link = values & _BODY_MASK, values >> _LINK_SHIFT
    known = values >= 0
    if bool(((body > 254) & known).any()) or bool(((link > 255) & known).any()):
        raise RecordingError("Segmentation is limited to 255 bodies with 255 links each: use a smaller scene.")
    return np.where(known, ((body + 1) << 8) + link, 0).astype(np.uint16)


def from_labels(labels: NDArray[np.uint16]) -> NDArray[np.int32]:
    """Invert `to_labels`."""
    values = labels.astype(np.int32)
    links = values & 255
    links <<= _LINK_SHIFT
    values >>= 8
    values -= 1  # the background, 0, becomes -1 by itself
    values += links  # all in place: allocation would cost more than the step itself
    return values


def encode_labels(segmentation: NDArray[np.int32]) -> bytes:
    """Encode `to_labels` as a PNG file."""
    buffer = io.BytesIO()
    Image.fromarray(to_labels(segmentation)).save(buffer, format="PNG", compress_level=3)
    return buffer.getvalue()


class LabelDecoder:
    """Decoder of the segmentation images, all of size (height, width), of one camera.

    FFmpeg unpacks an image in a third of Pillow's time; its set-up costs as much as unpacking one image.
    """

    def __init__(self, size: tuple[int, int]) -> None:
        self._size = size
        self._decoder = av.CodecContext.create("png", "r")
        self._decoder.thread_count = 1
        # Much larger images are refused before anything is unpacked; FFmpeg counts blocks of 128 pixels.
        most = (size[0] + 128) * (size[1] + 128)
        self._decoder.options = {"err_detect": "crccheck+explode", "max_pixels": str(most)}

    def decode(self, data: bytes) -> NDArray[np.int32]:
        """Decode `encode_labels`; ValueError unless the bytes are such a file of that size."""
        packet = av.Packet(data)
        packet.is_keyframe = True  # otherwise FFmpeg treats it as a difference to the previous image
        try:
            frames = self._decoder.decode(packet)
        except av.FFmpegError as error:
            raise ValueError("a damaged segmentation image") from error
        if len(frames) != 1 or frames[0].format.name != "gray16be" or (frames[0].height, frames[0].width) != self._size:
            raise ValueError(f"a segmentation image other than 16 bits of {self._size[1]}x{self._size[0]} pixels")
        lines = np.frombuffer(frames[0].planes[0], dtype=">u2").reshape(self._size[0], -1)  # FFmpeg may pad lines
        return from_labels(lines[:, : self._size[1]].astype(np.uint16))


def segment_names(info: EpisodeInfo) -> Iterator[tuple[int, str]]:
    """Yield (segmentation value, name) of the background, every body and every link of the robot.

    Bodies are numbered in loading order (static ones, the robot, movable ones), links as in PyBullet: depth first, in
    the order of the URDF's joints.
    """
    yield BACKGROUND, "background"
    fixed = [body.name for body in info.simulated.scene.fixed]
    for index, name in enumerate(
        [*fixed, info.simulated.robot.name, *(body.name for body in info.simulated.scene.movable)]
    ):
        if index != len(fixed):
            yield index, name
            continue
        urdf = Urdf.load(asset_path(info.simulated.robot.urdf))
        for link_index, link in enumerate([urdf.root, *(joint.child for joint in urdf.depth_first())], start=-1):
            yield index + ((link_index + 1) << _LINK_SHIFT), f"{name}/{link}"
