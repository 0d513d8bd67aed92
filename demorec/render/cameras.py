"""Camera presets: one constant and one row of `demorec.core.tables.CAMERAS` each."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from demorec.core.geometry import look_at
from demorec.episode.scene import SceneCamera, Vector3
from demorec.robots.robot import RobotSpec


@dataclass(frozen=True, kw_only=True)
class CameraPreset:
    """A camera preset, independent of image size and robot.

    Attributes:
        summary: One line for `demorec list cameras`.
        mount: "world", or "tcp" for a camera on the hand.
        eye, target: Position, and point that it looks at, in the mount's frame, metres. In the world frame for an arm
            of task_scale 1; scaled down for a small one.
        up: Up direction of the image, in the mount's frame.
        usual_mount: Whether the arm's usual camera pose on the hand (`RobotSpec.wrist_camera`), if it has one, replaces
            eye, target and up.
        fov_y: Vertical field of view, rad.
        fov_x: Minimum horizontal field of view, rad: in narrow images the vertical one exceeds `fov_y` to reach it.
    """

    summary: str
    mount: Literal["world", "tcp"] = "world"
    eye: Vector3
    target: Vector3
    up: Vector3 = (0.0, 0.0, 1.0)
    fov_y: float = math.radians(45.0)
    fov_x: float = 0.0
    usual_mount: bool = False

    def camera(self, name: str, robot: RobotSpec, *, width: int, height: int) -> SceneCamera:
        """Build the camera for an image size and a robot."""
        eye, target, up = self.eye, self.target, self.up
        if self.usual_mount and robot.wrist_camera:
            eye, target, up = robot.wrist_camera
        if self.mount == "world":
            eye, target = _scaled(eye, robot.task_scale), _scaled(target, robot.task_scale)
        return SceneCamera(
            name=name,
            width=width,
            height=height,
            fov_y=max(self.fov_y, 2.0 * math.atan(math.tan(self.fov_x / 2.0) * height / width)),
            mount=self.mount if self.mount == "world" else robot.tcp_link,
            mount_from_camera=look_at(eye, target, up),
        )


def _scaled(point: Vector3, scale: float) -> Vector3:
    x, y, z = point
    return scale * x, scale * y, scale * z


FRONT = CameraPreset(
    summary="in front of the table, looking at the arm: sees the whole workspace",
    eye=(1.45, 0.0, 0.95),
    target=(0.40, 0.0, 0.19),
    fov_y=math.radians(44.0),
)

TOP = CameraPreset(
    summary="above the table, looking down, the arm comes from below: shows where objects are",
    eye=(0.5, 0.0, 1.25),
    target=(0.5, 0.0, 0.0),
    up=(1.0, 0.0, 0.0),
    fov_y=math.radians(38.0),
)

# The hand is behind the objects that it reaches for and hides little of them. The placement region
# (demorec.tasks.sampling.WORKSPACE) fills 7:5 images: 11 mm a pixel at 56 x 40.
WORKSPACE = CameraPreset(
    summary="from in front and above, close: sees the objects, the fingers and little else, for small images",
    eye=(1.05, 0.0, 1.0),
    target=(0.49, 0.0, 0.03),
    fov_y=math.radians(22.5),
    fov_x=math.radians(31.0),
)

# In TCP axes: z out of the hand, y along the fingers' motion; the camera is on the hand's side, tilted to the tips.
WRIST = CameraPreset(
    summary="on the hand, looking at the finger tips",
    mount="tcp",
    eye=(0.075, 0.0, -0.08),
    target=(0.03, 0.0, 0.02),
    up=(-1.0, 0.0, 0.0),
    fov_y=math.radians(72.0),
    usual_mount=True,
)
