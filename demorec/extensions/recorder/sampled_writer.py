"""Writer of episodes that demorec does not simulate: images have their own times, and several frames may share one.

Images are written before the frames that show them, so that all frames left by a crash have their images.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import RecordingError
from demorec.core.geometry import Array
from demorec.core.registry import nearest_match
from demorec.episode.episode import MAX_STAMP_NS, MAX_SUBTASK, SampledFrame
from demorec.episode.info import Camera, EpisodeInfo
from demorec.mcap import messages
from demorec.mcap.cdr import encode
from demorec.mcap.channels import SUBTASK, feature_topic
from demorec.mcap.images import CameraWriter
from demorec.mcap.lossless import DEPTH_TYPES
from demorec.mcap.transforms import FrameTree, joint_places, joint_positions
from demorec.mcap.writer import BatchWriter
from demorec.robots.urdf import Urdf


class SampledWriter(BatchWriter):
    """Context manager that writes an episode of another robot or program; arguments and errors as in `BatchWriter`."""

    def _prepare(self, info: EpisodeInfo) -> FrameTree | None:
        self._check = SampledFrameCheck(info)
        self._cameras = {camera.name: CameraWriter(camera, self._video, info.fps) for camera in info.cameras}
        self._places = joint_places(info.features)
        return FrameTree(Urdf.parse(info.urdf), [*self._places], info.cameras) if info.urdf else None

    def _state(self, vectors: Mapping[str, Array]) -> tuple[Array, Array]:
        features = {name: vectors[feature_topic(name)] for name in self._check.features}
        positions = joint_positions(self._places, features)
        return positions, np.empty((len(positions), 0))

    def image(self, camera: str, stamp_ns: int, data: NDArray[Any] | bytes) -> int:
        """Add the next image of a camera; return its number, which frames refer to.

        Args:
            camera: A camera of the episode.
            stamp_ns: Capture timestamp, by the camera's clock; later than the previous one.
            data: (H, W, 3) uint8 RGB; for a passthrough camera an access unit (H.264 and H.265 with start codes), a
                temporal unit (AV1) or a JPEG file, stored unchanged; for a depth camera (H, W) uint16 millimetres or
                float32 metres.

        Raises:
            RecordingError: Unknown camera, wrong size or type, or a timestamp that goes backwards.
        """
        self._check.check_image(camera, stamp_ns, data)
        self._check.note_image(camera, stamp_ns)
        return self._cameras[camera].add(int(stamp_ns), data)

    def write(self, frame: SampledFrame) -> None:
        """Add the next frame.

        Raises:
            RecordingError: Frames are out of order; features are missing, unknown, of a wrong length or type, or not
                finite; images have not arrived; or the disk is full.
        """
        self._check.check_frame(frame)
        self._check.note_frame(frame)
        text = frame.subtask
        self._add(frame, frame.images, [(SUBTASK, messages.STRING, encode(messages.STRING, text))] if text else [], [])

    def flush(self) -> None:
        """See `BatchWriter`."""
        self._write_images({name: camera.num_ready for name, camera in self._cameras.items()})
        self._write_frames()


class SampledFrameCheck:
    """Validates images and frames in order of arrival, and keeps track of the accepted ones."""

    def __init__(self, info: EpisodeInfo) -> None:
        self.features = {feature.name: feature for feature in info.features}
        self._cameras = {camera.name: camera for camera in info.cameras}
        self.image_stamps: dict[str, int] = {}  # camera -> timestamp of the last accepted image
        self._sample_stamps: dict[str, int] = {}
        self._frame_stamp = -1
        self._num_images = dict.fromkeys(self._cameras, 0)
        self._num_frames = 0

    def check_image(self, camera: str, stamp_ns: int, data: NDArray[Any] | bytes) -> None:
        """Raise RecordingError unless the data can be the next image of the camera."""
        known = self._cameras.get(camera)
        if known is None:
            raise RecordingError(
                f"Unknown camera {camera!r}.{nearest_match(camera, self._cameras)} The cameras are: "
                f"{', '.join(self._cameras) or 'none'}."
            )
        _check_image(known, data)
        _check_stamp(f"The image of the camera {camera!r}", self.image_stamps.get(camera, -1), stamp_ns)

    def note_image(self, camera: str, stamp_ns: int) -> None:
        """Note that the camera's next image was accepted."""
        self.image_stamps[camera] = int(stamp_ns)
        self._num_images[camera] += 1

    def check_frame(self, frame: SampledFrame) -> None:
        """Raise RecordingError unless the frame can be the next one."""
        what = f"frame {self._num_frames}"
        if unknown := [name for name in frame.samples if name not in self.features]:
            raise RecordingError(
                f"{what.capitalize()} has an unknown feature {unknown[0]!r}."
                f"{nearest_match(unknown[0], self.features)} The features are: {', '.join(self.features)}."
            )
        if missing := [name for name in self.features if name not in frame.samples]:
            raise RecordingError(
                f"{what.capitalize()} lacks the feature {', '.join(missing)}: every frame needs every feature."
            )
        for name, feature in self.features.items():
            vector, count = frame.samples[name].vector, len(feature.names)
            if not isinstance(vector, np.ndarray) or vector.dtype != feature.dtype or vector.shape != (count,):
                found = f"{getattr(vector, 'dtype', type(vector).__name__)} of shape {np.shape(vector)}"
                raise RecordingError(
                    f"The feature {name!r} of {what} is {found}, it must be {feature.dtype} of shape ({count},)."
                )
            if not np.isfinite(vector).all():
                wrong = int(np.flatnonzero(~np.isfinite(vector))[0])
                raise RecordingError(
                    f"The feature {name!r} of {what} is {vector[wrong]} in its element {feature.names[wrong]!r}; "
                    "numbers must be finite."
                )
        for camera, number in frame.images.items():
            if camera not in self._cameras or not 0 <= number < self._num_images[camera]:
                count = self._num_images.get(camera, 0)
                raise RecordingError(
                    f"The camera {camera!r} has no image {number} for {what}; images received: {count}."
                )
        if len(frame.subtask) > MAX_SUBTASK or not frame.subtask.isprintable():
            raise RecordingError(f"The subtask of {what} is not a single line of at most {MAX_SUBTASK} characters.")
        for name in self.features:
            stamp = frame.samples[name].stamp_ns
            last = self._sample_stamps.get(name, -1)
            _check_stamp(f"The feature {name!r} of {what}", last, stamp, may_repeat=True)
        _check_stamp(what.capitalize(), self._frame_stamp, frame.time_ns)

    def note_frame(self, frame: SampledFrame) -> None:
        """Note that the next frame was accepted."""
        for name in self.features:
            self._sample_stamps[name] = int(frame.samples[name].stamp_ns)
        self._frame_stamp = int(frame.time_ns)
        self._num_frames += 1


