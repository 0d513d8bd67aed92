"""Variation of episodes: presets, all ranges in one place, and the form of recorded camera errors.

A field that is None takes the preset's range. Ranges are sampled uniformly; a single number is the size of a symmetric
spread, or a probability. Sampled values are recorded: in the scene if they are part of it, otherwise in
`EpisodeInfo.behaviour`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal, get_args

import numpy as np

from demorec.core.errors import OptionError
from demorec.core.geometry import Pose, angle_between
from demorec.episode.scene import SceneCamera

Range = tuple[float, float]
Preset = Literal["none", "mild", "full"]
PRESET_NAMES: tuple[Preset, ...] = get_args(Preset)
_Value = Range | float | None


def _within(low: float, high: float, *, none: _Value = None, mild: _Value = None, full: _Value = None) -> Any:
    """Define a field of `Ranges`.

    Args:
        low, high: Limits for the user.
        none, mild, full: Default in the preset of that name. A missing one equals that of the previous preset; if it is
            missing in "none", the task decides.
    """
    mild = none if mild is None else mild
    presets = {"none": none, "mild": mild, "full": mild if full is None else full}
    return field(default=None, metadata={"limits": (low, high), **presets})


@dataclass(frozen=True, kw_only=True)
class Ranges:
    """Ranges of everything that varies from episode to episode; None: the preset's range."""

    cube_side: Range | None = _within(0.02, 0.065)
    """Side of cubes, m (auto: each task's own range)."""
    cube_mass: Range | None = _within(0.005, 1.0)
    """Mass of cubes, kg (auto: each task's own range)."""
    cube_friction: Range | None = _within(0.1, 3.0)
    """Friction of cubes (auto: each task's own range)."""
    held_out_x: Range | None = _within(0.0, 1.0, none=(0.45, 0.55))
    """x of the rectangle that --split train avoids and --split eval starts in, m."""
    held_out_y: Range | None = _within(-1.0, 1.0, none=(0.05, 0.15))
    """y of that rectangle, m."""
    joint_spread: float | None = _within(0.0, 0.3, none=0.0, mild=0.05, full=0.1)
    """Maximum deviation of the arm's start from its home configuration, rad per joint."""
    mass_factor: Range | None = _within(0.1, 5.0, none=(1.0, 1.0), full=(0.8, 1.25))
    """Factor on the mass of movable bodies."""
    friction_factor: Range | None = _within(0.1, 5.0, none=(1.0, 1.0), full=(0.85, 1.2))
    """Factor on the friction of movable bodies."""
    damping: Range | None = _within(0.0, 5.0, none=(0.04, 0.04), full=(0.0, 0.1))
    """Linear and angular damping of movable bodies, 1/s."""
    gravity_offset: Range | None = _within(-5.0, 5.0, none=(0.0, 0.0), full=(-0.15, 0.15))
    """Offset added to gravity, m/s^2."""
    table_height: Range | None = _within(-0.08, 0.0, none=(0.0, 0.0), full=(-0.03, 0.0))
    """Table top relative to the robot's base, m."""
    distractors: tuple[int, int] | None = _within(0, 6, none=(0, 0), full=(0, 3))
    """Number of distractor objects on the table."""

    speed: Range | None = _within(0.2, 2.0, none=(1.0, 1.0), full=(0.6, 1.5))
    """Factor on the expert's speeds."""
    approach_height: Range | None = _within(0.05, 0.25, none=(0.12, 0.12), full=(0.08, 0.18))
    """Approach height above the grasp, m."""
    lift_height: Range | None = _within(0.05, 0.25, none=(0.15, 0.15), full=(0.10, 0.20))
    """Lift height above the grasp, m."""
    grasp_offset: Range | None = _within(-0.015, 0.015, none=(0.0, 0.0), full=(-0.005, 0.005))
    """Shift of the grasp along the fingers' faces, m."""
    # Clean demonstrations teach little: a policy that leaves their narrow path has never seen the way back. Noise of
    # 0.02 rad with clean labels tripled the success of behaviour cloning (15 to 45 of 50).
    action_noise: Range | None = _within(0.0, 0.06, none=(0.0, 0.0), mild=(0.02, 0.02), full=(0.01, 0.025))
    """Standard deviation of the noise on executed joint targets, rad; labels stay clean."""
    miss_probability: float | None = _within(0.0, 1.0, none=0.0, full=0.1)
    """Probability that the expert deliberately misses first, and recovers."""
    miss_distance: Range | None = _within(0.02, 0.08, none=(0.03, 0.05))
    """Error of a deliberate miss, m; larger where the fingers would touch the object."""
    # No perception error even in "full": the label would point to an empty place.
    perception_error: float | None = _within(0.0, 0.02, none=0.0)
    """Standard deviation of perceived object positions, m; degrades the labels."""
    perception_yaw: float | None = _within(0.0, 0.2, none=0.0)
    """Standard deviation of perceived object yaws, rad; degrades the labels."""

    camera_position: float | None = _within(0.0, 0.3, none=0.0, full=0.03)
    """Jitter of each camera's position, m per axis."""
    camera_rotation: float | None = _within(0.0, 0.5, none=0.0, full=0.04)
    """Jitter of each camera's rotation, rad per axis."""
    camera_fov: float | None = _within(0.0, 0.3, none=0.0, full=0.05)
    """Jitter of each camera's field of view, relative."""
    calibration_position: float | None = _within(0.0, 0.1, none=0.0, full=0.003)
    """Error of the recorded camera positions, m per axis."""
    calibration_rotation: float | None = _within(0.0, 0.2, none=0.0, full=0.01)
    """Error of the recorded camera rotations, rad per axis."""

    light_turn: Range | None = _within(-7.0, 7.0, none=(0.0, 0.0), full=(-3.1416, 3.1416))
    """Rotation of the light about the vertical, rad."""
    light_elevation: Range | None = _within(0.2, 1.57, none=(1.0, 1.0), full=(0.7, 1.4))
    """Elevation of the light above the horizon, rad."""
    light_ambient: Range | None = _within(0.0, 1.0, none=(0.5, 0.5), full=(0.35, 0.6))
    """Ambient coefficient."""
    light_diffuse: Range | None = _within(0.0, 1.0, none=(0.55, 0.55), full=(0.4, 0.7))
    """Diffuse coefficient."""
    light_shadow: Range | None = _within(0.0, 1.0, none=(0.6, 0.6), full=(0.3, 0.8))
    """Darkness of shadows, 0..1."""
    light_warmth: Range | None = _within(-1.0, 1.0, none=(0.0, 0.0), full=(-1.0, 1.0))
    """Colour of the light, from bluish (-1) to reddish (1)."""
    sky_brightness: Range | None = _within(0.0, 1.5, none=(1.0, 1.0), full=(0.4, 1.1))
    """Factor on the background's colour."""
    object_shade: float | None = _within(0.0, 0.5, none=0.0, full=0.15)
    """Relative spread of the brightness of objects and targets; their colour names stay valid."""
    surface_color: float | None = _within(0.0, 1.0, none=0.0, full=1.0)
    """Maximum deviation of table and floor from their own colour, 0..1."""
    texture_probability: float | None = _within(0.0, 1.0, none=0.0, full=0.6)
    """Probability that table or floor has a procedural texture."""

    def range(self, name: str) -> Range:
        """Return the (low, high) of a resolved field."""
        low, high = getattr(self, name)
        return float(low), float(high)

    def number(self, name: str) -> float:
        """Return the value of a resolved field that is a single number."""
        return float(getattr(self, name))

    def draw(self, name: str, rng: np.random.Generator) -> float:
        """Draw a number from a resolved range."""
        return float(rng.uniform(*self.range(name)))

    def validate(self) -> None:
        """Raise OptionError if a range is reversed or out of bounds."""
        for own in fields(self):
            value = getattr(self, own.name)
            if value is None:
                continue
            low, high = own.metadata["limits"]
            pair = value if isinstance(value, tuple) else (value, value)
            if not (low <= pair[0] <= pair[1] <= high):
                what = f"from {pair[0]:g} to {pair[1]:g}" if isinstance(value, tuple) else f"{value:g}"
                raise OptionError(own.name, f"is {what}; it must be within {low:g} to {high:g}, the lower end first.")


