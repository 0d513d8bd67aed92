"""demorec's kinematics against PyBullet's link states and Jacobian, and against SciPy's slerp, for every robot."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from demorec.core.geometry import Pose
from demorec.core.tables import ROBOTS
from demorec.robots.assets import asset_path
from demorec.robots.robot import RobotSpec
from demorec.robots.urdf import Urdf
from demorec.sim.arm import arm_kinematics
from demorec.sim.bodies import urdf_file
from demorec.sim.client import connect

SimulatedRobot = tuple[RobotSpec, Any, int, dict[str, int], dict[str, int]]
"""Specification, client, body, indices of links and of joints by name."""


@pytest.fixture(params=ROBOTS.names())
def robot(request: pytest.FixtureRequest) -> Iterator[SimulatedRobot]:
    spec = ROBOTS.load(request.param)
    client = connect()
    with urdf_file(spec.urdf) as path:
        body = client.loadURDF(path, useFixedBase=True)
    links = {client.getJointInfo(body, i)[12].decode(): i for i in range(client.getNumJoints(body))}
    joints = {client.getJointInfo(body, i)[1].decode(): i for i in range(client.getNumJoints(body))}
    yield spec, client, body, links, joints
    client.disconnect()


def random_positions(spec: RobotSpec, count: int, seed: int = 0) -> NDArray[np.float64]:
    low, high = np.array(spec.position_lower), np.array(spec.position_upper)
    return np.random.default_rng(seed).uniform(low, high, (count, len(low)))


def link_pose(client: Any, body: int, link: int) -> tuple[NDArray[np.float64], Rotation]:
    state = client.getLinkState(body, link, computeForwardKinematics=True)
    return np.array(state[4]), Rotation.from_quat(state[5])


def test_every_link_of_the_urdf_is_where_the_simulator_has_it(robot: SimulatedRobot) -> None:
    spec, client, body, links, joints = robot
    urdf = Urdf.load(asset_path(spec.urdf))
    q = dict(zip(spec.arm_joints, random_positions(spec, 1, seed=3)[0].tolist(), strict=True))
    q |= dict(zip(spec.gripper.joints, spec.gripper.joint_position(0.6 * spec.gripper.max_width), strict=True))
    for name, value in q.items():
        client.resetJointState(body, joints[name], value)
    poses = urdf.link_poses(q)
    assert set(links) < set(poses)
    for name, link in links.items():
        position, rotation = link_pose(client, body, link)
        assert np.abs(poses[name].position - position).max() < 1e-6, name
        assert (Rotation.from_quat(poses[name].quat_xyzw) * rotation.inv()).magnitude() < 1e-5, name


def test_inverse_kinematics_reaches_the_pose_in_the_simulator(robot: SimulatedRobot) -> None:
    spec, client, body, links, joints = robot
    arm = arm_kinematics(spec)
    home = np.array(spec.home_q)
    solved = 0
    for q in home + np.random.default_rng(2).uniform(-0.4, 0.4, (40, len(home))):
        q = np.clip(q, arm.lower + 0.02, arm.upper - 0.02)
        wanted = arm.forward(q)
        found = arm.inverse(wanted, start=home, rest=home)
        if found is None:
            continue
        solved += 1
        assert (found >= arm.lower).all()
        assert (found <= arm.upper).all()
        for name, value in zip(spec.arm_joints, found, strict=True):
            client.resetJointState(body, joints[name], value)
        position, rotation = link_pose(client, body, links[spec.tcp_link])
        assert math.dist(position, wanted.position) < 5e-5
        assert (Rotation.from_quat(wanted.quat_xyzw) * rotation.inv()).magnitude() < 5e-4
    assert solved >= 38


def test_a_straight_path_is_straight_and_turns_evenly(robot: SimulatedRobot) -> None:
    spec, *_ = robot
    arm = arm_kinematics(spec)
    start = np.array(spec.home_q)
    base_from_start = arm.forward(start)
    turn = Pose.from_yaw(spec.task_scale * np.array([0.05, 0.15, -0.1]), 0.7)
    base_from_goal = Pose(
        position=base_from_start.position + turn.position,
        quat_xyzw=(turn @ Pose(quat_xyzw=base_from_start.quat_xyzw)).quat_xyzw,
    )
    goal = arm.inverse(base_from_goal, start=start, rest=start)
    assert goal is not None
    fractions = np.linspace(0, 1, 9, dtype=np.float64)
    path = arm.straight_path(
        start=start, goal=goal, base_from_start=base_from_start, base_from_goal=base_from_goal, fractions=fractions
    )
    assert path is not None
    slerp = Slerp([0, 1], Rotation.from_quat([base_from_start.quat_xyzw, base_from_goal.quat_xyzw]))
    for u, q in zip(fractions, path, strict=True):
        pose = arm.forward(q)
        line = base_from_start.position + u * (base_from_goal.position - base_from_start.position)
        assert math.dist(pose.position, line) < 2e-4
        assert (Rotation.from_quat(pose.quat_xyzw) * slerp(u).inv()).magnitude() < 2e-3
