"""The actions of a demonstration into the simulator, and every state compared with the recorded one."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from demorec.episode import Action, Check, Frame, frame_time_ns
from demorec.geometry import Array
from demorec.recording.streams import pose_of
from demorec.replay.demonstration import Demonstration, ReplayOptions
from demorec.seeding import generator
from demorec.sim.world import World
from demorec.tables import TASKS

FrameSink = Callable[[Frame], None]


@dataclass(frozen=True, kw_only=True)
class ReplayReport:
    """How a replay compares with the recording.

    Attributes:
        name: What was replayed.
        num_steps: Commands sent.
        is_bitwise: Whether full float64 states were compared, so that nothing may differ.
        is_identical: No bit of any compared state differs, the final state's digest included (float32 datasets: no
            more than rounding).
        first_difference: First step with another state, and what differed there; None when none does.
        joint_error, joint_error_step: Largest difference of an arm joint, rad, and where.
        gripper_error: Largest difference of the opening, m.
        object_error, object_error_step, object_error_name: Largest distance of an object from its recorded place, m.
        compares_objects: Whether the places of objects were recorded; a dataset has none.
        recorded_success, success: Of the task, then and now; None where that is not known or not judged.
        failed_checks: Conditions that do not hold now.
        unreachable: Steps whose pose inverse kinematics did not reach (the arm held its last target).
    """

    name: str
    num_steps: int
    is_bitwise: bool
    is_identical: bool
    first_difference: tuple[int, str] | None
    joint_error: float
    joint_error_step: int
    gripper_error: float
    object_error: float
    object_error_step: int
    object_error_name: str
    compares_objects: bool
    recorded_success: bool | None
    success: bool | None
    failed_checks: tuple[str, ...] = ()
    unreachable: int = 0


@dataclass(kw_only=True)
class _Comparison:
    """What is kept of the comparison while the steps go by."""

    demonstration: Demonstration
    first: tuple[int, str] | None = None
    joint: tuple[float, int] = (0.0, 0)
    gripper: float = 0.0
    object: tuple[float, int, str] = (0.0, 0, "")
    unreachable: int = 0

    def take(self, step: int, world: World) -> None:
        """Compare the world's present state with the recorded one of a step."""
        d, seen = self.demonstration, world.observe()
        num_arm = len(d.info.robot.arm_joints)
        recorded = d.joint_position[step]
        differences = [
            ("joint positions", float(np.abs(seen.joint_position[: len(recorded)] - recorded).max())),
            ("gripper opening", abs(seen.gripper_width - float(d.gripper_width[step]))),
        ]
        if d.joint_velocity is not None:
            off = np.abs(seen.joint_velocity - d.joint_velocity[step])
            differences.append(("joint velocities", float(off.max())))
        for name, poses in d.object_poses.items():
            off = np.abs(seen.object_poses[name].vector() - poses[step])
            differences.append((f"the pose of {name}", float(off.max())))
            distance = math.dist(seen.object_poses[name].position, poses[step, :3])
            if distance > self.object[0] or not math.isfinite(distance):
                self.object = (distance, step, name)
        if self.first is None:
            # Written so that what is no number differs.
            what = next((name for name, off in differences if not off <= d.tolerance), None)
            self.first = None if what is None else (step, what)
        arm = float(np.abs(seen.joint_position[:num_arm] - recorded[:num_arm]).max())
        if arm > self.joint[0] or not math.isfinite(arm):
            self.joint = (arm, step)
        self.gripper = max(self.gripper, differences[1][1])


