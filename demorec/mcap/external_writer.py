"""Writes an external episode as it comes into NAME.mcap.part, which becomes NAME.mcap when it is complete.

As in `demorec.mcap.writer`, a second is gathered and written at once. The images of it go in front of the frames
that hold them, so that whatever a crash leaves of the frames has its images.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.core.config import VideoConfig
from demorec.core.errors import ConfigError, RecordingError
from demorec.episode.episode import NO_PICTURE, SampledFrame
from demorec.episode.info import Camera, EpisodeInfo
from demorec.episode.validity import find_problems
from demorec.mcap import messages, metadata
from demorec.mcap.cdr import encode
from demorec.mcap.channels import TF, TF_STATIC, camera_topic, description_topic
from demorec.mcap.file_writer import FileWriter
from demorec.mcap.frame_check import SampledFrameCheck
from demorec.mcap.lossless import encode_distances
from demorec.mcap.pictures import PictureCoder
from demorec.mcap.streams import FRAMES, SUBTASK, feature_streams, frames_layout, tf_stream
from demorec.mcap.transforms import FrameTree, camera_frame

_SECOND_NS = 1_000_000_000


class _Pictures(PictureCoder):
    """The images of one camera on their way into the file."""

    def __init__(self, camera: Camera, video: VideoConfig, fps: int) -> None:
        super().__init__(camera, video, fps)
        self._stamps: list[int] = []

    @property
    def num_taken(self) -> int:
        """How many have been taken to be written."""
        return self.num_ready - len(self._packets)

    def add(self, stamp_ns: int, data: NDArray[Any] | bytes) -> int:
        """Take the next image; return its number."""
        number = self.num_taken + len(self._stamps)
        self._stamps.append(stamp_ns)
        self.last_ns = stamp_ns
        if isinstance(data, bytes):
            self._keep([data])
        elif self._encoder is None:
            self._keep([encode_distances(data)])
        else:
            self._code(data)
        return number

    def take(self) -> list[tuple[int, bytes]]:
        """Stamp and bytes of the images that have left the encoder, each once."""
        packets, self._packets = self._packets, []
        taken = list(zip(self._stamps, packets, strict=False))
        del self._stamps[: len(packets)]
        return taken


class EpisodeWriter(FileWriter[_Pictures]):
    """Context manager that writes one external episode; left without `finish`, NAME.mcap.part stays for `recover`.

    Frames must not be changed after they were given.

    Args:
        path: The file to be made; its folder must exist.
        info: Written first.
        video: How images are encoded that come as pixels.
        overwrite: Whether a recording of that name may be replaced.
        begins: Whether all of `info` is known. Else only file and encoders are opened, and `begin` must follow.

    Raises:
        ConfigError: The description is impossible, or the file, or an unfinished one of that name, is there already and
            not to be replaced. What a killed import of the same files by the same mapping left is replaced.
        RecordingError: It cannot be written.
    """

    def __init__(
        self,
        path: Path,
        info: EpisodeInfo,
        *,
        video: VideoConfig | None = None,
        overwrite: bool = False,
        begins: bool = True,
    ) -> None:
        if begins:
            self._describe(info)
        self._cameras = {camera.name: _Pictures(camera, video or VideoConfig(), info.fps) for camera in info.cameras}
        self._pending: list[SampledFrame] = []
        super().__init__(path, info, overwrite=overwrite)
        if begins:
            self._write_description()

    def begin(self, info: EpisodeInfo) -> None:
        """Say what the episode is, of which only the cameras were known; before its first image and frame.

        Raises:
            ConfigError: The description is impossible.
            RecordingError: The disk is full; nothing of the episode is left then.
        """
        self._describe(info)
        self._write_description()

    def _describe(self, info: EpisodeInfo) -> None:
        if wrong := find_problems(info):
            raise ConfigError(f"The episode cannot be recorded: {'; '.join(wrong)}.")
        self._info = info
        self._check = SampledFrameCheck(info)
        self._streams = feature_streams(info)
        self._frames_layout = frames_layout(info)
        self._tree = FrameTree(info) if info.urdf else None
        self._tf = tf_stream(self._tree) if self._tree is not None and self._tree.moving else None

    def _write_description(self) -> None:
        """Write what is said once, or leave nothing."""
        try:
            streams = {name: metadata.CameraStreams(video=camera.settings) for name, camera in self._cameras.items()}
            self._file.metadata(metadata.EXTERNAL, metadata.episode_metadata(self._info, streams))
            if self._tree is not None:
                urdf = encode(messages.STRING, self._info.urdf)
                self._file.log(description_topic(), messages.STRING, urdf, 0, latched=True)
                static = messages.transforms(self._tree.static)
                self._file.log(TF_STATIC, messages.TRANSFORMS, static, 0, latched=True)
            for camera in self._info.cameras:
                if camera.intrinsics is not None:
                    size, intrinsics = (camera.height, camera.width), np.array(camera.intrinsics).reshape(3, 3)
                    distortion = camera.distortion or (0.0,) * 5
                    data = messages.camera_info(camera_frame(camera.name), size, intrinsics, distortion)
                    topic = camera_topic(camera.name, "camera_info")
                    self._file.log(topic, messages.CAMERA_INFO, data, 0, latched=True)
            self._file.flush()
        except BaseException:
            self._file.discard()
            raise

    def picture(self, camera: str, stamp_ns: int, data: NDArray[Any] | bytes) -> int:
        """Add the next image of a camera, and return its number, by which frames hold it.

        Args:
            camera: One of the episode's.
            stamp_ns: When it was taken, by the camera's clock; later than the one before.
            data: (H, W, 3) uint8 RGB; for a camera whose images are kept an access unit (H.264 and H.265 with start
                codes), a temporal unit (AV1) or a JPEG file, which stays as it is; for a depth camera (H, W) uint16
                millimetres or float32 metres.

        Raises:
            RecordingError: An unknown camera, another size or type, or a stamp that goes backwards.
        """
        self._check.check_picture(camera, stamp_ns, data)
        self._check.note_picture(camera, stamp_ns)
        return self._cameras[camera].add(int(stamp_ns), data)

    def write(self, frame: SampledFrame) -> None:
        """Add the next frame.

        Raises:
            RecordingError: Features missing or unknown, of another length or type, numbers that are not finite, stamps
                that go backwards, an image that is not there, or a full disk.
        """
        self._check.check_frame(frame)
        self._check.note_frame(frame)
        self._pending.append(frame)
        self.num_frames += 1
        if frame.time_ns - self._pending[0].time_ns >= _SECOND_NS or len(self._pending) > self._info.fps:
            self.flush()

    def flush(self) -> None:
        """Write what is complete: when this returns, it survives the end of this process.

        Raises:
            RecordingError: The disk is full or gone.
        """
        num_taken = 0
        for camera in self._cameras.values():
            for stamp, packet in camera.take():
                num_taken += 1
                for message in camera.topics.of(stamp, packet):
                    self._file.log(*message, stamp)
        if num_taken:
            self._file.flush()
        frames = self._pending[: self._count_ready()]
        if not frames:
            return
        times = [frame.time_ns for frame in frames]
        encoded = []
        for name, stream in self._streams.items():
            samples = [frame.samples[name] for frame in frames]
            data = stream.encode([sample.stamp_ns for sample in samples], [sample.vector for sample in samples])
            encoded.append((self._file.logger(stream.topic, stream.schema), data))
        if self._tree is not None and self._tf is not None:
            data = self._tf.encode(times, self._tree.parts_of_samples(frames))
            encoded.append((self._file.logger(TF, messages.TRANSFORMS), data))
        rows = np.array([self._row(frame) for frame in frames], dtype=np.int64)
        rows_data = self._frames_layout.encode(np.array(times, dtype=np.int64), rows)
        encoded.append((self._file.logger(FRAMES, messages.INT64_ARRAY), rows_data))
        for index, time in enumerate(times):
            for log, data in encoded:
                log(data[index], log_time=time)
            if text := frames[index].subtask:
                self._file.log(SUBTASK, messages.STRING, encode(messages.STRING, text), time)
        self._file.flush()
        del self._pending[: len(frames)]

    def _count_ready(self) -> int:
        """Of the pending frames, how many have all their images written: an encoder may hold some back."""
        for index, frame in enumerate(self._pending):
            if any(number >= self._cameras[name].num_taken for name, number in frame.pictures.items()):
                return index
        return len(self._pending)

    def _row(self, frame: SampledFrame) -> list[int]:
        stamps = [int(frame.samples[name].stamp_ns) for name in self._streams]
        return stamps + [int(frame.pictures.get(name, NO_PICTURE)) for name in self._cameras]

    def _write_rest(self) -> None:
        self.flush()
        if self._pending:
            raise RecordingError(f"The video encoder kept images of the last {len(self._pending)} frames to itself.")

    def discard(self) -> None:
        """Give the episode up and remove what was written of it."""
        self._file.discard()
