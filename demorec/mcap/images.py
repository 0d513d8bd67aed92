"""Encoding of the images of one camera for a file, and statistics of their pixels.

Pixels are counted while recording, so that the export of a dataset decodes nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.core.config import VideoConfig
from demorec.episode.info import Camera
from demorec.mcap import messages
from demorec.mcap.cdr import decode, encode
from demorec.mcap.channels import Message, camera_topic, video_topic
from demorec.mcap.lossless import DEPTH_FORMAT, LABELS_FORMAT, encode_depth, encode_distances, encode_labels
from demorec.mcap.metadata import CameraStreams
from demorec.mcap.transforms import camera_frame
from demorec.mcap.video import make_encoder, settings_of_coded

_MOST_PIXELS = 1 << 50
"""Maximum count of one value in a histogram: sums of counts stay exact in float64."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PixelStatistics:
    """Histograms of a camera's images."""

    counts: NDArray[np.int64]  # (3, 256) number of pixels with each value, for red, green and blue
    num_images: int  # number of images counted


class PixelCounter:
    """Counts every other image (90 of 180 frames, where LeRobot's writer uses 100), and subsamples large ones.

    LeRobot (`compute_stats.py`) spreads its sample evenly over an episode of known length; here the length is not known
    yet. Only every fourth row of an image is counted, a different quarter each time.
    """

    def __init__(self) -> None:
        self._counts = np.zeros((3, 256), dtype=np.int64)
        self._num_seen = 0
        self._num_images = 0

    def add(self, image: NDArray[np.uint8]) -> None:
        """Count the next image, (H, W, 3) uint8."""
        if self._num_seen % 2 == 0:
            longer_side = max(image.shape[:2])
            step = longer_side // 150 if longer_side >= 300 else 1
            first_row = step * (self._num_images % 4)
            for counts, channel in zip(self._counts, np.moveaxis(image, 2, 0), strict=True):
                counts += np.bincount(channel[first_row :: 4 * step, ::step].ravel(), minlength=256)
            self._num_images += 1
        self._num_seen += 1

    def statistics(self) -> PixelStatistics:
        """Return the current counts."""
        return PixelStatistics(counts=self._counts.copy(), num_images=self._num_images)


def pixel_statistics(statistics: PixelStatistics) -> bytes:
    """Encode as std_msgs/Int64MultiArray: the number of counted images, then a table of 3 x 256 counts."""
    dimensions = (("red, green, blue", 3, 3 * 256), ("value", 256, 256))
    data_offset = 1  # values in front of the table
    values = np.concatenate(([statistics.num_images], statistics.counts.reshape(-1)))
    return encode(messages.INT64_ARRAY, (dimensions, data_offset), values)


def read_pixel_statistics(data: bytes) -> PixelStatistics:
    """Decode the message of `pixel_statistics`."""
    values = decode(messages.INT64_ARRAY, data)[0]["data"]
    if len(values) != 1 + 3 * 256 or not ((values >= 0) & (values < _MOST_PIXELS)).all():
        raise ValueError("a histogram whose numbers are not counts")
    return PixelStatistics(num_images=int(values[0]), counts=values[1:].reshape(3, 256).copy())


_BESIDE: Mapping[str, tuple[str, Callable[[Any], bytes]]] = {
    "depth": (DEPTH_FORMAT, encode_depth),
    "segmentation": (LABELS_FORMAT, encode_labels),
}
"""Non-colour images: stream -> its format and encoder."""


class CameraWriter:
    """Encodes the images of one camera, and keeps their messages until they are written.

    Args:
        video: Encoding of colour images, unless they arrive encoded.
        beside: Streams of images that accompany each colour image: "depth", "segmentation".
    """

    def __init__(self, camera: Camera, video: VideoConfig, fps: int, *, beside: Sequence[str] = ()) -> None:
        self.camera = camera
        self._encoder, self._pixels = None, PixelCounter()
        if camera.kept:
            settings = settings_of_coded(camera.kept, camera.width, camera.height, fps)
        else:
            self._encoder = make_encoder(video, camera.width, camera.height, fps)
            settings = self._encoder.settings
        self.streams = CameraStreams(
            video=settings, depth=camera.is_depth or "depth" in beside, segmentation="segmentation" in beside
        )
        self._frame_id = camera_frame(camera.name)
        self._waiting: list[tuple[int, list[Message]]] = []
        self._packets: list[bytes] = []
        self._num_images = 0
        self.num_ready = 0  # images that have left the encoder
        self.last_ns = 0  # timestamp of the last image

    def add(self, stamp_ns: int, data: NDArray[Any] | bytes, **beside: NDArray[Any] | None) -> int:
        """Add the next image: pixels, distances, or an encoded packet; return its number."""
        if self._encoder is None:
            self._keep([data if isinstance(data, bytes) else encode_distances(data)])
        else:
            image = np.asarray(data)
            self._pixels.add(image)
            self._keep(self._encoder.encode(image))
        others: list[Message] = []
        for kind, pixels in beside.items():
            if pixels is not None:
                image_format, pack = _BESIDE[kind]
                packed = messages.compressed_image(stamp_ns, self._frame_id, image_format, pack(pixels))
                others.append((camera_topic(self.camera.name, kind), messages.COMPRESSED_IMAGE, packed))
        self._waiting.append((stamp_ns, others))
        self.last_ns = stamp_ns
        self._num_images += 1
        return self._num_images - 1

    def _keep(self, packets: list[bytes]) -> None:
        self._packets += packets
        self.num_ready += len(packets)

    def end(self) -> None:
        """Collect the images still in the encoder."""
        if self._encoder is not None:
            self._keep(self._encoder.finish())

    def take(self, until: int) -> list[tuple[int, list[Message]]]:
        """Return timestamp and messages of the encoded images before a number, each once."""
        count = max(0, until - (self.num_ready - len(self._packets)))
        pairs = zip(self._waiting, self._packets[:count], strict=False)
        taken = [(stamp, self._messages(stamp, packet) + others) for (stamp, others), packet in pairs]
        del self._packets[:count], self._waiting[: len(taken)]
        return taken

    def _messages(self, time_ns: int, packet: bytes) -> list[Message]:
        camera, codec, frame_id = self.camera, self.streams.video.codec, self._frame_id
        topic = video_topic(camera.name, codec)
        if codec == "av1":
            return [(topic, messages.PROTOBUF_VIDEO, messages.protobuf_video(time_ns, frame_id, codec, packet))]
        if codec == "32FC1":
            data = messages.image(time_ns, frame_id, codec, (camera.height, camera.width), packet)
            return [(topic, messages.IMAGE, data)]
        image_format = DEPTH_FORMAT if codec == "16UC1" else codec
        data = messages.compressed_image(time_ns, frame_id, image_format, packet)
        result = [(topic, messages.COMPRESSED_IMAGE, data)]
        if codec in ("h264", "h265"):
            # The same bytes again in Foxglove's type; next to the first, compression removes the duplicate.
            again = messages.compressed_video(time_ns, frame_id, codec, packet)
            result.append((camera_topic(camera.name, "video"), messages.COMPRESSED_VIDEO, again))
        return result

    def statistics(self) -> Message | None:
        """Return the statistics of all images as a message; None if nothing was counted."""
        if self._encoder is None or not self.num_ready:
            return None
        data = pixel_statistics(self._pixels.statistics())
        return camera_topic(self.camera.name, "histogram"), messages.INT64_ARRAY, data
