"""Content of a world as plain data: enough to rebuild it years later without the task's code.

A task samples a `Scene`; the simulator builds it; every recording contains it. Replay and re-render start from
the recorded scene, so they need neither the task nor its random numbers.
Frames: `world` has z up, the robot's base is at the pose of `RobotPlacement`. SI units throughout.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from demorec.core.geometry import Array, Pose, intrinsic_matrix

Rgba = tuple[float, float, float, float]
Vector3 = tuple[float, float, float]

ShapeKind = Literal["box", "sphere", "cylinder", "capsule", "mesh", "urdf"]
Role = Literal["object", "target", "support", "distractor", "fixture"]


@dataclass(frozen=True, kw_only=True)
class Shape:
    """The geometry of a body, in its own frame (origin at the centre of mass, unless the URDF says otherwise)."""

    kind: ShapeKind  # geometry; decides the meaning of `size`
    # box: (x, y, z) full extents; sphere: (radius,); cylinder and capsule: (radius, length) along z; mesh and urdf: (x,
    # y, z) extents of the bounding box after scaling, for features and grasping.
    size: tuple[float, ...]
    # mesh and urdf: path below pybullet_data, or "demorec:NAME" for a file of `demorec/sim/assets`, or "module:PATH"
    # for one next to a user's module (a task may give it relative to its module).
    file: str = ""
    scale: float = 1.0  # mesh and urdf: uniform scale of the file
    # mesh: the point of the file, in its own axes before scaling, that becomes the body's origin.
    origin: Vector3 = (0.0, 0.0, 0.0)
    y_up: bool = False  # mesh: whether the file's y axis points up (its x axis stays x)
    # mesh: the solid itself instead of a file, as encoded by `demorec.episode.mesh`, with origin and scale.
    mesh: str = ""

    @property
    def body_from_mesh(self) -> Pose:
        """Pose of a mesh file's scaled axes in the body's frame."""
        half = math.sqrt(0.5)
        turn = Pose(quat_xyzw=np.array([half, 0.0, 0.0, half])) if self.y_up else Pose()
        return Pose(position=-turn.apply(self.scale * np.array(self.origin)), quat_xyzw=turn.quat_xyzw)

    @property
    def extents(self) -> Vector3:
        """(x, y, z) full extents of the bounding box, metres."""
        if self.kind == "sphere":
            return (2 * self.size[0],) * 3
        if self.kind == "cylinder":
            return (2 * self.size[0], 2 * self.size[0], self.size[1])
        if self.kind == "capsule":
            return (2 * self.size[0], 2 * self.size[0], self.size[1] + 2 * self.size[0])
        return (self.size[0], self.size[1], self.size[2])


Pattern = Literal["plain", "checker", "stripes", "noise", "wood"]


@dataclass(frozen=True, kw_only=True)
class Texture:
    """A procedural texture, a pure function of its fields, without external files."""

    pattern: Pattern
    colors: tuple[Vector3, Vector3]  # the two colours (r, g, b in 0..1) that it blends
    scale: float = 4.0  # repetitions over the texture's side
    seed: int = 0


@dataclass(frozen=True, kw_only=True)
class Body:
    """One body other than the robot."""

    name: str  # unique in the scene; also its topic and coordinate frame
    # object: to be manipulated; target: its destination; support, fixture: fixed; distractor: irrelevant to the task.
    role: Role
    shape: Shape
    world_from_body: Pose
    mass: float = 0.0  # kg; 0 for a fixed body
    # lateral_friction, spinning_friction, rolling_friction: Coulomb coefficients, as PyBullet's changeDynamics.
    lateral_friction: float = 0.6
    spinning_friction: float = 0.0
    rolling_friction: float = 0.0
    restitution: float = 0.0  # 0 (no bounce) .. 1
    # linear_damping, angular_damping: 1/s.
    linear_damping: float = 0.04
    angular_damping: float = 0.04
    rgba: Rgba = (1.0, 1.0, 1.0, 1.0)  # colour; (1, 1, 1, 1) keeps the colours of a URDF or mesh file
    color_name: str = ""  # its word in instructions, or ""
    texture: Texture | None = None  # procedural texture, multiplied by the colour, or None
    collides: bool = True  # False for a visual-only mark
    # n if its appearance repeats every 2 pi / n about its vertical axis; 0 if it is the same at every angle.
    yaw_symmetry: int = 1

    @property
    def movable(self) -> bool:
        """Whether physics can move it."""
        return self.mass > 0 and self.collides

    @property
    def mean_color(self) -> Rgba:
        """`rgba` multiplied by the mean of the texture's two colours."""
        if self.texture is None:
            return self.rgba
        first, second = self.texture.colors
        red, green, blue = (own * (a + b) / 2 for own, a, b in zip(self.rgba, first, second, strict=False))
        return red, green, blue, self.rgba[3]


@dataclass(frozen=True, kw_only=True)
class Goal:
    """Target of one object: the plain-data part of a task's aim, for features, cards and checks."""

    object: str
    onto: str  # name of the body that it is placed on or in, or "" for a goal in the world
    onto_from_goal: Pose  # target pose of the object in that body's frame (in the world for "")
    yaw_symmetry: int = 4  # as `Body.yaw_symmetry`, for the target yaw; 0 if any yaw is acceptable
    # Minimum x and y, maximum x and y in that body's frame, metres: the object's origin may be anywhere in it, as in a
    # tray; None if it must be at the target pose.
    area: tuple[float, float, float, float] | None = None

    def distance(self, world_from_onto: Pose, world_from_object: Pose) -> float:
        """Compute the horizontal distance of the object to its target, metres; the world replaces a missing `onto`."""
        if self.area is None:
            wanted = world_from_onto @ self.onto_from_goal
            return math.dist(world_from_object.position[:2], wanted.position[:2])
        x, y, _ = (world_from_onto.inverse() @ world_from_object).position.tolist()
        least_x, least_y, most_x, most_y = self.area
        return math.hypot(max(least_x - x, 0.0, x - most_x), max(least_y - y, 0.0, y - most_y))


