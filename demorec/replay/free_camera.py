"""Cameras that a user describes in a TOML file, to draw recorded states with."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from demorec.core.config import read_toml
from demorec.core.errors import ConfigError, describe_error
from demorec.core.geometry import Pose, look_at
from demorec.core.plain import from_plain
from demorec.episode.scene import SceneCamera


@dataclass(frozen=True, kw_only=True)
class FreeCamera:
    """A camera described in a TOML table of its own; angles in degrees, lengths in metres.

    Attributes:
        position: In the mount's frame.
        look_at: Point that it looks at, in the mount's frame; this or `quat_xyzw`.
        up: Direction that is up in the image.
        quat_xyzw: Rotation mount_from_camera, OpenCV axes, in place of `look_at`.
        fov_y_degrees: Vertical field of view.
        mount: "world", or a link of the robot.
        width, height: Pixels; default: as the other cameras.
    """

    position: tuple[float, float, float]
    look_at: tuple[float, float, float] | None = None
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    quat_xyzw: tuple[float, float, float, float] | None = None
    fov_y_degrees: float = 45.0
    mount: str = "world"
    width: int | None = None
    height: int | None = None

    def camera(self, name: str, *, width: int, height: int) -> SceneCamera:
        """The camera; ConfigError for an impossible description."""
        if (self.look_at is None) == (self.quat_xyzw is None):
            raise ConfigError(f"The camera {name!r} needs either look_at or quat_xyzw, not both and not neither.")
        if not 1.0 <= self.fov_y_degrees <= 170.0:
            raise ConfigError(f"fov_y_degrees of the camera {name!r} is {self.fov_y_degrees}, allowed are 1 to 170.")
        try:
            if self.quat_xyzw is None:
                assert self.look_at is not None
                pose = look_at(self.position, self.look_at, self.up)
            else:
                length = math.sqrt(sum(v * v for v in self.quat_xyzw))
                if abs(length - 1.0) > 1e-3:
                    raise ValueError(f"quat_xyzw has length {length:.4f}, must have 1")
                pose = Pose(position=np.array(self.position), quat_xyzw=np.array(self.quat_xyzw) / length)
        except ValueError as error:
            raise ConfigError(f"The camera {name!r} cannot stand like this ({error}).") from error
        return SceneCamera(
            name=name,
            width=self.width or width,
            height=self.height or height,
            fov_y=math.radians(self.fov_y_degrees),
            mount=self.mount,
            mount_from_camera=pose,
        )


def read_cameras(path: Path) -> dict[str, FreeCamera]:
    """Cameras of a TOML file, one table each; ConfigError names every bad key."""
    cameras = {}
    for name, table in read_toml(path).items():
        try:
            cameras[name] = from_plain(table, FreeCamera)
        except ValueError as error:
            raise ConfigError(
                f"The camera {name!r} of the file cannot be used ({describe_error(error)}): {path}"
            ) from error
    if not cameras:
        raise ConfigError(f"The file describes no camera; write a table, e.g. [side] with position and look_at: {path}")
    return cameras
