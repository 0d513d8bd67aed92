"""An arm of five joints with a turning jaw: its opening, its kinematics, and layouts below it."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from demorec.core.geometry import Pose
from demorec.core.plain import from_json, to_json
from demorec.episode.mesh import SolidMesh, encode_mesh
from demorec.episode.scene import Shape
from demorec.robots.kinematics import Freedom
from demorec.robots.motion import MotionLimits, plan_straight
from demorec.robots.panda import PANDA
from demorec.robots.robot import JawGripper, RobotSpec
from demorec.robots.so101 import SO101
from demorec.sim.arm import arm_kinematics
from demorec.tasks.grasping import found_grasps, hand_down
from demorec.tasks.pick import PickPlace
from demorec.tasks.sampling import Sampler

assert isinstance(SO101.gripper, JawGripper)
JAW, HOME, ARM = SO101.gripper, np.array(SO101.home_q), arm_kinematics(SO101)


@pytest.mark.parametrize(("robot", "least"), [(PANDA, 0.015), (SO101, 0.0022 + 0.38 * 0.015)])
def test_the_minimum_width_of_an_object_scales_with_the_hand(robot: RobotSpec, least: float) -> None:
    def found(width: float) -> bool:
        box = trimesh.creation.box(extents=(0.12, width, 0.03))
        corners, faces = np.array(box.vertices), np.array(box.faces)
        mesh = encode_mesh(SolidMesh(points=corners, faces=faces, parts=(np.arange(8),)))
        shape = Shape(kind="mesh", mesh=mesh, size=(0.12, width, 0.03))
        return bool(found_grasps(shape, robot, np.array([0.0, 0.0, 1.0])))

    assert found(least + 0.001)
    assert not found(least - 0.001)


def test_tasks_open_a_jaw_less_than_it_turns() -> None:
    assert JAW.joint_position(JAW.open_width) == pytest.approx([0.25])
    assert JAW.joint_position(JAW.max_width) == pytest.approx([1.74533])  # the URDF's stop
    assert JAW.stroke_seconds() < replace(JAW, open_width=JAW.max_width).stroke_seconds()
    assert JAW.scaled(2.0).open_width == 2 * JAW.open_width


@given(q=st.floats(-0.16, 1.74), speed=st.floats(-1.0, 1.0))
def test_an_opening_and_its_speed_follow_from_the_joint(q: float, speed: float) -> None:
    joints = np.array([[q]])
    np.testing.assert_allclose(JAW.joint_position(JAW.width(joints)), joints, atol=1e-9)
    later = JAW.width(joints + 1e-6 * speed) - JAW.width(joints)
    earlier = JAW.width(joints) - JAW.width(joints - 1e-6 * speed)
    low, high = sorted([later[0] / 1e-6, earlier[0] / 1e-6])  # they differ at a row of the table
    assert low - 1e-6 <= JAW.width_velocity(joints, np.array([[speed]]))[0] <= high + 1e-6


@pytest.mark.parametrize("rows", [(), ((0.0, 0.02), (0.1, 0.01)), ((0.0, 0.0), (0.2, 0.1), (0.1, 0.2))])
def test_an_ambiguous_opening_is_refused(rows: tuple[tuple[float, float], ...]) -> None:
    with pytest.raises(ValueError, match="from closed to open"):
        replace(JAW, opening=rows)
    plain = json.loads(to_json(SO101))
    plain["gripper"]["opening"] = [list(row) for row in rows]
    with pytest.raises(ValueError, match=r"RobotSpec\.gripper"):
        from_json(json.dumps(plain), RobotSpec)


@pytest.mark.parametrize("yaw", [-0.5, 0.5])
@pytest.mark.parametrize("z", [0.02, 0.06])
@pytest.mark.parametrize("xy", [(0.14, 0.0), (0.2, -0.1), (0.24, 0.1)])
def test_position_and_roll_are_reached_and_the_hand_leans_within_the_cone(
    xy: tuple[float, float], z: float, yaw: float
) -> None:
    wanted = hand_down((*xy, z), yaw)
    rest = ARM.turned_towards(HOME, wanted.position)
    q = ARM.inverse(wanted, start=rest, rest=rest)
    assert q is not None
    found = ARM.forward(q)
    assert math.dist(found.position, wanted.position) < 2e-5
    lean, _ = Rotation.align_vectors(wanted.rotation[:, 2:].T, found.rotation[:, 2:].T)
    assert lean.magnitude() <= ARM.freedom.cone + 1e-9
    upright = lean * Rotation.from_matrix(found.rotation)
    assert (upright * Rotation.from_matrix(wanted.rotation).inv()).magnitude() <= ARM.freedom.roll + 1e-6
    assert (np.array(SO101.position_lower) <= q).all()
    assert (q <= np.array(SO101.position_upper)).all()


@pytest.mark.parametrize(
    ("wanted", "freedom", "words"),
    [
        (hand_down((0.6, 0.0, 0.02), 0.0), None, "short of the position"),
        (hand_down((0.2, 0.0, 0.25), 0.0), None, "rad off the approach, allowed are 0.262 rad"),
        (hand_down((0.2, 0.1, 0.06), -0.8), None, "rad off the roll, allowed are 0.035 rad"),
        (hand_down((0.2, 0.1, 0.06), -0.8), Freedom(cone=0.2, roll=math.pi), ""),
        (hand_down((0.2, 0.0, 0.25), 0.0), Freedom(cone=math.pi, roll=math.pi), ""),
    ],
)
def test_unreachable_poses_are_explained(wanted: Pose, freedom: Freedom | None, words: str) -> None:
    rest = ARM.turned_towards(HOME, wanted.position)
    why = ARM.why_unreachable(wanted, start=rest, rest=rest, freedom=freedom)
    assert (words in why) if words else why == ""
    assert (ARM.inverse(wanted, start=rest, rest=rest, freedom=freedom) is None) == bool(words)


def test_a_motion_that_takes_a_joint_to_its_limit_is_slowed_down_until_it_fits() -> None:
    start, goal = np.array([-0.4501, 0.2375, -0.3638, 1.6481, -2.569]), hand_down((0.2572, -0.1119, 0.0784), 0.0)
    limits = MotionLimits(joint_velocity=np.full(5, 1.2), joint_acceleration=np.full(5, 8.0))
    rest = ARM.turned_towards(HOME, goal.position)
    path = plan_straight(ARM, start=start, goal=goal, rest=rest, speed=0.6, limits=limits, dt=1 / 30)
    assert path is not None
    assert path[:, 3].max() == pytest.approx(SO101.position_upper[3] - 0.01, abs=1e-3)
    assert np.abs(np.diff(path, axis=0)).max() * 30 <= 1.2
    assert np.abs(np.diff(path, 2, axis=0)).max() * 900 <= 8.0


@pytest.mark.parametrize("height", [0.03, 0.08])
def test_objects_are_not_placed_below_a_low_resting_hand(height: float) -> None:
    home = ARM.inverse(hand_down((0.2, 0.0, height), 0.0), start=HOME, rest=HOME)
    assert home is not None
    robot, tcp = replace(SO101, home_q=tuple(home.tolist())), ARM.forward(home).position
    distances = []
    for seed in range(100):
        cube = PickPlace().sample_scene(robot, Sampler(np.random.default_rng(seed))).body("red_cube")
        distances.append(math.dist(cube.world_from_body.position[:2], tcp[:2]))
    assert (min(distances) > 0.03) == (height < 0.05)  # the place below a high hand is used
