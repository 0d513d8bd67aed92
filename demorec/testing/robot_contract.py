"""What every robot must hold, as tests for pytest."""

from __future__ import annotations

import itertools
import math
from typing import ClassVar

import numpy as np

from demorec.core.plain import from_json, to_json
from demorec.core.registry import modules_of
from demorec.core.tables import load_robot
from demorec.loop import Episode, make_world, prepare
from demorec.robots.assets import allow_models, asset_path
from demorec.robots.robot import JawGripper, RobotSpec
from demorec.robots.urdf import Urdf
from demorec.sim.arm import arm_kinematics
from demorec.tasks.grasping import hand_down
from demorec.testing.task_contract import plan_of, run_expert


class RobotContract:
    """That a robot's description fits its URDF, and that the arm does the job of the tasks.

    Attributes:
        robot: Name of a row of `demorec list robots`, or "package.module:NAME".
        seed: Root of the episode of pick_place that it makes.
    """

    robot: ClassVar[str]
    seed: ClassVar[int] = 0

    def test_the_spec_names_what_the_urdf_has(self) -> None:
        """Links and joints are there, of the right kinds, with limits within the URDF's."""
        spec = self._spec()
        urdf = Urdf.load(asset_path(spec.urdf))
        joints = {joint.name: joint for joint in urdf.joints}
        links = {joint.child for joint in urdf.joints} | {urdf.root}
        assert urdf.root == spec.base_link, f"base_link is {spec.base_link!r}, the root of the URDF {urdf.root!r}"
        missing = {spec.tcp_link, spec.hand_link, *spec.gripper.finger_links} - links
        missing |= {*spec.joint_names} - joints.keys()
        assert not missing, f"the URDF lacks {', '.join(sorted(missing))}"
        for name in (
            "home_q",
            "position_lower",
            "position_upper",
            "velocity_limit",
            "acceleration_limit",
            "torque_limit",
        ):
            count = len(getattr(spec, name))
            assert count == len(spec.arm_joints), f"{name} has {count} numbers for {len(spec.arm_joints)} arm joints"
        for name, low, high in zip(spec.arm_joints, spec.position_lower, spec.position_upper, strict=True):
            assert joints[name].kind == "revolute", f"{name} is {joints[name].kind}, arms turn"
            assert joints[name].lower - 1e-4 <= low < high <= joints[name].upper + 1e-4, f"limits of {name}"
        widest = spec.gripper.joint_position(spec.gripper.max_width).tolist()
        for name, position in zip(spec.gripper.joints, widest, strict=True):
            assert joints[name].kind == spec.gripper.joint_kind, f"{name} is {joints[name].kind}"
            is_there = math.isclose(joints[name].upper, position)  # a jaw may turn farther than it is used
            if isinstance(spec.gripper, JawGripper):
                is_there = all(joints[name].lower <= q <= joints[name].upper for q, _ in spec.gripper.opening)
            assert is_there, f"{name} at full opening is {position}"
        assert from_json(to_json(spec), RobotSpec) == spec, "the spec is another when it is read back from a file"

    def test_home_points_the_hand_down_with_the_fingers_across(self) -> None:
        """The rest configuration holds the hand upright over the table ahead."""
        spec = self._spec()
        pose = arm_kinematics(spec).forward(np.array(spec.home_q))
        off = np.abs(pose.rotation - hand_down((0, 0, 0), 0.0).rotation).max()
        assert off < 0.01, f"the hand at home_q is turned by about {off:.2f} rad"
        assert 0.2 < pose.position[0] / spec.task_scale < 0.6, f"the hand at home_q is {pose.position[0]:.2f} m ahead"
        assert abs(pose.position[1]) < 0.015, f"the hand at home_q is {pose.position[1]:.2f} m to the side"

    def test_the_fingers_move_along_y_of_the_tcp_and_reach_as_far_as_the_spec_says(self) -> None:
        """Their boxes in the simulator, at full opening."""
        episode = self._episode()
        robot, gripper = episode.info.robot, episode.info.robot.gripper
        with make_world(episode.info) as world:
            world.reset(episode.info.scene)
            world.arm.place(np.array(robot.home_q), gripper.max_width)
            tcp = world.arm.world_from_tcp()
            tips = []
            for link in world.arm.finger_links:
                low, high = world.client.getAABB(world.arm.body, link)
                tips.append(low[2])
                centre = tcp.inverse().apply((np.array(low) + np.array(high)) / 2)
                assert abs(centre[0]) < 0.01, "a finger is beside the TCP's y axis"
                if isinstance(gripper, JawGripper):
                    continue
                half = gripper.max_width / 2
                assert half - 0.005 < abs(centre[1]) < half + 0.025, f"a finger is {abs(centre[1]):.3f} m from the TCP"
        depth = tcp.position[2] - min(tips)
        # PyBullet's boxes are some millimetres too large.
        assert abs(depth - gripper.finger_depth) < 0.005, f"the finger tips reach {depth:.3f} m beyond the TCP"

    def test_the_workspace_is_within_reach(self) -> None:
        """With the hand pointing down, wherever tasks put objects, up to 22 cm above the table."""
        spec = self._spec()
        arm, home = arm_kinematics(spec), np.array(spec.home_q)
        places = itertools.product((0.35, 0.5, 0.65), (-0.25, 0.0, 0.25), (0.02, 0.15, 0.22), (-0.8, 0.0, 0.8))
        for x, y, z, yaw in places:
            wanted = hand_down(spec.task_scale * np.array([x, y, z]), yaw)
            rest = arm.turned_towards(home, wanted.position)
            why = arm.why_unreachable(wanted, start=rest, rest=rest)
            assert not why, f"{wanted.position.round(3).tolist()} m at yaw {yaw} is out of reach: {why}"

    def test_it_picks_and_places(self) -> None:
        """One episode of pick_place succeeds."""
        _, outcome = run_expert("pick_place", self.robot, self.seed, 0)
        assert outcome.success, f"{outcome.failure_reason} in phase {outcome.failure_phase}"

    def _spec(self) -> RobotSpec:
        allowed = modules_of([self.robot])
        allow_models(allowed)
        return load_robot(self.robot, allowed)

    def _episode(self) -> Episode:
        return prepare(plan_of("pick_place", self.robot, self.seed, 0))
