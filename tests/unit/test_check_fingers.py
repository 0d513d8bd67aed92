"""Depths of convex bodies in each other: closed forms, rigid motions, and Bullet as another judge."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from demorec.check.gripper import Convex, depth_in
from demorec.core.geometry import Array, Pose
from demorec.episode.scene import Shape, ShapeKind
from demorec.sim.client import connect

BOX = Shape(kind="box", size=(0.04, 0.05, 0.06))
PAD = Shape(kind="box", size=(0.02, 0.014, 0.018))
small = st.floats(-0.02, 0.02)
turn = st.floats(-3.0, 3.0)


def poses(*rows: Pose) -> Array:
    return np.array([pose.matrix() for pose in rows])


def at(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Pose:
    return Pose(position=np.array([x, y, z]))


def depth(shape: Shape, pose: Pose, other: Shape, other_pose: Pose) -> float:
    (value,) = depth_in(Convex.of_shape(shape), poses(pose), Convex.of_shape(other), poses(other_pose))
    return float(value)


@pytest.mark.parametrize(
    ("kind", "size", "reach"),
    [
        ("box", (0.03, 0.04, 0.05), 0.02),
        ("sphere", (0.025,), 0.025),
        ("cylinder", (0.02, 0.06), 0.02),
        ("capsule", (0.015, 0.03), 0.015),
    ],
)
@pytest.mark.parametrize("deep", [-0.004, 0.0, 0.0011, 0.006])
def test_a_pad_against_the_side_of_a_body(kind: ShapeKind, size: tuple[float, ...], reach: float, deep: float) -> None:
    """`reach`: from the middle of the body to its side."""
    pad = at(y=reach + PAD.size[1] / 2 - deep)
    assert depth(PAD, pad, Shape(kind=kind, size=size), Pose()) == pytest.approx(deep, abs=1e-12)


@pytest.mark.parametrize("deep", [-0.002, 0.001, 0.003])
def test_an_edge_across_an_edge(deep: float) -> None:
    """Each cube stands on an edge: they meet where the two edges cross."""
    side, sine, cosine = 0.02, math.sin(math.pi / 8), math.cos(math.pi / 8)
    cube = Shape(kind="box", size=(side, side, side))
    below = Pose(quat_xyzw=np.array([sine, 0.0, 0.0, cosine]))  # by 45 degrees about x
    above = Pose(
        position=np.array([0.0, 0.0, math.sqrt(2) * side - deep]), quat_xyzw=np.array([0.0, sine, 0.0, cosine])
    )
    found = depth(cube, below, cube, above)
    assert found == pytest.approx(deep, abs=1e-9) if deep > 0 else found <= 0


@given(x=small, y=small, z=small, yaw=turn, far=turn, turned=turn)
def test_a_rigid_motion_of_both_changes_nothing(
    x: float, y: float, z: float, yaw: float, far: float, turned: float
) -> None:
    pad = Pose.from_yaw((x, 0.03 + y, z), yaw)
    motion = Pose.from_yaw((far, -far, 0.5), turned)
    assert depth(PAD, motion @ pad, BOX, motion) == pytest.approx(depth(PAD, pad, BOX, Pose()), abs=1e-9)
    assert depth(BOX, Pose(), PAD, pad) == pytest.approx(depth(PAD, pad, BOX, Pose()), abs=1e-12)


@pytest.fixture(scope="module")
def bullet() -> Iterator[tuple[Any, int, int]]:
    """A client with the pad and the box."""
    client = connect()
    pad, box = (
        client.createMultiBody(1.0, client.createCollisionShape(client.GEOM_BOX, halfExtents=[v / 2 for v in s.size]))
        for s in (PAD, BOX)
    )
    yield client, pad, box
    client.disconnect()


@pytest.mark.parametrize("deep", [0.0005, 0.0013, 0.004])
@pytest.mark.parametrize(("x", "z"), [(0.0, 0.0), (0.017, -0.02)])
def test_bullet_finds_the_same_depth_of_two_boxes(
    bullet: tuple[Any, int, int], x: float, z: float, deep: float
) -> None:
    client, pad, box = bullet
    pose = at(x, (BOX.size[1] + PAD.size[1]) / 2 - deep, z)
    client.resetBasePositionAndOrientation(pad, pose.position.tolist(), pose.quat_xyzw.tolist())
    client.performCollisionDetection()
    judged = -min(point[8] for point in client.getClosestPoints(pad, box, 0.0))
    assert depth(PAD, pose, BOX, Pose()) == pytest.approx(judged, abs=1e-5)
