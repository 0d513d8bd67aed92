"""Depth images in LeRobot 0.6's form: 12-bit logarithmic codes in lossless HEVC.

A distance z (metres) has the code rint(4095 (ln(z + s) - ln(a + s)) / (ln(b + s) - ln(a + s))) with a = 0.01 m, b = 10
m and s = 3.5 m: steps of 1.2 mm near the camera, 4.4 mm at the far end. Pixels without a hit have code 0, which decodes
to 0.01 m, closer than any camera measures.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any, cast

import av
import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import ExportError, describe_error
from demorec.core.geometry import Array
from demorec.datasets.lerobot.layout import video_info
from demorec.datasets.lerobot.mp4 import EncodedVideo
from demorec.datasets.lerobot.stats import PixelHistogram

_NEAREST = 0.01
_FARTHEST = 10.0
_SHIFT = 3.5
LARGEST_CODE = 4095
_GOP = 2
_CRF = 30
_PARAMETERS = "lossless=1"


def quantised(depth: NDArray[np.float32]) -> NDArray[np.uint16]:
    """(H, W) codes of distances in metres; float32 arithmetic, so that codes equal those of LeRobot's `quantize_depth`.
    Values that are not finite, or behind the camera, count as not measured and get code 0.
    """
    shift = np.float32(_SHIFT)
    low = math.log(float(np.float32(_NEAREST) + shift))
    high = math.log(float(np.float32(_FARTHEST) + shift))
    metres = np.maximum(np.nan_to_num(depth, nan=0.0, posinf=0.0, neginf=0.0), np.float32(0))
    scaled = (np.log(metres + shift) - low) / (high - low)
    return np.asarray(np.rint(scaled * LARGEST_CODE).clip(0, LARGEST_CODE), dtype=np.uint16)


@dataclass(frozen=True, kw_only=True)
class DepthScale:
    """Mapping from codes to metres by a depth feature's metadata, linear or logarithmic."""

    nearest: float = _NEAREST
    farthest: float = _FARTHEST
    shift: float = _SHIFT
    use_log: bool = True

    def values(self) -> Array:
        """(4096,) distance in metres of each code."""
        codes = np.arange(LARGEST_CODE + 1)
        if not self.use_log:
            return np.asarray(self.nearest + codes * ((self.farthest - self.nearest) / LARGEST_CODE))
        low, high = math.log(self.nearest + self.shift), math.log(self.farthest + self.shift)
        return np.asarray(np.exp(low + codes * ((high - low) / LARGEST_CODE)) - self.shift)

    def shown(self) -> NDArray[np.float32]:
        """(4096,) the same for display: 0, nothing measured, for the lowest code."""
        return np.concatenate([[0], self.values()[1:]]).astype(np.float32)


def depth_video(images: Iterable[NDArray[np.float32]], *, fps: int) -> tuple[EncodedVideo, PixelHistogram]:
    """Encode depth images (H, W) in metres; also count their codes for the statistics."""
    context: av.VideoCodecContext | None = None
    packets: list[av.Packet] = []
    counts = np.zeros(LARGEST_CODE + 1, dtype=np.int64)
    number = 0
    for number, image in enumerate(images, start=1):
        codes = quantised(image)
        counts += np.bincount(codes.ravel(), minlength=LARGEST_CODE + 1)
        if context is None:
            context = _encoder(codes.shape, fps)
        frame = av.VideoFrame.from_ndarray(codes, format="gray12le")
        frame.pts, frame.time_base = number - 1, context.time_base
        packets += context.encode(frame)
    if context is None:
        raise ExportError("No depth images to encode.")
    packets += context.encode(None)
    data = [bytes(packet) for packet in packets]
    video = EncodedVideo.of_access_units("hevc", b"".join(data), [len(unit) for unit in data])
    video = replace(video, is_keyframe=np.array([packet.is_keyframe for packet in packets], dtype=np.bool_))
    histogram = PixelHistogram(counts=counts[np.newaxis], level_values=DepthScale().values(), num_images=number)
    return video, histogram


def _encoder(shape: tuple[int, ...], fps: int) -> av.VideoCodecContext:
    try:
        context = cast(av.VideoCodecContext, av.CodecContext.create("libx265", "w"))
        context.height, context.width = shape
        context.pix_fmt = "gray12le"
        context.time_base, context.framerate = Fraction(1, fps), Fraction(fps, 1)
        # No reordering and no log output; every keyframe is independent. One thread and no encoder settings in the
        # stream: both depend on the machine, and equal images must give equal bytes on every machine.
        context.options = {
            "g": str(_GOP),
            "crf": str(_CRF),
            "x265-params": f"{_PARAMETERS}:bframes=0:repeat-headers=1:open-gop=0:info=0:pools=none:frame-threads=1"
            ":log-level=none",
        }
        context.open()
    except (av.FFmpegError, ValueError) as error:
        raise ExportError(
            f"Depth video cannot be encoded, this build of PyAV has no 12-bit HEVC ({describe_error(error)})."
        ) from error
    return context


def depth_info(size: tuple[int, int], fps: int) -> dict[str, Any]:
    """The `info` of a depth feature, from which LeRobot decodes distances; `size` is (width, height)."""
    return {
        **video_info(size, "hevc", "gray12le", fps, channels=1),
        "video.g": _GOP,
        "video.crf": _CRF,
        "video.preset": None,
        "video.fast_decode": 0,
        "video.video_backend": "pyav",
        "video.extra_options": {"x265-params": _PARAMETERS},
        "video.depth_min": _NEAREST,
        "video.depth_max": _FARTHEST,
        "video.shift": _SHIFT,
        "video.use_log": True,
        "is_depth_map": True,
        "depth_unit": "m",
    }
