"""Does the gripper follow its command, which agrees with the label, and press on what it holds without sinking in.

Depths come from recorded poses and shapes, not from what physics reports.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from demorec.check.base import Found, Measurement, NotMeasured, alignment_check, physics_check, worst_entry, worst_frame
from demorec.check.episode import CheckedEpisode
from demorec.check.rows import held_for
from demorec.core.geometry import Array
from demorec.episode.scene import Body, Shape
from demorec.robots.urdf import UrdfShape, read_links

SOLID = ("box", "sphere", "cylinder", "capsule")
"""Shapes that fill what their size says; a mesh's or URDF's bounding box may be hollow."""
NEAR = 0.002
"""Gap between a finger and an object, metres, from which on there is something to measure."""
_PARALLEL = 1e-3
"""Sine of the angle below which two edges are parallel."""
_RING = 64
"""Corners of a cylinder's end: its outline is met within 30 micrometres at a radius of 25 mm."""
CARRIED_HEIGHT = 0.03
"""Metres above its start from which on an object counts as carried."""
_FIRST = 9
"""Frames after the first of a way."""
_OPENS = 0.6
"""Of its opening, a second: fingers that open faster are on their way."""
_BESIDE_MOTORS = 1.1
"""Times the force of their motors with which fingers press that open onto something: their motion ends there, too."""
_MOST_LAG = 4
"""Frames up to which contact force and fingers are shifted against each other."""
_PRESSES, _APART, _STANDS = 0.25, 0.02, 0.15
"""Share of the usual force from which on fingers press, of the opening that keeps them from where they were sent, and
of it a second below which they stand."""


@alignment_check(
    measures="gripper opening of the label against that of the executed command",
    unit="m",
    warn=1e-6,
    fail=2e-3,
)
def gripper_label(episode: CheckedEpisode) -> Measurement | None:
    """Exploration noise is on the arm alone: the label asks for the opening that was sent."""
    c = episode.columns
    return worst_frame(np.abs(c.action_gripper - c.command_gripper))


@physics_check(
    measures="contact force on a carried object against that of the gripper's motors, off 1",
)
def grip_force(episode: CheckedEpisode) -> Found:
    """Two fingers that hold something press on it with the force of their motors, each of them.

    The median over the first frames in which an object is carried: catches another unit, half the sum, a frozen value.
    When the hand turns, what PyBullet reports of the fingers' force goes down by up to a third.
    """
    scene, robot = episode.info.scene, episode.info.robot
    if not scene.movable:
        return None
    if scene.hold != "friction":
        return NotMeasured(why="what is carried is held by a constraint")
    carried = np.any([episode.is_carried(body.name, CARRIED_HEIGHT) for body in scene.movable], axis=0)
    if carried.sum() < 10:
        return NotMeasured(why="nothing is carried for ten frames")
    carried &= held_for(carried & ~np.insert(carried[:-1], 0, False), _FIRST)
    expected = float(np.median(robot.gripper.contact_force(episode.columns.gripper_width[carried])))
    force = float(np.median(episode.columns.contact_force[carried]))
    frame = int(np.argmax(carried))
    return Measurement(
        value=abs(force / expected - 1), frame=frame, detail=f"{force:.1f} N, the motors give {expected:.3g} N"
    )


@alignment_check(
    measures="frames by which the contact force is off the fingers' stop at what is between them",
    warn=1.0,
    fail=1.5,
)
def contact_lag(episode: CheckedEpisode) -> Found:
    """Fingers press from where something stops them to where they open again: catches forces that are late or early.

    Of all shifts of the force those count at which it is there in the frames in which the fingers stand apart from
    where they were sent; of several the middle one. In which of two frames they stop, frames do not tell.
    """
    c, fps = episode.columns, episode.info.fps
    span = episode.info.robot.gripper.open_width
    if c.num_frames < 4 * _MOST_LAG or not (c.contact_force > 0).any():
        return NotMeasured(why="nothing is taken or let go of")
    presses = c.contact_force > _PRESSES * np.median(c.contact_force[c.contact_force > 0])
    sent = np.concatenate([c.command_gripper[:1], c.command_gripper[:-1]])
    stands = np.abs(np.gradient(c.gripper_width)) * fps < _STANDS * span
    stopped = stands & (c.gripper_width - sent > _APART * span)
    core = slice(_MOST_LAG, -_MOST_LAG)
    edges = int((presses[core][1:] != presses[core][:-1]).sum())
    if edges < 2:  # a single one may be early or late by its own
        return NotMeasured(why="nothing is taken and let go of")
    lags = np.arange(-_MOST_LAG, _MOST_LAG + 1)
    off = np.array([int((np.roll(presses, -lag)[core] != stopped[core]).sum()) for lag in lags])
    if off.min() > 2 * edges:
        return NotMeasured(why="the fingers press without being stopped")
    lag = float(lags[off == off.min()].mean())
    return Measurement(value=abs(lag), detail=f"{lag:+.1f} frames, taken and let go of {edges} times")


