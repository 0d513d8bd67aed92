"""Distances in collected episodes, to the bit: millimetres of 16 bits as RVL, metres in float32 as they are."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.recording import messages
from demorec.recording.channels import video_topic
from demorec.recording.depth import FORMAT, decode_millimetres, encode_millimetres
from demorec.recording.pictures import Message
from demorec.recording.transforms import camera_frame
from demorec.scene.collected import CollectedCamera

DEPTH_TYPES: dict[str, type[np.uint16] | type[np.float32]] = {"16UC1": np.uint16, "32FC1": np.float32}
"""Encoding -> type of its distances."""


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


class DepthMessages:
    """The messages of a depth camera: as ROS's compressed_depth_image_transport has them, or sensor_msgs/Image."""

    def __init__(self, camera: CollectedCamera) -> None:
        self._topic, self._frame_id = video_topic(camera.name, camera.kept), camera_frame(camera.name)
        self._encoding, self._size = camera.kept, (camera.height, camera.width)
        self._layout = messages.PictureMessages(self._frame_id, FORMAT)

    def of(self, time_ns: int, packet: bytes) -> list[Message]:
        """That of one picture."""
        if self._encoding == "16UC1":
            return [(self._topic, messages.COMPRESSED_IMAGE, self._layout.compressed_image(time_ns, packet))]
        data = messages.image(time_ns, self._frame_id, self._encoding, self._size, packet)
        return [(self._topic, messages.IMAGE, data)]
