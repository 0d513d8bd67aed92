"""The actions of a demonstration into the simulator, and every state compared with the recorded one."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain, repeat

import numpy as np

from demorec.core.geometry import Array
from demorec.core.seeding import generator
from demorec.core.tables import TASKS
from demorec.episode.episode import Action, Frame, Outcome
from demorec.loop import Decision, Session
from demorec.loop.actions import ActionDecoder
from demorec.mcap.streams import pose_of
from demorec.render.painter import Painter
from demorec.replay.demonstration import Demonstration, ReplayOptions
from demorec.sim.world import World

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

    def take(self, frame: Frame) -> None:
        """Compare what is seen now with what was recorded at that step."""
        d, seen, step = self.demonstration, frame.observation, frame.frame_index
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
    demonstration: Demonstration,
    world: World,
    options: ReplayOptions,
    *,
    painter: Painter | None = None,
    sink: FrameSink | None = None,
) -> tuple[ReplayReport, Outcome]:
    """Send the actions of a demonstration and compare.

    Args:
        demonstration: What to do.
        world: Of its robot and rate (`World(info.robot, fps=demonstration.fps)`); is reset.
        options: How.
        painter: For the pictures of the frames, or None.
        sink: Is given every frame of the replay before its command is sent.

    Returns:
        The report, and how the replay ended; with `states`, which judge nothing, how the recording did.
    """
    d = demonstration
    task = None if options.states else TASKS.load(d.info.task, options.allowed)()
    session = Session(world, d.info.scene, task, painter=painter)
    agent = DemonstrationAgent(d, options)
    comparison = _Comparison(demonstration=d)
    num_steps = 0
    for frame in _placed(session, d) if options.states else session.run(agent):
        if frame.frame_index < d.num_steps:
            comparison.take(frame)
        if sink is not None:
            sink(frame)
        num_steps += 1
    outcome = _recorded_outcome(d, world) if options.states else session.outcome
    return _report(comparison, agent, outcome, num_steps=num_steps, is_judged=not options.states), outcome


class DemonstrationAgent:
    """Says what was recorded, as the options want it sent: late, with noise, or as it is."""

    num_retries = 0

    def __init__(self, demonstration: Demonstration, options: ReplayOptions) -> None:
        self._demonstration, self._options = demonstration, options
        self._decoder: ActionDecoder | None = None
        self._num_held = 0

    @property
    def num_unreachable(self) -> int:
        """Steps whose pose inverse kinematics did not reach, or whose target is not a number."""
        return self._num_held + (0 if self._decoder is None else self._decoder.num_unreachable)

    def decide(self, world: World) -> Iterator[Decision]:
        """See `demorec.loop.Agent`; label, phase and events are those of the recorded frame, if there is one."""
        recorded = chain(self._demonstration.recorded, repeat(None))
        for command in self._sent(world):
            yield _decision(command, next(recorded))

    def _sent(self, world: World) -> Iterator[Action]:
        d, options = self._demonstration, self._options
        rng = generator(
            root_seed=options.seed, episode_index=d.info.episode_index, attempt=d.info.attempt, purpose="noise"
        )
        for _ in range(options.delay):
            yield world.hold()
        for command in self._commands(world):
            if not np.isfinite(command.joint_target).all():  # of a damaged dataset: the arm stays where it is
                self._num_held += 1
                command = replace(world.hold(), gripper_target=command.gripper_target)
            if options.noise > 0.0:
                command = _noisy(command, world, rng.normal(0.0, options.noise, len(command.joint_target)))
            yield command

    def _commands(self, world: World) -> Iterable[Action]:
        d = self._demonstration
        if d.actions is None or d.action_kind is None:
            return d.commands
        self._decoder = ActionDecoder(world, d.action_kind, is_limited=False)
        return map(self._decoder.command, d.actions)

    def failure(self, failed: Sequence[str]) -> tuple[str, str]:
        """See `demorec.loop.Agent`."""
        return ("replay", failed[0]) if failed else ("", "")


def _decision(command: Action, recorded: Frame | None) -> Decision:
    if recorded is None:
        return Decision(action=command, command=command)
    return Decision(
        action=recorded.action,
        command=command,
        phase=recorded.phase,
        events=recorded.events,
        is_deliberate_miss=recorded.is_deliberate_miss,
    )


def _noisy(command: Action, world: World, noise: Array) -> Action:
    low, high = np.array(world.robot.position_lower), np.array(world.robot.position_upper)
    target = np.clip(command.joint_target + noise, low, high)
    return Action(
        joint_target=target,
        gripper_target=command.gripper_target,
        base_from_tcp_target=world.arm.kinematics.forward(target),
    )


def _placed(session: Session, d: Demonstration) -> Iterator[Frame]:
    """The recorded states one after the other, without physics."""
    session.reset()
    for step, recorded in zip(range(d.num_steps), chain(d.recorded, repeat(None)), strict=False):
        session.place(
            step,
            joint_position=d.joint_position[step],
            object_poses={name: pose_of(poses[step]) for name, poses in d.object_poses.items()},
        )
        command = session.world.hold() if recorded is None else recorded.command
        yield session.frame(_decision(command, recorded))


def _recorded_outcome(d: Demonstration, world: World) -> Outcome:
    success = bool(d.recorded_success)
    return Outcome(
        success=success,
        checks=d.recorded_checks,
        failure_phase="" if success else "replay",
        failure_reason="" if success else "unknown",
        num_frames=d.num_steps,
        final_state_digest=world.state_digest(),
    )


def _report(
    comparison: _Comparison, agent: DemonstrationAgent, outcome: Outcome, *, num_steps: int, is_judged: bool
) -> ReplayReport:
    d = comparison.demonstration
    first = comparison.first
    if first is None and is_judged and d.final_state_digest not in ("", outcome.final_state_digest):
        first = (d.num_steps, "the final state")
    checks = outcome.checks if is_judged else ()
    failed = tuple(check.name for check in checks if not check.passed)
    return ReplayReport(
        name=d.name,
        num_steps=num_steps,
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
        unreachable=agent.num_unreachable,
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
