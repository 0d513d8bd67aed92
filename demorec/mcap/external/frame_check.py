"""What cannot be recorded of a collected episode is refused at once, in one sentence that names it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import RecordingError
from demorec.core.registry import nearest_match
from demorec.episode.external import Camera, EpisodeInfo, SampledFrame
from demorec.mcap.depth import DEPTH_TYPES

MAX_STAMP_NS = 2**31 * 1_000_000_000 - 1
"""The seconds of a stamp have 31 bits in ROS messages."""

MAX_SUBTASK = 1000
"""Characters."""


class SampledFrameCheck:
    """Looks at pictures and frames in the order in which they come, and is told of those that were taken."""

    def __init__(self, info: EpisodeInfo) -> None:
        self._features = {feature.name: feature for feature in info.features}
        self._cameras = {camera.name: camera for camera in info.cameras}
        self._last: dict[str, int] = {}
        self._num_pictures = dict.fromkeys(self._cameras, 0)
        self._num_frames = 0

    def check_picture(self, camera: str, stamp_ns: int, data: NDArray[Any] | bytes) -> None:
        """Raise RecordingError unless it can be the next picture of the camera."""
        known = self._cameras.get(camera)
        if known is None:
            raise RecordingError(
                f"Unknown camera {camera!r}.{nearest_match(camera, self._cameras)} The cameras are: "
                f"{', '.join(self._cameras) or 'none'}."
            )
        _check_picture(known, data)
        self._check_stamp(f"the picture of the camera {camera!r}", "camera " + camera, stamp_ns, may_repeat=False)

    def note_picture(self, camera: str, stamp_ns: int) -> None:
        """The camera's next picture was taken."""
        self._last["camera " + camera] = int(stamp_ns)
        self._num_pictures[camera] += 1

    def check_frame(self, frame: SampledFrame) -> None:
        """Raise RecordingError unless it can be the next frame."""
        what = f"frame {self._num_frames}"
        _check_names(what, "feature", frame.samples, self._features)
        for name, feature in self._features.items():
            vector, count = frame.samples[name].vector, len(feature.names)
            if not isinstance(vector, np.ndarray) or vector.dtype != feature.dtype or vector.shape != (count,):
                found = f"{getattr(vector, 'dtype', type(vector).__name__)} of shape {np.shape(vector)}"
                raise RecordingError(
                    f"The feature {name!r} of {what} is {found}, it must be {feature.dtype} of shape ({count},)."
                )
            if not np.isfinite(vector).all():
                wrong = int(np.flatnonzero(~np.isfinite(vector))[0])
                raise RecordingError(
                    f"The feature {name!r} of {what} is {vector[wrong]} in its element {feature.names[wrong]!r}, "
                    "numbers must be finite."
                )
        for camera, number in frame.pictures.items():
            if camera not in self._cameras or not 0 <= number < self._num_pictures[camera]:
                count = self._num_pictures.get(camera, 0)
                raise RecordingError(
                    f"The camera {camera!r} has no picture {number} for {what}, it has {count} so far."
                )
        if len(frame.subtask) > MAX_SUBTASK or not frame.subtask.isprintable():
            raise RecordingError(f"The subtask of {what} is no single line of at most {MAX_SUBTASK} characters.")
        for name in self._features:
            stamp = frame.samples[name].stamp_ns
            self._check_stamp(f"the feature {name!r} of {what}", "feature " + name, stamp, may_repeat=True)
        self._check_stamp(what, "frames", frame.time_ns, may_repeat=False)

    def note_frame(self, frame: SampledFrame) -> None:
        """The next frame was taken."""
        for name in self._features:
            self._last["feature " + name] = int(frame.samples[name].stamp_ns)
        self._last["frames"] = int(frame.time_ns)
        self._num_frames += 1

    def _check_stamp(self, what: str, key: str, stamp_ns: int, *, may_repeat: bool) -> None:
        what = what[0].upper() + what[1:]
        if not isinstance(stamp_ns, int | np.integer) or isinstance(stamp_ns, bool):
            raise RecordingError(f"{what} has the stamp {stamp_ns!r}, it must be a whole number of nanoseconds.")
        if not 0 <= stamp_ns <= MAX_STAMP_NS:
            raise RecordingError(f"{what} has the stamp {stamp_ns} ns, allowed are 0 to {MAX_STAMP_NS} ns.")
        last = self._last.get(key, -1)
        if stamp_ns < last or (stamp_ns == last and not may_repeat):
            raise RecordingError(
                f"{what} has the stamp {stamp_ns} ns, the one before it {last} ns: stamps must not "
                f"{'go backwards' if stamp_ns < last else 'stand still'}."
            )


def _check_picture(camera: Camera, data: NDArray[Any] | bytes) -> None:
    if camera.kept and not camera.is_depth:
        if not isinstance(data, bytes) or not data:
            raise RecordingError(
                f"The picture of the camera {camera.name!r} is {type(data).__name__}, it must be bytes of "
                f"{camera.kept}."
            )
        return
    kind = np.dtype(DEPTH_TYPES.get(camera.kept, np.uint8))
    shape: tuple[int, ...] = (camera.height, camera.width) if camera.is_depth else (camera.height, camera.width, 3)
    if not isinstance(data, np.ndarray) or data.dtype != kind or data.shape != shape:
        found = f"{data.dtype} of shape {data.shape}" if isinstance(data, np.ndarray) else type(data).__name__
        raise RecordingError(
            f"The picture of the camera {camera.name!r} is {found}, it must be {kind} of shape {shape}: height, "
            f"width{'' if camera.is_depth else ', RGB'}."
        )


def _check_names(what: str, kind: str, found: Mapping[str, object], known: Mapping[str, object]) -> None:
    if found.keys() == known.keys():
        return
    unknown = [name for name in found if name not in known]
    if unknown:
        raise RecordingError(
            f"{what[0].upper()}{what[1:]} has an unknown {kind} {unknown[0]!r}.{nearest_match(unknown[0], known)} The "
            f"{kind}s are: {', '.join(known)}."
        )
    missing = ", ".join(name for name in known if name not in found)
    raise RecordingError(f"{what[0].upper()}{what[1:]} lacks the {kind} {missing}: every frame has every {kind}.")