def _check_stamp(what: str, last: int, stamp_ns: int, *, may_repeat: bool = False) -> None:
    if not isinstance(stamp_ns, int | np.integer) or isinstance(stamp_ns, bool):
        raise RecordingError(f"{what} has the stamp {stamp_ns!r}, it must be a whole number of nanoseconds.")
    if not 0 <= stamp_ns <= MAX_STAMP_NS:
        raise RecordingError(f"{what} has the stamp {stamp_ns} ns; the range is 0 to {MAX_STAMP_NS} ns.")
    if stamp_ns < last or (stamp_ns == last and not may_repeat):
        raise RecordingError(
            f"{what} has the stamp {stamp_ns} ns, the one before it {last} ns: stamps must not "
            f"{'go backwards' if stamp_ns < last else 'repeat'}."
        )


def _check_image(camera: Camera, data: NDArray[Any] | bytes) -> None:
    if camera.kept and not camera.is_depth:
        if not isinstance(data, bytes) or not data:
            raise RecordingError(
                f"The image of the camera {camera.name!r} is {type(data).__name__}, it must be bytes of {camera.kept}."
            )
        return
    kind = np.dtype(DEPTH_TYPES.get(camera.kept, np.uint8))
    shape: tuple[int, ...] = (camera.height, camera.width) if camera.is_depth else (camera.height, camera.width, 3)
    if not isinstance(data, np.ndarray) or data.dtype != kind or data.shape != shape:
        found = f"{data.dtype} of shape {data.shape}" if isinstance(data, np.ndarray) else type(data).__name__
        raise RecordingError(
            f"The image of the camera {camera.name!r} is {found}, it must be {kind} of shape {shape}: height, "
            f"width{'' if camera.is_depth else ', RGB'}."
        )
