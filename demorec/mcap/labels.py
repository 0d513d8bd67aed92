"""Segmentation pictures: which body and link each pixel shows, as 16-bit PNG files with a table of names.

Uncompressed pictures of one channel Rerun takes for depth, and stands them in the scene.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Iterator

import av
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from demorec.core.errors import RecordingError
from demorec.episode.episode import SimulatedInfo
from demorec.robots.assets import asset_path
from demorec.robots.urdf import Urdf

BACKGROUND = -1
FORMAT = "mono16; png compressed "
"""In the words of ROS's compressed_image_transport, blank included."""
_PNG_HEAD = struct.Struct(">16sIIBB")
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR"
_GREY_16 = (16, 0)
"""Bits of a channel, and the colour type of one that is grey."""
_LINK_SHIFT = 24
_BODY_MASK = (1 << _LINK_SHIFT) - 1


def to_labels(segmentation: NDArray[np.int32]) -> NDArray[np.uint16]:
    """(H, W) body + ((link + 1) << 24), background -1, as 256 (body + 1) + link + 1, background 0.

    Raises:
        RecordingError: More than 255 bodies, or links of a body.
    """
    values = segmentation.astype(np.int64)
    body, link = values & _BODY_MASK, values >> _LINK_SHIFT
    known = values >= 0
    if bool(((body > 254) & known).any()) or bool(((link > 255) & known).any()):
        raise RecordingError("Segmentation can be recorded of at most 255 bodies with 255 links each.")
    return np.where(known, ((body + 1) << 8) + link, 0).astype(np.uint16)


def from_labels(labels: NDArray[np.uint16]) -> NDArray[np.int32]:
    """Inverse of `to_labels`."""
    values = labels.astype(np.int32)
    links = values & 255
    links <<= _LINK_SHIFT
    values >>= 8
    values -= 1  # the background, 0, becomes -1 by itself
    values += links  # all in place: memory for each step would cost more than the step
    return values


def encode_labels(segmentation: NDArray[np.int32]) -> bytes:
    """A PNG file of `to_labels`."""
    buffer = io.BytesIO()
    Image.fromarray(to_labels(segmentation)).save(buffer, format="PNG", compress_level=3)
    return buffer.getvalue()


def decode_labels(data: bytes, size: tuple[int, int]) -> NDArray[np.int32]:
    """Inverse of `encode_labels`; ValueError when the bytes are no such file of that (height, width)."""
    return LabelDecoder(size).decode(data)


class LabelDecoder:
    """Reads the segmentation pictures of one camera.

    FFmpeg unpacks a picture in a third of the time that Pillow takes; to set it up costs as much as to unpack one.

    Args:
        size: (height, width) of all pictures.
    """

    def __init__(self, size: tuple[int, int]) -> None:
        self._size = size
        self._decoder = av.CodecContext.create("png", "r")
        self._decoder.thread_count = 1
        self._decoder.options = {"err_detect": "crccheck+explode"}

    def decode(self, data: bytes) -> NDArray[np.int32]:
        """As of `decode_labels`."""
        return from_labels(self.labels(data))

    def labels(self, data: bytes) -> NDArray[np.uint16]:
        """(H, W) the labels as they are in the file, of which half of the time is saved; ValueError as of `decode`."""
        if len(data) < _PNG_HEAD.size:
            raise ValueError("a segmentation picture that is cut off")
        signature, width, height, depth, color = _PNG_HEAD.unpack_from(data)
        if signature != _PNG_SIGNATURE or (depth, color) != _GREY_16:
            raise ValueError("a segmentation picture that is no PNG file of 16-bit numbers")
        if (height, width) != self._size:  # before anything is unpacked
            raise ValueError(f"a segmentation picture of {width}x{height} pixels")
        packet = av.Packet(data)
        packet.is_keyframe = True  # else FFmpeg takes it for the difference to the picture before
        try:
            frames = self._decoder.decode(packet)
        except av.FFmpegError as error:
            raise ValueError("a segmentation picture that is damaged") from error
        if len(frames) != 1 or frames[0].format.name != "gray16be" or (frames[0].height, frames[0].width) != self._size:
            raise ValueError("a segmentation picture that is damaged")
        lines = np.frombuffer(frames[0].planes[0], dtype=">u2").reshape(height, -1)  # FFmpeg may pad lines
        return lines[:, :width].astype(np.uint16)


def segment_names(info: SimulatedInfo) -> Iterator[tuple[int, str]]:
    """(segmentation value, name) of the background, every body and every link of the robot.

    Bodies are numbered in the order in which a world loads them (what stands still, the robot, what moves), links as
    PyBullet does: depth first, in the order of the URDF's joints.
    """
    yield BACKGROUND, "background"
    fixed = [body.name for body in info.scene.fixed]
    for index, name in enumerate([*fixed, info.robot.name, *(body.name for body in info.scene.movable)]):
        if index != len(fixed):
            yield index, name
            continue
        urdf = Urdf.load(asset_path(info.robot.urdf))
        for link_index, link in enumerate([urdf.root, *(joint.child for joint in urdf.depth_first())], start=-1):
            yield index + ((link_index + 1) << _LINK_SHIFT), f"{name}/{link}"
