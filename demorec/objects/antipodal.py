"""Grasps of a solid for a gripper that comes from above, computed from its mesh alone.

Points are sampled on the steep parts of the surface; at each one the fingers close along the normal. The first contact
is looked up in a cloud of surface points, within the strip that a finger's pad sweeps. Both contacts must face the
fingers (friction cannot hold steeper ones) across a width that fits, and no other part of the solid may be where the
open fingers descend or where the palm is.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np

from demorec.core.geometry import Array
from demorec.episode.mesh import SolidMesh, decode_mesh
from demorec.robots.robot import Gripper

CANDIDATES = 300
CLOUD = 3000
KEPT = 40
"""Number of grasps kept, best first."""
PAD = 0.010
"""Half the width of a finger's pad, metres."""
FINGER = 0.015
"""Half the width of a finger including its clearance, metres."""
PAD_ABOVE = 0.010
"""Height of the pad above the TCP, metres."""
_SKIN = 0.0015
"""Maximum distance behind the outermost surface point at which a point still touches the finger, metres."""
LEAST_FACING = math.cos(math.radians(25.0))
"""Minimum mean cosine of the angle between a finger's motion and the inward contact normals."""
TIP_CLEARANCE = 0.005
"""Gap between the finger tips and the support, metres (for an arm of task_scale 1)."""
LEAST_WIDTH = 0.015
"""Minimum gripped width beyond the closed gripper's, metres (for such an arm); below it, the hand counts as empty."""
PLAY = 0.01
"""Minimum difference between the opening and the gripped width, metres."""
_STEEP = 0.5
"""Maximum vertical component of the normal where a finger may touch."""


@dataclass(frozen=True, kw_only=True)
class Grasp:
    """One grasp, relative to the solid's origin; x, y and yaw in axes that turn with it about the vertical."""

    # x, y, z: position of the TCP, metres.
    x: float
    y: float
    z: float
    yaw: float  # angle, rad, of the hand's x axis, which runs along the pads; the fingers close across it
    width: float  # distance between the contacts, metres
    cost: float  # smaller is better


@functools.lru_cache(maxsize=256)
def antipodal_grasps(
    text: str, gripper: Gripper, *, task_scale: float = 1.0, scale: float = 1.0, up: tuple[float, float, float]
) -> tuple[Grasp, ...]:
    """Compute the best grasps of a solid (`text` as in `Shape.mesh`) with the hand pointing down, best first.

    `up` is the vertical of the world in the solid's axes. Empty if no grasp fits.
    """
    mesh = decode_mesh(text)
    points, normals = _surface(mesh, CLOUD)
    standing = standing_rotation(up)
    points, normals = _turned(standing, scale * points), _turned(standing, normals)
    steep = np.flatnonzero(np.abs(normals[:, 2]) < _STEEP)
    chosen = steep[:: max(1, len(steep) // CANDIDATES)]
    found = [_grasp(points, normals, row, gripper, task_scale) for row in chosen.tolist()]
    best = sorted((grasp for grasp in found if grasp is not None), key=lambda grasp: grasp.cost)
    return tuple(best[:KEPT])


def standing_rotation(up: tuple[float, float, float]) -> Array:
    """Smallest rotation (3, 3) that turns a direction of the solid (unit length) into the vertical."""
    x, y, z = up
    if z < -0.999:
        return np.diag([1.0, -1.0, -1.0])
    share = 1.0 / (1.0 + z)
    return np.array([[1 - share * x * x, -share * x * y, -x], [-share * x * y, 1 - share * y * y, -y], [x, y, z]])


def _grasp(points: Array, normals: Array, row: int, gripper: Gripper, task_scale: float) -> Grasp | None:
    """Compute the grasp that closes along the normal at a point of the cloud; None if it does not hold or fit."""
    length = math.hypot(*normals[row, :2].tolist())
    across = normals[row, :2] / -length  # (2,) motion of the first finger
    along = np.array([across[1], -across[0]])  # x of a hand that points down, its y being `across`
    u = points[:, 0] * along[0] + points[:, 1] * along[1]
    v = points[:, 0] * across[0] + points[:, 1] * across[1]
    w, at = points[:, 2], float(points[row, 2])
    depth, clearance, opening = gripper.finger_depth, TIP_CLEARANCE * task_scale, gripper.open_width
    z = max(at, float(w.min()) + depth + clearance, float(w.max()) - (gripper.palm_clearance - 0.007))
    if at < z - depth + 0.002:
        return None  # the pads end above it
    middle = float(u[row])
    pad = (np.abs(u - middle) < PAD) & (w > z - depth) & (w < z + PAD_ABOVE)
    first, last = float(v[pad].min()), float(v[pad].max())
    width, centre = last - first, (first + last) / 2
    if not gripper.min_width + LEAST_WIDTH * task_scale <= width <= opening - PLAY:
        return None
    swept = (np.abs(u - middle) < FINGER) & (w > z - depth - clearance / 2)
    if float(np.abs(v[swept] - centre).max()) > opening / 2 - 0.003:
        return None  # a finger would collide with it from above
    facing = normals[:, 0] * across[0] + normals[:, 1] * across[1]
    near, far = pad & (v < first + _SKIN), pad & (v > last - _SKIN)
    least = min(-float(facing[near].mean()), float(facing[far].mean()))
    if least < LEAST_FACING:
        return None
    apart = max(abs(float(u[side].mean()) - middle) for side in (near, far))
    height = max(float(w[near].mean()), float(w[far].mean()))
    # Off the centre of mass, the solid turns about the fingers when lifted; gripped below it, it may topple.
    off = math.hypot(middle, centre)
    tight = max(0.0, width - opening + 0.02)
    cost = 4 * (1 - least) + 60 * off + 60 * apart + 10 * max(0.0, -height) + 20 * tight
    x, y = (middle * along + centre * across).tolist()
    return Grasp(x=x, y=y, z=z, yaw=math.atan2(along[1], along[0]), width=width, cost=cost)


@functools.lru_cache(maxsize=2)
def _shares(count: int) -> tuple[Array, Array]:
    """Random numbers in 0..1, (count,) and (count, 2), always the same."""
    rng = np.random.default_rng(0)
    return np.sort(rng.uniform(size=count)), rng.uniform(size=(count, 2))


def _surface(mesh: SolidMesh, count: int) -> tuple[Array, Array]:
    """Sample (count, 3) points evenly on the surface, with their unit normals."""
    a, b, c = (mesh.points[mesh.faces[:, corner]] for corner in range(3))
    normals = np.cross(b - a, c - a)
    double = np.sqrt((normals * normals).sum(axis=1))
    total = np.cumsum(double)
    places, share = _shares(count)
    rows = np.minimum(np.searchsorted(total, places * total[-1]), len(total) - 1)
    share = np.where(share.sum(axis=1, keepdims=True) > 1, 1 - share, share)
    points = a[rows] + share[:, :1] * (b - a)[rows] + share[:, 1:] * (c - a)[rows]
    return points, normals[rows] / double[rows, np.newaxis]


def _turned(rotation: Array, vectors: Array) -> Array:
    return np.stack([sum(row[axis] * vectors[:, axis] for axis in range(3)) for row in rotation], axis=1)