def replay(
    demonstration: Demonstration, world: World, options: ReplayOptions, *, sink: FrameSink | None = None
) -> tuple[ReplayReport, tuple[Check, ...]]:
    """Send the actions of a demonstration and compare.

    Args:
        demonstration: What to do.
        world: Of its robot and rate (`World(info.robot, fps=demonstration.fps)`); is reset.
        options: How.
        sink: Is given every frame of the replay, without pictures, before its command is sent.

    Returns:
        The report, and the task's conditions at the end (empty with `states`).
    """
    d = demonstration
    task = None if options.states else TASKS.load(d.info.task, options.allowed)()
    world.reset(d.info.scene)
    comparison = _Comparison(demonstration=d)
    if task is None:
        for step in range(d.num_steps):
            place_state(world, d, step)
            comparison.take(step, world)
            if sink is not None:
                command = d.recorded[step].command if step < len(d.recorded) else _hold(world)
                sink(_frame(world, step, d.fps, command))
        return _report(comparison, checks=(), digest=None), ()
    num_steps = 0
    for step, command in enumerate(_sent(d, world, options, comparison)):
        if step < d.num_steps:
            comparison.take(step, world)
        if sink is not None:
            sink(_frame(world, step, d.fps, command))
        world.apply(command)
        num_steps = step + 1
    checks = task.evaluate(world)
    digest = world.state_digest() if d.final_state_digest else None
    report = _report(comparison, checks=checks, digest=digest)
    return replace(report, num_steps=num_steps), checks


def _sent(d: Demonstration, world: World, options: ReplayOptions, comparison: _Comparison) -> Iterator[Action]:
    rng = generator(root_seed=options.seed, episode_index=d.info.episode_index, attempt=d.info.attempt, purpose="noise")
    for _ in range(options.delay):
        yield _hold(world)
    for command in d.commands(world):
        if not np.isfinite(command.joint_target).all():  # IK's way to say that it found nothing
            comparison.unreachable += 1
            command = replace(_hold(world), gripper_target=command.gripper_target)
        if options.noise > 0.0:
            command = _noisy(command, world, rng.normal(0.0, options.noise, len(command.joint_target)))
        yield command


def _noisy(command: Action, world: World, noise: Array) -> Action:
    low, high = np.array(world.robot.position_lower), np.array(world.robot.position_upper)
    target = np.clip(command.joint_target + noise, low, high)
    return Action(
        joint_target=target,
        gripper_target=command.gripper_target,
        base_from_tcp_target=world.arm.kinematics.forward(target),
    )


def _hold(world: World) -> Action:
    target = world.arm.target.copy()
    return Action(
        joint_target=target,
        gripper_target=world.arm.gripper_target,
        base_from_tcp_target=world.arm.kinematics.forward(target),
    )


def place_state(world: World, demonstration: Demonstration, step: int) -> None:
    """Put joints and objects where they were recorded at a step, without physics."""
    world.set_state(
        joint_position=demonstration.joint_position[step],
        object_poses={name: pose_of(poses[step]) for name, poses in demonstration.object_poses.items()},
    )


def _frame(world: World, step: int, fps: int, command: Action) -> Frame:
    return Frame(
        frame_index=step,
        time_ns=frame_time_ns(step, fps),
        observation=world.observe(),
        action=command,
        command=command,
        phase="",
        joint_samples=world.joint_samples,
    )


def _report(comparison: _Comparison, *, checks: Sequence[Check], digest: str | None) -> ReplayReport:
    d = comparison.demonstration
    first = comparison.first
    if first is None and digest is not None and digest != d.final_state_digest:
        first = (d.num_steps, "the final state")
    failed = tuple(check.name for check in checks if not check.passed)
    return ReplayReport(
        name=d.name,
        num_steps=d.num_steps,
        is_bitwise=bool(d.object_poses) or d.joint_velocity is not None,
        is_identical=first is None,
        first_difference=first,
        joint_error=comparison.joint[0],
        joint_error_step=comparison.joint[1],
        gripper_error=comparison.gripper,
        object_error=comparison.object[0],
        object_error_step=comparison.object[1],
        object_error_name=comparison.object[2],
        compares_objects=bool(d.object_poses),
        recorded_success=d.recorded_success,
        success=not failed if checks else None,
        failed_checks=failed,
        unreachable=comparison.unreachable,
    )


def is_as_recorded(report: ReplayReport, *, tolerance: float = 0.0, bitwise: bool = True) -> bool:
    """Whether a replay is what the recording says.

    Args:
        report: Of the replay.
        tolerance: Differences (m, rad) up to which states count as the same.
        bitwise: Whether the states must be the same; otherwise (changed commands) the outcome alone counts.
    """
    if not report.is_bitwise or not bitwise:
        return report.success is None or report.recorded_success is None or report.success == report.recorded_success
    return report.is_identical or (
        tolerance > 0.0
        and max(report.joint_error, report.gripper_error, report.object_error) <= tolerance
        and report.success == report.recorded_success
    )