@dataclass(frozen=True, kw_only=True)
class RobotPlacement:
    """Robot, its placement and its initial state."""

    name: str  # row of the robots' table
    world_from_base: Pose
    scale: float = 1.0  # uniform scale of the URDF
    joint_position: tuple[float, ...]  # (n_arm,) initial arm joint positions, rad
    gripper_width: float  # initial opening, metres


POSITION_GAIN = 0.2
"""Gain of the arm joints' position control: the ratio of the error that a physics step removes."""


@dataclass(frozen=True, kw_only=True)
class Physics:
    """Engine parameters, all set at every reset (PyBullet leaks some into later clients)."""

    hz: int = 240  # steps per second
    solver_iterations: int = 50  # maximum iterations of each step
    gravity: Vector3 = (0.0, 0.0, -9.81)  # m/s^2
    # Relative motion of two bodies after which Bullet drops a contact point, as a ratio of the smaller one's radius.
    # With Bullet's 0.02 a small, light, slippery cube can rock between fingers that touch it in one point each, and
    # they penetrate it (docs/simulation.md).
    contact_breaking_threshold: float = 0.05
    # Contact stiffness of a finger, N/m: a finger that pushes at one point penetrates the object by the force divided
    # by it. With PyBullet's 30,000 and 20 N that is 0.7 mm, and over a millimetre when the object meets the table
    # (docs/simulation.md).
    finger_stiffness: float = 120_000.0
    grip_iterations: int = 0  # the same while a finger touches an object; 0 for the same number


@dataclass(frozen=True, kw_only=True)
class Light:
    """One directional light and the sky, for every renderer."""

    direction: Vector3 = (0.5, -0.4, 1.0)  # from the scene towards the light, world frame; need not be of unit length
    color: Vector3 = (1.0, 1.0, 1.0)  # colour of the light, r, g, b in 0..1
    # ambient, diffuse, specular: coefficients of the Phong terms.
    ambient: float = 0.5
    diffuse: float = 0.55
    specular: float = 0.1
    shadow: float = 0.6  # ratio of the direct light removed in a shadow, 0 (no shadows) .. 1
    sky_color: Vector3 = (0.72, 0.80, 0.88)  # colour of the background, r, g, b in 0..1


@dataclass(frozen=True, kw_only=True)
class SceneCamera:
    """A pinhole camera, fixed in the world or carried by a robot link."""

    name: str  # unique; also its topic
    # width, height: pixels.
    width: int
    height: int
    fov_y: float  # vertical field of view, rad
    mount: str  # "world", or the name of a robot link
    mount_from_camera: Pose  # pose in the mount's frame, OpenCV axes (x right, y down, z forward)
    # near, far: clipping distances along the optical axis, metres.
    near: float = 0.02
    far: float = 6.0

    @property
    def intrinsics(self) -> Array:
        """Intrinsic matrix K (3, 3), pixels."""
        return intrinsic_matrix(width=self.width, height=self.height, fov_y=self.fov_y)


@dataclass(frozen=True, kw_only=True)
class Scene:
    """Everything that the simulator and the renderers need to rebuild an episode's start."""

    robot: RobotPlacement
    bodies: tuple[Body, ...]  # bodies in loading order, which is part of the physics' determinism
    goals: tuple[Goal, ...] = ()  # final placements, in the order of execution
    physics: Physics = field(default_factory=Physics)
    light: Light = field(default_factory=Light)
    cameras: tuple[SceneCamera, ...] = ()  # all cameras, in order; empty without images
    # How the hand holds objects: by friction alone, or by a rigid constraint from the moment both fingers press on one
    # until the gripper opens (a shortcut of many tutorials).
    hold: Literal["friction", "constraint"] = "friction"

    def body(self, name: str) -> Body:
        """Return the body called `name`; KeyError if it does not exist."""
        for body in self.bodies:
            if body.name == name:
                return body
        raise KeyError(name)

    def world_from_goal(self, goal: Goal) -> Pose:
        """Compute the target pose of the goal's object, with bodies at their initial poses."""
        return self.body(goal.onto).world_from_body @ goal.onto_from_goal if goal.onto else goal.onto_from_goal

    @property
    def fixed(self) -> tuple[Body, ...]:
        """The fixed bodies; worlds load and number them first, then the robot, then the movable ones."""
        return tuple(body for body in self.bodies if not body.movable)

    @property
    def movable(self) -> tuple[Body, ...]:
        """The bodies with poses recorded at every frame."""
        return tuple(body for body in self.bodies if body.movable)


def yaw_of(pose: Pose) -> float:
    """Compute the rotation about the vertical, rad, of the body axis nearest to horizontal.

    This is meaningful for a cube on any of its faces: the axis nearest to vertical is excluded.
    """
    rotation = pose.rotation
    vertical = int(np.argmax(np.abs(rotation[2])))
    horizontal = (vertical + 1) % 3
    return math.atan2(rotation[1, horizontal], rotation[0, horizontal])