PRESETS: Mapping[Preset, Ranges] = {
    preset: Ranges(**{own.name: own.metadata[preset] for own in fields(Ranges)}) for preset in PRESET_NAMES
}


def resolve(preset: Preset, overrides: Ranges) -> Ranges:
    """Combine the preset's ranges with the user's; only cube_* may remain None."""
    chosen = {own.name: getattr(overrides, own.name) for own in fields(overrides)}
    return replace(PRESETS[preset], **{name: value for name, value in chosen.items() if value is not None})


_ERROR_WORDS = ("x", "y", "z", "angle", "qx", "qy", "qz")


def error_values(errors: Mapping[str, Pose]) -> dict[str, float]:
    """Convert deliberate errors of recorded camera poses to their form in an episode's behaviour.

    `errors` has camera name -> true_from_recorded. Each error gives `calibration_NAME_x`, `_y`, `_z` (m), `_angle`
    (rad), and x, y, z of the quaternion, with positive w, as `_qx`, `_qy`, `_qz`.
    """
    values: dict[str, float] = {}
    for name, error in errors.items():
        if error != Pose():
            x, y, z, w = error.quat_xyzw
            turn = math.copysign(1.0, w) * np.array([x, y, z])
            numbers = (*error.position, angle_between(error, Pose()), *turn)
            words = (f"calibration_{name}_{word}" for word in _ERROR_WORDS)
            values |= {word: float(number) for word, number in zip(words, numbers, strict=True)}
    return values


def stated_error(name: str, behaviour: Mapping[str, float]) -> Pose | None:
    """Read true_from_recorded of a camera from an episode's behaviour; None if missing or not finite."""
    numbers = np.array([behaviour.get(f"calibration_{name}_{word}", math.nan) for word in _ERROR_WORDS])
    position, turn = numbers[:3], numbers[4:]
    sine = float(np.linalg.norm(turn))
    if not np.isfinite(numbers).all() or sine >= 1.0:
        return None
    return Pose(position=position, quat_xyzw=np.array([*turn, math.sqrt(1.0 - sine * sine)]))


def true_cameras(
    recorded: Sequence[SceneCamera], behaviour: Mapping[str, float]
) -> tuple[tuple[SceneCamera, ...], dict[str, Pose]]:
    """Return the cameras at their true poses, and camera name -> true_from_recorded of those with an error.

    Generation draws from these cameras, so that a recording alone reproduces its images.
    """
    found = {camera.name: stated_error(camera.name, behaviour) for camera in recorded}
    errors = {name: error for name, error in found.items() if error is not None}
    cameras = []
    for camera in recorded:
        if camera.name in errors:
            true = camera.mount_from_camera @ errors[camera.name].inverse()
            camera = replace(camera, mount_from_camera=true)
        cameras.append(camera)
    return tuple(cameras), errors
