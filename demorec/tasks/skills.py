"""The pick-and-place skill: every arm task is a sequence of it.

Phases: perceive, approach, descend, close, lift, transport, lower, release, retreat, verify; up to three attempts.
Object poses are read only where a camera could still see them: before the approach and before lowering. No step is
spent waiting: a policy that learns from idle frames learns to stand still.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Iterator, Sequence

import numpy as np

from demorec.core.geometry import Array, Pose
from demorec.episode.episode import Event
from demorec.episode.scene import Body, Goal
from demorec.sim.world import World
from demorec.tasks.grasping import (
    clear_first,
    grasps_beside,
    grasps_of,
    hand_down,
    hand_yaw,
    is_above,
    nearest_first,
    places_of,
    raised,
    symmetric_yaws,
)
from demorec.tasks.reach import ANY_YAW, DESCEND_SPEED, LEAST_ABOVE_GOAL, Reach, within
from demorec.tasks.script import Behaviour, ExpertFailure, Step, steady_width
from demorec.tasks.success import goal_pose, on_support, placement_checks, rest_checks

MAX_TRIES = 3
FREE_SPEED = 0.6
LIFT_SPEED = 0.3
TOUCH_DOWN_SPEED = 0.08
"""Peak speeds of the TCP, m/s."""
MOST_BELOW_LINE = 0.02
"""Maximum depth, metres (of an arm of task_scale 1), of the TCP below the lower end of a line that the arm cannot
follow and replaces with a joint motion."""
SETTLE_TOLERANCE = 0.03
SETTLE_SECONDS = 0.1
"""Joint error, rad, at which a motion counts as finished, and the maximum time to wait for it, s."""
ARRIVAL_TOLERANCE = 0.006
ARRIVAL_SECONDS = 0.34
"""The same after a free motion: the expert continues only at its target. If it continued while exploration noise still
held the arm a centimetre away, a policy would learn that such an error is acceptable."""
LOST_WIDTH = 0.012
"""Opening, metres, below which the hand is considered empty."""
ROCKING_SECONDS = 0.5
"""Maximum time for which a released object may rock, s."""
CARRIED_ABOVE_M = 0.04
"""`ABOVE_M` for a held object: fingers must not come down on an object, but a held object may descend at an angle."""


class Expert:
    """The arm's skills in one episode, in a world after reset; its methods yield control steps."""

    def __init__(self, world: World, behaviour: Behaviour | None = None) -> None:
        self.world = world
        self.behaviour = behaviour or Behaviour()
        robot = world.robot
        self.reach = Reach(world.scene, robot, world.arm.kinematics)
        self.joint_target = world.arm.target.copy()  # (n_arm,) rad of the next step
        self.gripper_target = world.arm.gripper_target  # metres, of the next step
        self.phase = "start"
        self.num_retries = 0
        self.trouble = ("", "")  # (phase, reason) of the last problem
        self._events: list[Event] = []
        self._free, self._clear_height = False, -math.inf
        self._missing = self._has_missed = False
        self._scale, self._closed_width = robot.task_scale, robot.gripper.min_width
        # A jaw that turns far needs longer than sliding fingers, and slows down at the end.
        self._stroke_seconds = robot.gripper.stroke_seconds() + 0.2

    @property
    def open_width(self) -> float:
        """Full opening of the gripper, metres."""
        return self.world.robot.gripper.open_width

    def _out_of_reach(self, what: str, poses: Sequence[Pose]) -> ExpertFailure:
        why = self.reach.why_not(poses[0], self.joint_target) if poses else ""
        self.note("unreachable", f"{what} is out of reach" + (f": {why}" if why else ""), trouble=True)
        return ExpertFailure(self.phase, "unreachable")

    def note(self, name: str, message: str, *, trouble: bool = False) -> None:
        """Record an event with the next step; `trouble` also keeps it as the reason of a failure."""
        self._events.append(Event(name=name, message=message, level="warning" if trouble else "info"))
        if trouble:
            self.trouble = (self.phase, name)

    def step(self) -> Step:
        """Build the control step that holds the current targets."""
        events, self._events = tuple(self._events), []
        return Step(
            action=self.world.arm.action(self.joint_target.copy(), self.gripper_target),
            phase=self.phase,
            noise_allowed=self._free and self.tcp().position[2] > self._clear_height,
            events=events,
            is_deliberate_miss=self._missing,
        )

    def tcp(self) -> Pose:
        """Compute the measured `world_from_tcp`."""
        return self.reach.tcp(self.world.arm.arm_position())

    def tcp_target(self) -> Pose:
        """Compute the commanded `world_from_tcp`."""
        return self.reach.tcp(self.joint_target)

    def reaches(self, world_from_tcp: Pose) -> bool:
        """Check whether the arm can reach a pose from its current configuration."""
        return self.reach.at_once(world_from_tcp, self.joint_target)

    def first_reachable(self, grasps: Sequence[Pose], above_by: float, *, lift_by: float = 0.0) -> Pose | None:
        """Find the first grasp that the arm reaches from `above_by` metres higher, and can lift by `lift_by` metres.

        Grasps reachable from the current configuration come first.
        """
        for grasp in self._reachable(grasps, up_to=above_by):
            descends = self.reach.descends(grasp, by=above_by, start=self.joint_target)
            if descends and self.reach.at_all(raised(grasp, lift_by)):
                return grasp
        return None

    def _reachable(self, poses: Sequence[Pose], *, up_to: float) -> Iterator[Pose]:
        """Yield poses reachable from here, `up_to` metres higher too; then those reachable from any configuration."""
        yield from within(self.reaches, poses, up_to=up_to)
        yield from within(self.reach.at_all, poses, up_to=up_to)

    def move(
        self,
        world_from_tcp: Pose,
        *,
        speed: float,
        free: bool = False,
        clear_height: float = -math.inf,
        settle: bool = True,
        until: Callable[[], bool] | None = None,
    ) -> Iterator[Step]:
        """Move in a straight line; if the arm cannot follow it and the hand is above everything, joint by joint.

        Args:
            world_from_tcp, speed: Target pose, and peak speed, m/s, times the behaviour's speed.
            free: Whether exploration noise is allowed.
            clear_height: Minimum height of the TCP, metres, for exploration noise; by default the hand is above
                everything.
            settle: Whether to wait, for a fraction of a second, until the joints have caught up.
            until: Condition that stops the motion.

        Raises:
            ExpertFailure: The arm cannot reach the pose this way.
        """
        self._free, self._clear_height = free, clear_height
        may_sink = MOST_BELOW_LINE * self._scale if free and clear_height == -math.inf else None
        path = self._path(world_from_tcp, speed=speed, may_sink=may_sink)
        if path is None:
            raise ExpertFailure(self.phase, "unreachable")
        for joint_target in path:
            self.joint_target = joint_target
            yield self.step()
            if until is not None and until():
                self.joint_target = self.world.arm.arm_position()
                return
        if settle:
            self._free = False
            tolerance, seconds = (ARRIVAL_TOLERANCE, ARRIVAL_SECONDS) if free else (SETTLE_TOLERANCE, SETTLE_SECONDS)
            for _ in range(max(1, round(seconds * self.world.fps))):
                if float(np.abs(self.world.arm.arm_position() - self.joint_target).max()) < tolerance:
                    return
                yield self.step()

    def set_gripper(self, width: float, *, max_seconds: float, done: Callable[[], bool]) -> Iterator[Step]:
        """Command an opening (m) and hold still until `done`, or until the time is over."""
        self._free = False
        self.gripper_target = width
        for _ in range(max(1, round(max_seconds * self.world.fps))):
            yield self.step()
            if done():
                return

    def open_gripper(self, *, max_seconds: float) -> Iterator[Step]:
        """Open the hand and hold still until it is open, or until the time is over."""
        open_enough = self.open_width - 0.002 * self._scale
        yield from self.set_gripper(
            self.open_width, max_seconds=max_seconds, done=lambda: self.world.arm.gripper_width() > open_enough
        )

    def pick_and_place(self, goal: Goal, *, is_begun: bool = False) -> Iterator[Step]:
        """Bring one object to its goal, repeating after a miss, a drop or a bad placement.

        `is_begun` is as in `pick`, at the first attempt. Raises ExpertFailure if it is out of reach, or after three
        attempts.
        """
        for attempt in range(MAX_TRIES):
            if attempt > 0:
                self.num_retries += 1
            self._missing = self.behaviour.misses and not self._has_missed and attempt == 0
            picked = yield from self.pick(goal.object, is_begun=is_begun and attempt == 0)
            self._missing = False
            if picked and (yield from self.place(goal)):
                return
        raise ExpertFailure(*self.trouble)

    def reachable_grasp(self, name: str, *, above_by: float, lift_by: float = 0.0) -> Pose:
        """Choose `world_from_tcp` to grasp an object, or to miss it on purpose, reachable there and `above_by` higher;
        ExpertFailure if out of reach at every yaw.
        """
        found = None
        if self._missing:
            world, x, y = self.world, self.behaviour.miss_x, self.behaviour.miss_y
            body, pose, others = world.body(name), world.pose(name), self._others(name)
            missing = grasps_beside(self.grasps(name), body, pose, x=x, y=y, others=others, robot=world.robot)
            found = next(within(self.reaches, missing, up_to=above_by), None)
            self._missing = self._has_missed = found is not None
        found = found or self.first_reachable(self.grasps(name), above_by, lift_by=lift_by)
        if found is not None:
            self.note("grasp", f"grasp {name} at yaw {hand_yaw(found):.4f} rad")
            return found
        place = np.round(self.world.pose(name).position, 3).tolist()
        raise self._out_of_reach(f"{name} at {place}", self.grasps(name))

    def reachable_place(self, position: tuple[float, float, float]) -> Pose:
        """Choose `world_from_tcp` at a position, the hand down at the nearest yaw reachable in a straight line;
        ExpertFailure if there is none.
        """
        now = hand_yaw(self.tcp())
        places = [hand_down(position, yaw) for yaw in nearest_first(symmetric_yaws(now, 24), now)]
        found = self._reachable(places, up_to=0.0)
        place = next((place for place in found if self._path(place, speed=FREE_SPEED) is not None), None)
        if place is None:
            raise self._out_of_reach(f"{np.round(position, 3).tolist()}", places)
        return place

    def pick(self, name: str, *, is_begun: bool = False) -> Generator[Step, None, bool]:
        """Grasp and lift an object; the generator returns whether it is held.

        If another controller brought the hand here (`is_begun`), it does not approach from above the object.
        """
        world, behaviour = self.world, self.behaviour
        self.phase = "perceive"
        above_by, lift = self._scale * behaviour.approach_height, self._scale * behaviour.lift_height
        start_height = world.pose(name).position[2]
        grasp = self.reachable_grasp(name, above_by=above_by, lift_by=lift)

        self.phase = "approach"
        self.gripper_target = self.open_width
        if not (is_begun and is_above(self.tcp(), grasp)):
            yield from self.move(raised(grasp, above_by), speed=FREE_SPEED, free=True)
        self.phase = "descend"
        yield from self.move(grasp, speed=DESCEND_SPEED, until=lambda: world.pressed_from_above(name))

        self.phase = "close"
        seconds = max(1.5, self._stroke_seconds)
        yield from self.set_gripper(self._closed_width, max_seconds=seconds, done=steady_width(world))
        if self.holds(name):
            self.phase = "lift"
            yield from self.move(raised(grasp, lift), speed=LIFT_SPEED)
            if self.holds(name) and world.pose(name).position[2] - start_height > 0.5 * lift:
                return True
        deliberate, self._missing = self._missing, False
        self.note("miss", f"missed {name}" + (" on purpose" if deliberate else ""), trouble=not deliberate)
        yield from self._recover(raised(grasp, above_by))
        return False

    def holds(self, name: str) -> bool:
        """Check whether both fingers press on an object that keeps them apart."""
        return self.world.grip_force(name) > 0.5 and self._is_apart(0.01)

    def place(self, goal: Goal, *, is_begun: bool = False) -> Generator[Step, None, bool]:
        """Carry the held object to its goal and release it; the generator returns whether it is placed correctly.

        If another controller brought the hand here (`is_begun`), it only descends from above the goal.
        """
        world, name = self.world, goal.object
        self.phase = "transport"
        wanted = self._place_pose(goal)
        is_there = is_begun and is_above(self.tcp(), wanted, beside=CARRIED_ABOVE_M)
        here, height = self.tcp_target(), self._transport_height(wanted)
        if not is_there and here.position[2] < height - 1e-3:
            yield from self.move(raised(here, height - here.position[2]), speed=LIFT_SPEED)
        self.note("place", f"place {name} at hand yaw {hand_yaw(wanted):.4f} rad")
        if not is_there:
            above = raised(wanted, height - wanted.position[2])
            yield from self.move(above, speed=FREE_SPEED, free=True, until=lambda: not self._is_apart(LOST_WIDTH))
        if self._is_apart(LOST_WIDTH):
            self.phase = "lower"
            wanted = self._place_pose(goal, keep_yaw=True)
            yield from self.move(raised(wanted, 0.015), speed=LIFT_SPEED, settle=False)
            # A faster behaviour does not speed this up: the target stops within one step, faster than the joint limits
            # allow. A lower control rate slows it down, since the hand presses until it is detected that the object
            # rests.
            speed = TOUCH_DOWN_SPEED * min(1.0, world.fps / 30) / max(1.0, self.behaviour.speed)
            yield from self.move(raised(wanted, -0.004), speed=speed, until=lambda: on_support(world, name, goal.onto))
        if not self._is_apart(LOST_WIDTH):
            self.note("drop", f"dropped {name}", trouble=True)
            here = self.tcp()
            yield from self._recover(raised(here, max(0.0, 0.2 * self._scale - here.position[2])))
            return False

        self.phase = "release"
        yield from self.open_gripper(max_seconds=max(1.0, self._stroke_seconds))
        self.phase = "retreat"
        here = self.tcp_target()
        away = raised(here, self._scale * max(0.1, self.behaviour.approach_height))
        clear_height = float(here.position[2]) + 0.07 * self._scale
        try:
            yield from self.move(away, speed=LIFT_SPEED, free=True, clear_height=clear_height, settle=False)
        except ExpertFailure:  # this far is enough to clear the object
            away = raised(here, self._scale * 0.1)
            yield from self.move(away, speed=LIFT_SPEED, free=True, clear_height=clear_height, settle=False)
        self.phase = "verify"
        for _ in range(round(ROCKING_SECONDS * world.fps)):  # holds still while it rocks
            if all(check.passed for check in rest_checks(world, name)):
                break
            yield self.step()
        failed = [check.name for check in placement_checks(world, goal) if not check.passed]
        if failed:
            self.note(f"misplaced_{failed[0]}", f"{name} lies badly: {', '.join(failed)}", trouble=True)
        return not failed

    def _transport_height(self, place: Pose) -> float:
        """Compute the TCP height, m, during transport: never lower than now."""
        return float(max(self.tcp_target().position[2], place.position[2] + self._scale * LEAST_ABOVE_GOAL))

    def _is_apart(self, by: float) -> bool:
        """Check whether the fingers are more than `by` metres (of an arm of task_scale 1) wider than when closed."""
        return self.world.arm.gripper_width() > self._closed_width + self._scale * by

    def _recover(self, world_from_tcp: Pose) -> Iterator[Step]:
        self.phase = "recover"
        self.joint_target = self.world.arm.arm_position()
        yield from self.open_gripper(max_seconds=0.3)
        clear_height = float(self.tcp().position[2]) + 0.07 * self._scale
        yield from self.move(world_from_tcp, speed=0.4, free=True, clear_height=clear_height)

    def grasps(self, name: str) -> list[Pose]:
        """List grasp poses `world_from_tcp` of an object with the behaviour's errors."""
        world = self.world
        body, pose = world.body(name), world.pose(name)
        grasps = grasps_of(body, pose, now=hand_yaw(self.tcp()), robot=world.robot, behaviour=self.behaviour)
        return clear_first(grasps, self._others(name), world.robot)

    def _others(self, name: str) -> list[tuple[Body, Pose]]:
        world = self.world
        return [(other, world.pose(other.name)) for other in world.scene.bodies if other.name != name]

    def _place_pose(self, goal: Goal, *, keep_yaw: bool = False) -> Pose:
        """Compute `world_from_tcp` that puts the held object at its goal; ExpertFailure if that is out of reach."""
        body, pose = self.world.body(goal.object), self.world.pose(goal.object)
        symmetry = 0 if keep_yaw else goal.yaw_symmetry or ANY_YAW
        wanted, hand = goal_pose(self.world, goal), self.tcp()
        places = places_of(body, pose, wanted, hand=hand, yaw_symmetry=symmetry)
        height = self._transport_height(places[0]) - float(places[0].position[2])
        place = next(self._reachable(places, up_to=height), None)
        if place is None:
            raise self._out_of_reach(f"the goal of {goal.object}", places)
        return place

    def _path(self, world_from_tcp: Pose, *, speed: float, may_sink: float | None = None) -> Array | None:
        return self.reach.path(
            world_from_tcp,
            start=self.joint_target,
            speed=speed,
            pace=self.behaviour.speed,
            dt=1.0 / self.world.fps,
            may_sink=may_sink,
        )
