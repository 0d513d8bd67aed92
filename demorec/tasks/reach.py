"""Reach of an arm: single poses of its hand, and everything that a scene's goals require."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

import numpy as np

from demorec.core.geometry import Array, Pose
from demorec.episode.scene import Goal, Scene
from demorec.robots.kinematics import ArmKinematics
from demorec.robots.motion import MotionLimits, plan_joints, plan_straight
from demorec.robots.robot import RobotSpec
from demorec.sim.arm import arm_kinematics
from demorec.tasks.grasping import grasps_of, hand_yaw, places_of, raised
from demorec.tasks.script import Behaviour

LEAST_ABOVE_GOAL = 0.10
"""Minimum height, metres, of the TCP (of an arm of task_scale 1) above the goal during transport; it stays at
`lift_height` if that is higher."""
ANY_YAW = 24
"""Number of yaws tried when any yaw is acceptable."""
JOINT_SPEED = 0.8
"""Peak speed of a joint, rad/s, when all joints move at once instead of the TCP in a straight line."""
DESCEND_SPEED = 0.25
"""Peak speed of the TCP, m/s, while descending to a grasp."""
_CONTROL_STEP = 1 / 30
"""Time between the points at which the arm must follow a line, s."""


class Reach:
    """Reachability of poses for the arm of a scene: a robot at the scene's scale, with or without its kinematics.

    Configurations are (n,) rad.
    """

    def __init__(self, scene: Scene, robot: RobotSpec, arm: ArmKinematics | None = None) -> None:
        self.arm = arm or arm_kinematics(robot, scale=scene.robot.scale)
        self.home, self.start = np.array(robot.home_q), np.array(scene.robot.joint_position)
        # Below the joints' own limits, to leave room for noise.
        self.limits = MotionLimits(
            joint_velocity=0.6 * np.array(robot.velocity_limit),
            joint_acceleration=0.8 * np.array(robot.acceleration_limit),
        )
        self._world_from_base = scene.robot.world_from_base

    def tcp(self, joint_position: Array) -> Pose:
        """Compute `world_from_tcp` at (n,) joint positions, rad."""
        return self._world_from_base @ self.arm.forward(joint_position)

    def rest_for(self, world_from_tcp: Pose) -> Array:
        """Turn the home configuration towards a pose, as the configuration that inverse kinematics prefers."""
        return self.arm.turned_towards(self.home, self._in_base(world_from_tcp).position)

    def at_once(self, world_from_tcp: Pose, start: Array) -> bool:
        """Check whether inverse kinematics finds the pose from a configuration (n,), rad."""
        rest = self.rest_for(world_from_tcp)
        return self.arm.inverse(self._in_base(world_from_tcp), start=start, rest=rest) is not None

    def at_all(self, world_from_tcp: Pose) -> bool:
        """Check whether the arm can reach the pose."""
        rest = self.rest_for(world_from_tcp)
        return self.arm.find(self._in_base(world_from_tcp), start=rest, rest=rest) is not None

    def descends(self, world_from_tcp: Pose, *, by: float, start: Array) -> bool:
        """Check for a straight descent to a pose from `by` metres above, coming from `start` (n,), rad."""
        above, goal = self._in_base(raised(world_from_tcp, by)), self._in_base(world_from_tcp)
        rest = self.rest_for(world_from_tcp)
        q = self.arm.find(above, start=start, rest=rest)
        if q is None:
            return False
        line = plan_straight(
            self.arm, start=q, goal=goal, rest=rest, speed=DESCEND_SPEED, limits=self.limits, dt=_CONTROL_STEP
        )
        return line is not None

    def path(
        self,
        world_from_tcp: Pose,
        *,
        start: Array,
        speed: float,
        pace: float,
        dt: float,
        may_sink: float | None = None,
    ) -> Array | None:
        """Plan joint targets (T, n) to a pose in a straight line, or with all joints at once; None if neither works.

        Args:
            world_from_tcp, start: Target pose, and current commanded configuration.
            speed, pace: Peak speed of the TCP, m/s, and a factor on all speeds.
            dt: Control step, s.
            may_sink: Maximum depth, metres, of the TCP below both ends of the line when it leaves the line; None: it
                must not leave it.
        """
        goal, rest = self._in_base(world_from_tcp), self.rest_for(world_from_tcp)
        line = plan_straight(
            self.arm, start=start, goal=goal, rest=rest, speed=speed * pace, turn_speed=pace, limits=self.limits, dt=dt
        )
        if line is not None or may_sink is None:
            return line
        end = self.arm.find(goal, start=start, rest=rest)
        if end is None:
            return None
        arc = plan_joints(start=start, goal=end, speed=JOINT_SPEED * pace, limits=self.limits, dt=dt)
        heights = [float(self.arm.forward(q).position[2]) for q in (start, *arc)]
        return arc if min(heights) > min(heights[0], heights[-1]) - may_sink else None

    def why_not(self, world_from_tcp: Pose, start: Array) -> str:
        """Explain in words why a pose cannot be reached from a configuration (n,), rad."""
        rest = self.rest_for(world_from_tcp)
        return self.arm.why_unreachable(self._in_base(world_from_tcp), start=start, rest=rest)

    def _in_base(self, world_from_tcp: Pose) -> Pose:
        return self._world_from_base.inverse() @ world_from_tcp


def within(reaches: Callable[[Pose], bool], poses: Iterable[Pose], *, up_to: float) -> Iterator[Pose]:
    """Select the poses that are reached both unchanged and `up_to` metres higher."""
    return (pose for pose in poses if reaches(pose) and (not up_to or reaches(raised(pose, up_to))))


def serves(scene: Scene, goals: Iterable[Goal], robot: RobotSpec, behaviour: Behaviour) -> bool:
    """Check whether the arm of a robot at the scene's scale reaches everything that the goals require, in order: a
    grasp, above it, and a matching placement.
    """
    reach = Reach(scene, robot)
    now = hand_yaw(reach.tcp(reach.start))
    approach, lift, least = (
        robot.task_scale * height for height in (behaviour.approach_height, behaviour.lift_height, LEAST_ABOVE_GOAL)
    )
    poses = {body.name: body.world_from_body for body in scene.bodies}

    def serves_one(goal: Goal) -> bool:
        body, pose = scene.body(goal.object), poses[goal.object]
        wanted = (poses[goal.onto] if goal.onto else Pose()) @ goal.onto_from_goal
        poses[goal.object] = wanted
        for grasp in within(reach.at_all, grasps_of(body, pose, now=now, robot=robot, behaviour=behaviour), up_to=lift):
            places = places_of(body, pose, wanted, hand=grasp, yaw_symmetry=goal.yaw_symmetry or ANY_YAW)
            height = max(float(grasp.position[2]) + lift - float(places[0].position[2]), least)
            if reach.descends(grasp, by=approach, start=reach.start) and any(
                within(reach.at_all, places, up_to=height)
            ):
                return True
        return False

    return all(serves_one(goal) for goal in goals)
