"""Quick check, about 1 s, of whether a custom robot can do what tasks require."""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import numpy as np

from demorec.core.errors import ConfigError, SceneError
from demorec.core.geometry import Array
from demorec.episode.scene import Physics, RobotPlacement
from demorec.robots.model_check import check_masses, checked_urdf
from demorec.robots.robot import ParallelGripper, RobotSpec
from demorec.sim.arm import Arm, arm_kinematics
from demorec.sim.client import connect
from demorec.tasks.grasping import hand_down, symmetric_yaws

_WORKSPACE = ((0.35, 0.5, 0.65), (-0.25, 0.0, 0.25), (0.02, 0.15, 0.22), (-0.8, 0.0, 0.8))
"""Sampled x, y and z of the TCP, metres, and yaws of the hand, rad."""
NUM_POSES = math.prod(map(len, _WORKSPACE))
MAX_UNREACHABLE_RATIO = 0.5
"""Maximum ratio of unreachable poses: unreachable layouts are drawn again, which works if most are reachable."""
MAX_DEPTH_ERROR_M = 0.01
"""Maximum error of finger_depth, metres: a grasp of a 3 cm cube misses beyond it."""


class FingerBoxes(NamedTuple):
    """Boxes of the fingers along the axes of the TCP, with the hand as open as in tasks.

    PyBullet's boxes are a few millimetres too large.
    """

    centres: Array  # (n, 3), metres
    depth: float  # distance of the finger tips beyond the TCP, metres


def check_robot(spec: RobotSpec, *, uses_workspace: bool) -> None:
    """Check a robot before generating anything with it.

    Args:
        spec: The robot.
        uses_workspace: Whether objects will be placed across the workspace of the built-in tasks.

    Raises:
        ConfigError: The spec does not fit the URDF, a link does not specify its mass, the TCP is not between the finger
            tips, or most of the workspace is out of reach; the message states the fix.
        SceneError: A mesh of the URDF is missing or cannot be loaded.
    """
    try:
        checked_urdf(spec)
    except SceneError as error:  # for a recording it means damaged data, here a wrong request
        raise ConfigError(str(error)) from error
    check_masses(spec.urdf)
    if problem := finger_problem(spec, finger_boxes(spec)):
        raise ConfigError(f"The robot {spec.name!r} has its TCP in the wrong place: {problem}: {spec.urdf}")
    if uses_workspace and (problem := reach_problem(spec)):
        raise ConfigError(f"The robot {spec.name!r} does not reach the workspace of the tasks: {problem}: {spec.urdf}")


def unreachable_poses(spec: RobotSpec) -> tuple[str, ...]:
    """Find the poses of the workspace, of `NUM_POSES`, that the hand cannot reach, with the reason.

    The hand points down at one of a grasp's two yaws, over the objects' region, up to 22 cm above the table.
    """
    arm, home = arm_kinematics(spec), np.array(spec.home_q)
    found = []
    for x, y, z, yaw in itertools.product(*_WORKSPACE):
        poses = [hand_down(spec.task_scale * np.array([x, y, z]), either) for either in symmetric_yaws(yaw, 2)]
        rest = arm.turned_towards(home, poses[0].position)
        why = [arm.why_unreachable(wanted, start=rest, rest=rest) for wanted in poses]
        if all(why):
            found.append(f"{poses[0].position.round(3).tolist()} m at yaw {yaw} is out of reach: {why[0]}")
    return tuple(found)


def reach_problem(spec: RobotSpec) -> str:
    """Return the fix if most of the workspace is out of reach; "" otherwise."""
    unreachable = unreachable_poses(spec)
    if len(unreachable) <= MAX_UNREACHABLE_RATIO * NUM_POSES:
        return ""
    near, far, side = (spec.task_scale * value for value in (0.35, 0.65, 0.25))
    return (
        f"the hand, pointing down, takes {NUM_POSES - len(unreachable)} of {NUM_POSES} poses {near:.2f} to {far:.2f} m "
        f"ahead of base_link and {side:.2f} m to both sides (with task_scale={spec.task_scale:g}), for instance "
        f"{unreachable[0]}; choose another task_scale, or a base_link that is farther from the arm or nearer to it"
    )


def finger_boxes(spec: RobotSpec) -> FingerBoxes:
    """Measure the fingers in the simulator."""
    home = np.array(spec.home_q)
    placement = RobotPlacement(
        name=spec.name,
        world_from_base=arm_kinematics(spec).forward(home).inverse(),  # puts the TCP at the world's frame
        joint_position=spec.home_q,
        gripper_width=spec.gripper.open_width,
    )
    client = connect()
    try:
        arm = Arm(client, spec, placement, finger_stiffness=Physics().finger_stiffness)
        client.performCollisionDetection()
        boxes = np.array([client.getAABB(arm.body, link) for link in arm.finger_links])
    finally:
        client.disconnect()
    return FingerBoxes(centres=boxes.mean(axis=1), depth=float(boxes[:, 1, 2].max()))


def finger_problem(spec: RobotSpec, fingers: FingerBoxes) -> str:
    """Return the fix for a grossly misplaced TCP; "" otherwise."""
    gripper = spec.gripper
    across = np.abs(fingers.centres)
    if isinstance(gripper, ParallelGripper) and (across[:, 0] > across[:, 1]).any():
        return f"the fingers move along x of tcp_link {spec.tcp_link!r}; turn it about its z by 90 degrees"
    error = fingers.depth - gripper.finger_depth
    if abs(error) <= MAX_DEPTH_ERROR_M:
        return ""
    if fingers.depth <= 0:
        return (
            f"the fingers end {-fingers.depth:.3f} m before tcp_link {spec.tcp_link!r}; place it between the finger "
            "tips, its z axis out of the hand"
        )
    return (
        f"the finger tips are {fingers.depth:.3f} m beyond tcp_link {spec.tcp_link!r}; finger_depth is "
        f"{gripper.finger_depth:g}; move tcp_link by {error:.3f} m along its z axis, or correct finger_depth"
    )