@physics_check(
    measures="contact force while there is nothing within reach, or of fingers that open, beyond that of their motors",
    unit="N",
)
def touches_nothing(episode: CheckedEpisode) -> Iterator[Found]:
    """Fingers far above all supports and away from all objects touch nothing but each other; and they press on nothing
    while they open, but with what force their motors have for it."""
    yield _pressed_while_opening(episode)
    c, scene = episode.columns, episode.info.scene
    tcp = episode.world_from_tcp[:, :3, 3]
    alone = tcp[:, 2] > max((top_of(body) for body in scene.fixed if body.collides), default=-math.inf) + 0.06
    for body in scene.movable:
        reach = math.hypot(*body.shape.extents) / 2 + 0.08
        alone &= np.linalg.norm(c.object_poses[body.name][:, :3] - tcp, axis=1) > reach
    # Closed fingers press on each other.
    alone &= c.gripper_width > episode.info.robot.gripper.min_width + 0.005
    if alone.any():
        yield worst_frame(np.where(alone, np.abs(c.contact_force), 0.0), f"{int(alone.sum())} frames alone")


def _pressed_while_opening(episode: CheckedEpisode) -> Found:
    c, robot = episode.columns, episode.info.robot
    if not (presses := c.contact_force > 0).any():
        return None
    motors = np.abs(c.joint_effort[:, episode.num_arm :]).sum(axis=1)
    at_work = float(np.median(motors[presses]))
    speed = np.diff(c.gripper_width, prepend=c.gripper_width[:1]) * episode.info.fps
    usual = _BESIDE_MOTORS * float(np.median(c.contact_force[presses]))
    allowed = usual * motors / at_work if at_work else np.full(len(motors), np.inf)
    beyond = np.where(speed > _OPENS * robot.gripper.open_width, c.contact_force - allowed, 0.0)
    return worst_frame(np.maximum(beyond, 0.0), "while the fingers open")


@physics_check(
    measures="largest motor torque or finger force in units of its limit",
    warn=1.001,
    fail=1.05,
)
def joint_effort(episode: CheckedEpisode) -> Measurement | None:
    """No motor gives more than it can; a gripper that presses gives all that it has."""
    c, n, robot = episode.columns, episode.num_arm, episode.info.robot
    limit = np.array([*robot.torque_limit, *[robot.gripper.force] * (len(robot.joint_names) - n)])
    return worst_entry(np.abs(c.joint_effort) / limit, robot.joint_names)


def top_of(body: Body) -> float:
    """Height of a standing body, metres, or more: a model may have its origin at its bottom."""
    share = 0.5 if body.shape.kind in SOLID else 1.0
    return float(body.world_from_body.position[2]) + share * body.shape.extents[2]


@dataclass(frozen=True, kw_only=True, eq=False)
class Convex:
    """The convex hull of points, grown by a radius.

    Attributes:
        points: (P, 3) in the frame of its body or link, metres.
        axes: (3, K) columns: directions along which its depth in another one is measured, in the same frame; normals of
            its faces.
        radius: Metres.
    """

    points: Array
    axes: Array
    radius: float = 0.0

    @classmethod
    def of_shape(cls, shape: Shape | UrdfShape) -> Convex:
        """A box, sphere, cylinder or capsule in its own frame; ValueError for other kinds."""
        match shape.kind:
            case "box":
                corners = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
                return cls(points=corners * (np.array(shape.size) / 2), axes=np.eye(3))
            case "sphere":
                return cls(points=np.zeros((1, 3)), axes=np.eye(3), radius=shape.size[0])
            case "capsule":
                ends = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]])
                return cls(points=ends * (shape.size[1] / 2), axes=np.eye(3), radius=shape.size[0])
            case "cylinder":
                angles = np.arange(_RING) * (2 * math.pi / _RING)
                ring = np.stack([np.cos(angles), np.sin(angles), np.zeros(_RING)], axis=1) * shape.size[0]
                half = np.array([0.0, 0.0, shape.size[1] / 2])
                return cls(points=np.concatenate([ring - half, ring + half]), axes=np.eye(3))
        raise ValueError(f"a shape of kind {shape.kind!r} is no solid")

    @cached_property
    def centre(self) -> Array:
        """(3,) middle of its points."""
        return np.asarray(self.points.mean(axis=0))

    @cached_property
    def reach(self) -> float:
        """How far from its centre it ends, metres."""
        return float(np.linalg.norm(self.points - self.centre, axis=1).max()) + self.radius

    def moved(self, transform: Array) -> Convex:
        """The same in another frame, given its (4, 4) transform."""
        return Convex(
            points=self.points @ transform[:3, :3].T + transform[:3, 3],
            axes=transform[:3, :3] @ self.axes,
            radius=self.radius,
        )


