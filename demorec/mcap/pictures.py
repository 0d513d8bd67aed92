"""The picture streams of one camera: colour as video, depth, segmentation, and the statistics of the colours."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from numpy.typing import NDArray

from demorec.core.config import VideoConfig
from demorec.core.errors import RecordingError
from demorec.episode.episode import CameraImages, Frame
from demorec.episode.external import Camera
from demorec.episode.scene import SceneCamera
from demorec.mcap import messages
from demorec.mcap.channels import camera_topic, video_topic
from demorec.mcap.depth import FORMAT as DEPTH_FORMAT
from demorec.mcap.depth import encode_depth
from demorec.mcap.labels import FORMAT as LABELS_FORMAT
from demorec.mcap.labels import encode_labels
from demorec.mcap.metadata import CameraStreams
from demorec.mcap.pixels import PixelCounter
from demorec.mcap.transforms import camera_frame
from demorec.mcap.video import Rgb, make_encoder, settings_of_coded

Message = tuple[str, str, bytes]
"""Topic, type, bytes."""


_OTHERS: dict[str, tuple[str, Callable[[Any], bytes]]] = {
    "depth": (DEPTH_FORMAT, encode_depth),
    "segmentation": (LABELS_FORMAT, encode_labels),
}
"""Pictures beside colour: stream -> its format, and how one is coded."""


class PictureTopics:
    """Where the coded pictures of one camera go, be they of colours or of distances.

    Args:
        camera: The camera.
        codec: Of the pictures.
    """

    def __init__(self, camera: SceneCamera | Camera, codec: str) -> None:
        self._codec, self._size = codec, (camera.height, camera.width)
        self._topic, self._again_topic = video_topic(camera.name, codec), camera_topic(camera.name, "video")
        self._frame_id = camera_frame(camera.name)
        self._layout = messages.PictureMessages(self._frame_id, DEPTH_FORMAT if codec == "16UC1" else codec)

    def of(self, time_ns: int, packet: bytes) -> list[Message]:
        """The messages of one picture."""
        if self._codec == "av1":
            data = messages.protobuf_video(time_ns, self._frame_id, self._codec, packet)
            return [(self._topic, messages.PROTOBUF_VIDEO, data)]
        if self._codec == "32FC1":
            data = messages.image(time_ns, self._frame_id, self._codec, self._size, packet)
            return [(self._topic, messages.IMAGE, data)]
        result = [(self._topic, messages.COMPRESSED_IMAGE, self._layout.compressed_image(time_ns, packet))]
        if self._codec in ("h264", "h265"):
            # The same bytes once more, as Foxglove wants them; next to the first, compression folds them.
            again = self._layout.compressed_video(time_ns, packet)
            result.append((self._again_topic, messages.COMPRESSED_VIDEO, again))
        return result


class PictureCoder:
    """Codes the pictures of one camera and keeps the packets until they are written.

    Args:
        camera: The camera.
        video: How colours are coded, where they do not come so.
        fps: Of the episode.
        compiled: Whether pixels are counted by a compiled function.

    Attributes:
        settings: How the pictures are coded.
        topics: Where they go.
        num_ready: Packets so far.
        num_video_bytes: Of them.
        last_ns: Stamp of the last picture.
    """

    def __init__(self, camera: SceneCamera | Camera, video: VideoConfig, fps: int, *, compiled: bool = False) -> None:
        self._encoder, self._pixels = None, PixelCounter(compiled=compiled)
        if isinstance(camera, Camera) and camera.kept:
            self.settings = settings_of_coded(camera.kept, camera.width, camera.height, fps)
        else:
            self._encoder = make_encoder(video, camera.width, camera.height, fps)
            self.settings = self._encoder.settings
        self.topics = PictureTopics(camera, self.settings.codec)
        self._name = camera.name
        self._packets: list[bytes] = []
        self.num_ready = self.num_video_bytes = self.last_ns = 0

    def _code(self, picture: Rgb) -> None:
        assert self._encoder is not None
        self._pixels.add(picture)
        self._keep(self._encoder.encode(picture))

    def _keep(self, packets: list[bytes]) -> None:
        self._packets += packets
        self.num_ready += len(packets)
        self.num_video_bytes += sum(map(len, packets))

    def end(self) -> None:
        """Take what the encoder held back."""
        if self._encoder is not None:
            self._keep(self._encoder.finish())

    def statistics(self) -> Message | None:
        """What was counted of all pictures; None where nothing was."""
        if self._encoder is None or not self.num_ready:
            return None
        data = messages.pixel_statistics(self._pixels.statistics())
        return camera_topic(self._name, "histogram"), messages.INT64_ARRAY, data


class CameraRecorder(PictureCoder):
    """Codes what a camera sees and keeps it until it is written.

    Attributes:
        streams: What is recorded; depth and segmentation when the first frame has them.
    """

    def __init__(self, camera: SceneCamera, first: CameraImages, *, video: VideoConfig, fps: int) -> None:
        self._camera = camera
        super().__init__(camera, video, fps, compiled=True)
        self.streams = CameraStreams(
            video=self.settings, depth=first.depth is not None, segmentation=first.segmentation is not None
        )
        frame_id = camera_frame(camera.name)
        self._layouts = {kind: messages.PictureMessages(frame_id, form) for kind, (form, _) in _OTHERS.items()}
        self._others: list[list[Message]] = []

    def add(self, frame: Frame) -> None:
        """Take the camera's pictures of the next frame.

        Raises:
            RecordingError: A picture is missing or of another size.
        """
        name = self._camera.name
        images = frame.images.get(name)
        if images is None:
            raise RecordingError(f"Frame {frame.frame_index} has no picture of the camera {name!r}.")
        self._check(frame.frame_index, "colour", images.color, True)
        for kind in _OTHERS:
            self._check(frame.frame_index, kind, getattr(images, kind), getattr(self.streams, kind))
        self._code(images.color)
        self.last_ns = frame.time_ns
        others: list[Message] = []
        for kind, (_, encode) in _OTHERS.items():
            if (pixels := getattr(images, kind)) is not None:
                data = self._layouts[kind].compressed_image(frame.time_ns, encode(pixels))
                others.append((camera_topic(name, kind), messages.COMPRESSED_IMAGE, data))
        self._others.append(others)

    def _check(self, frame_index: int, kind: str, pixels: NDArray[Any] | None, is_recorded: bool) -> None:
        size = (self._camera.height, self._camera.width)
        if (pixels is not None) != is_recorded or (pixels is not None and pixels.shape[:2] != size):
            found = "is missing" if pixels is None else f"has shape {pixels.shape}"
            raise RecordingError(
                f"The {kind} picture of the camera {self._camera.name!r} at frame {frame_index} {found}: every frame "
                f"has the same pictures of {size[1]}x{size[0]} pixels."
            )

    def take_messages(self, time_ns: list[int]) -> Iterator[list[Message]]:
        """The messages of the oldest frames that are not yet written, one list a frame."""
        count = len(time_ns)
        for time, packet, others in zip(time_ns, self._packets[:count], self._others[:count], strict=True):
            yield self.topics.of(time, packet) + others
        del self._packets[:count]
        del self._others[:count]
