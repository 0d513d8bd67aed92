"""Deliberate errors of recorded camera poses (`--variation full`), stored among the numbers of the behaviour."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from demorec.core.geometry import Pose, angle_between
from demorec.episode.scene import SceneCamera

ANGLE_MARGIN = 1e-6
"""Maximum disagreement between quaternion and angle, rad."""


def error_values(errors: Mapping[str, Pose]) -> dict[str, float]:
    """Convert errors to their recorded form.

    Args:
        errors: Camera name -> true_from_recorded, with a rotation of less than half a revolution.

    Returns:
        For each camera with an error: `calibration_NAME_x`, `_y`, `_z` (m), `_angle` (rad), and x, y, z of the
            quaternion, with positive w, as `_qx`, `_qy`, `_qz`.
    """
    values: dict[str, float] = {}
    for name, error in errors.items():
        if error != Pose():
            values |= {f"calibration_{name}_{axis}": float(v) for axis, v in zip("xyz", error.position, strict=True)}
            values[f"calibration_{name}_angle"] = angle_between(error, Pose())
            x, y, z, w = error.quat_xyzw
            turn = math.copysign(1.0, w) * np.array([x, y, z])
            values |= {f"calibration_{name}_q{axis}": float(v) for axis, v in zip("xyz", turn, strict=True)}
    return values


def stated_error(name: str, behaviour: Mapping[str, float]) -> Pose | None:
    """Read true_from_recorded of a camera from the recorded numbers.

    Args:
        name: Name of the camera.
        behaviour: Behaviour of the episode, unvalidated from a file.

    Returns:
        The error; None if it is missing or inconsistent.
    """
    words = [f"calibration_{name}_{word}" for word in ("x", "y", "z", "qx", "qy", "qz", "angle")]
    numbers = np.array([behaviour.get(word, math.nan) for word in words])
    position, turn, angle = numbers[:3], numbers[3:6], float(numbers[6])
    size = float(np.linalg.norm(turn))
    if not (np.isfinite(numbers).all() and size < 1.0 and abs(2 * math.asin(size) - angle) <= ANGLE_MARGIN):
        return None
    return Pose(position=position, quat_xyzw=np.array([*turn, math.sqrt(1.0 - size * size)]))


def true_cameras(
    recorded: Sequence[SceneCamera], behaviour: Mapping[str, float]
) -> tuple[tuple[SceneCamera, ...], dict[str, Pose]]:
    """Return the cameras at their true poses, and camera name -> true_from_recorded of those with an error.

    Generation draws from these cameras, so that a recording alone reproduces its images.
    """
    errors: dict[str, Pose] = {}
    cameras = []
    for camera in recorded:
        error = stated_error(camera.name, behaviour)
        if error is not None:
            errors[camera.name] = error
            camera = replace(camera, mount_from_camera=camera.mount_from_camera @ error.inverse())
        cameras.append(camera)
    return tuple(cameras), errors