def depth_in(a: Convex, world_from_a: Array, b: Convex, world_from_b: Array) -> Array:
    """(T,) how deep two bodies (poses (T, 4, 4)) are in each other, metres; negative: how far apart they are at least.

    The shortest way out along one of their axes or, where they are in each other, across two of their edges: exact for
    boxes, else a little more than the shortest way of all.
    """
    axes = np.concatenate([world_from_a[:, :3, :3] @ a.axes, world_from_b[:, :3, :3] @ b.axes], axis=2)  # (T, 3, K)
    depth = _overlap(a, world_from_a, b, world_from_b, axes)
    rows = np.flatnonzero(depth > 0)
    if len(rows):
        of_a, of_b = np.split(axes[rows], [a.axes.shape[1]], axis=2)
        across = np.cross(of_a[:, :, :, None], of_b[:, :, None, :], axis=1).reshape(len(rows), 3, -1)
        length = np.linalg.norm(across, axis=1, keepdims=True)
        # Of parallel edges the first axis again, which is known.
        across = np.where(length > _PARALLEL, across / np.maximum(length, _PARALLEL), of_a[:, :, :1])
        depth[rows] = np.minimum(depth[rows], _overlap(a, world_from_a[rows], b, world_from_b[rows], across))
    return depth


def _overlap(a: Convex, world_from_a: Array, b: Convex, world_from_b: Array, axes: Array) -> Array:
    """(T,) the least overlap of two bodies along any of the axes (T, 3, K) of the world, metres."""
    low_a, high_a = _reach(a, world_from_a, axes)
    low_b, high_b = _reach(b, world_from_b, axes)
    return np.asarray(np.minimum(high_a - low_b, high_b - low_a).min(axis=1))


def _reach(body: Convex, world_from_body: Array, axes: Array) -> tuple[Array, Array]:
    """(T, K) from where to where a body reaches along the axes (T, 3, K) of the world, metres."""
    along = np.swapaxes(world_from_body[:, :3, :3], 1, 2) @ axes
    centre = np.einsum("ti,tij->tj", world_from_body[:, :3, 3], axes)
    points = body.points @ along  # (T, P, K)
    return centre + points.min(axis=1) - body.radius, centre + points.max(axis=1) + body.radius


@physics_check(
    measures="depth to which a finger is inside an object",
    unit="m",
    warn=0.001,
    fail=0.0015,
)
def finger_depth(episode: CheckedEpisode) -> Iterator[Found]:
    """Fingers press on the outside of what they hold (boxes, spheres, cylinders, capsules).

    The fingers are those of the recorded description, within a tenth of a millimetre. Not measured where no finger
    comes within two millimetres of an object.
    """
    for name in episode.info.robot.gripper.finger_links:
        for body in (body for body in episode.info.scene.movable if body.shape.kind in SOLID):
            depth = depth_of_link(episode, name, body)
            row = int(np.argmax(depth))
            if depth[row] > -NEAR:
                yield Measurement(value=max(float(depth[row]), 0.0), frame=row, detail=f"{name} in {body.name}")


def depth_of_link(episode: CheckedEpisode, link: str, body: Body) -> Array:
    """(T,) metres by which a link is inside a body of a `SOLID` shape; negative: apart, -inf where far apart."""
    frame, pose = episode.world_from_link(link), episode.world_from_object(body.name)
    solid = Convex.of_shape(body.shape)
    depth = np.full(len(frame), -np.inf)
    for part in _parts(episode.description, link):
        centre = frame[:, :3, :3] @ part.centre + frame[:, :3, 3]
        distance = np.linalg.norm(pose[:, :3, 3] - centre, axis=1)
        near = np.flatnonzero(distance < part.reach + solid.reach + NEAR)
        if len(near):
            depth[near] = np.maximum(depth[near], depth_in(part, frame[near], solid, pose[near]))
    return depth


@lru_cache(maxsize=8)  # all recordings of a robot have the same
def _parts(description: str, link: str) -> tuple[Convex, ...]:
    """What a link of a URDF shows, in its frame."""
    shapes = next(found.visuals for found in read_links(description) if found.name == link)
    return tuple(Convex.of_shape(shape).moved(shape.link_from_shape.matrix()) for shape in shapes)
