"""Fingers press on objects and do not sink in: depths from recorded poses and shapes, not from what physics reports."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from demorec.check.base import Found, Measurement, physics_check
from demorec.check.episode import CheckedEpisode
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
