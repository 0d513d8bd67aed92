"""Send the actions of a demonstration to the simulator, record them if requested, and compare every state with the
recorded one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from itertools import chain, repeat, zip_longest
from pathlib import Path

import numpy as np

from demorec.core.config import VideoConfig
from demorec.core.errors import ConfigError
from demorec.core.files import make_folder
from demorec.core.geometry import Array
from demorec.core.seeding import generator
from demorec.core.tables import TASKS
from demorec.episode.episode import Action, Frame, Observation, Outcome, SuccessCheck
from demorec.episode.simulated import with_simulation
from demorec.extensions.remake.demonstration import JOINTS, OPENING, POSE_OF, Demonstration, ReplayOptions, seen_in
from demorec.extensions.remake.rerender import config_as, finished_outcome, recorded_view, view_behaviour, view_painter
from demorec.loop import Session, SimulatorCache, Step
from demorec.loop.actions import ActionDecoder
from demorec.mcap import EpisodeWriter
from demorec.mcap.frames import pose_of
from demorec.render.painter import Painter
from demorec.robots.assets import allow_models
from demorec.sim.world import World


@dataclass(frozen=True, kw_only=True)
class ReplayReport:
    """Comparison of a replay with the recording.

    Attributes:
        name: Name of the demonstration.
        num_steps: Number of commands sent.
        is_bitwise: Whether full float64 states were compared and must be bit-exact.
        compared: Names of the compared quantities.
        is_identical: All of this, the final state's digest and the conditions of a recording's outcome are bit-exact
        (float32 datasets: equal up to rounding).
        first_difference: First step with a different state, and the quantity; None if all are equal.
        joint_error, joint_error_step: Largest difference of an arm joint, rad, and its step.
        gripper_error: Largest difference of the opening, m.
        object_error, object_error_step, object_error_name: Largest distance of an object from its recorded place, m.
        compares_objects: Whether object positions were recorded; datasets have none.
        recorded_success, success: Success of the recording and of the replay; None if unknown or not judged.
        is_outcome_as_recorded: Both are equal, or one is unknown. A failure with a recorded reason (the expert gave up)
        remains one even if the conditions hold.
        failed_checks: Conditions that do not hold in the replay.
        unreachable: Number of steps with a pose out of reach (the arm held its last target).
        tracking: Arm joint (rad) or "gripper" (m) -> median and largest difference from a real arm's measurements;
        empty for simulated episodes.
    """

    name: str
    num_steps: int
    is_bitwise: bool
    compared: tuple[str, ...]
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
    is_outcome_as_recorded: bool
    failed_checks: tuple[str, ...] = ()
    unreachable: int = 0
    tracking: Mapping[str, tuple[float, float]] = field(default_factory=dict)


def replay(
    demonstration: Demonstration,
    world: World,
    options: ReplayOptions,
    *,
    painter: Painter | None = None,
    sink: Callable[[Frame], None] | None = None,
) -> tuple[ReplayReport, Outcome]:
    """Send the actions of a demonstration and compare.

    Args:
        demonstration: Demonstration to replay.
        world: World of its robot and rate (`World(info.simulated.robot, fps=demonstration.fps)`); it is reset.
        options: Options of the replay.
        painter: Draws the frames' images; None for none.
        sink: Called with every frame of the replay before its command is sent.

    Returns:
        The report, and the outcome of the replay; with `states`, which judges nothing, the recorded outcome.
    """
    d = demonstration
    task = None if options.states or d.is_measured else TASKS.load(d.info.simulated.task, options.allowed)()
    session = Session(world, d.info.simulated.scene, task, painter=painter)
    agent = DemonstrationAgent(d, options)
    seen: list[Observation] = []
    for frame in _placed(session, d) if options.states else session.run(agent):
        seen.append(frame.observation)
        if sink is not None:
            sink(frame)
    outcome = _recorded_outcome(d, world) if options.states else session.outcome
    return _report(d, seen, outcome, is_judged=not options.states, unreachable=agent.num_unreachable), outcome


class DemonstrationAgent:
    """Agent that sends the recorded commands, delayed, with noise or unchanged."""

    num_retries = 0

    def __init__(self, demonstration: Demonstration, options: ReplayOptions) -> None:
        self._demonstration, self._options = demonstration, options
        self._decoder: ActionDecoder | None = None
        self._num_held = 0

    @property
    def num_unreachable(self) -> int:
        """Number of steps with an unreachable pose, or a target that is not finite."""
        return self._num_held + (0 if self._decoder is None else self._decoder.num_unreachable)

    def decide(self, world: World) -> Iterator[Step]:
        """See `demorec.loop.Agent`; label, phase and events are taken from the recorded frame, if any."""
        recorded = chain(self._demonstration.recorded, repeat(None))
        for command in self._sent(world):
            yield _step(command, next(recorded))

    def _sent(self, world: World) -> Iterator[Action]:
        d, options = self._demonstration, self._options
        rng = generator(
            root_seed=options.seed, episode_index=d.info.episode_index, attempt=d.info.attempt, purpose="noise"
        )
        for _ in range(options.delay):
            yield world.hold()
        for command in self._commands(world):
            if not np.isfinite(command.joint_target).all():  # from a damaged dataset: the arm stays in place
                self._num_held += 1
                command = replace(world.hold(), gripper_target=command.gripper_target)
            if options.noise > 0.0:
                low, high = world.arm.kinematics.lower, world.arm.kinematics.upper
                target = command.joint_target + rng.normal(0.0, options.noise, len(command.joint_target))
                command = world.arm.action(np.clip(target, low, high), command.gripper_target)
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


def _step(command: Action, recorded: Frame | None) -> Step:
    if recorded is None:
        return Step(action=command)
    return Step(
        action=recorded.action,
        command=command,
        phase=recorded.phase,
        events=recorded.events,
        is_deliberate_miss=recorded.is_deliberate_miss,
    )


def _placed(session: Session, d: Demonstration) -> Iterator[Frame]:
    """Yield frames with the recorded states in sequence, without physics."""
    session.reset()
    for step, recorded in zip(range(d.num_steps), chain(d.recorded, repeat(None)), strict=False):
        session.place(
            step,
            joint_position=d.compared[JOINTS][step],
            object_poses={name: pose_of(d.compared[f"{POSE_OF}{name}"][step]) for name in d.objects},
        )
        command = session.world.hold() if recorded is None else recorded.command
        yield session.frame(_step(command, recorded))


def _recorded_outcome(d: Demonstration, world: World) -> Outcome:
    success = bool(d.success)
    return Outcome(
        success=success,
        checks=() if d.outcome is None else d.outcome.checks,
        failure_phase="" if success else "replay",
        failure_reason="" if success else "unknown",
        num_frames=d.num_steps,
        final_state_digest=world.state_digest(),
    )


def _report(
    d: Demonstration, seen: Sequence[Observation], outcome: Outcome, *, is_judged: bool, unreachable: int
) -> ReplayReport:
    off = _differences(d, seen[: d.num_steps])
    differs = np.array([~(np.abs(values).max(axis=1) <= d.tolerance) for values in off.values()])  # as NaN does
    first = None
    if differs.any():
        step = int(differs.any(axis=0).argmax())
        first = step, list(off)[int(differs[:, step].argmax())]
    elif is_judged and d.outcome is not None and d.outcome.final_state_digest:
        if d.outcome.final_state_digest != outcome.final_state_digest:
            first = d.num_steps, "the final state"
        elif d.outcome.checks != outcome.checks:
            first = d.num_steps, _other_condition(outcome.checks, d.outcome.checks)
    arm = np.abs(off[JOINTS][:, : len(d.info.simulated.robot.arm_joints)]).max(axis=1)
    distances = np.array([np.linalg.norm(off[f"{POSE_OF}{name}"][:, :3], axis=1) for name in d.objects])
    number, step = divmod(int(distances.argmax()), distances.shape[1]) if len(distances) else (0, 0)
    distance = float(distances[number, step]) if len(distances) else 0.0
    checks = outcome.checks if is_judged else ()
    failed = tuple(check.name for check in checks if not check.passed)
    success = not failed if checks else None
    return ReplayReport(
        name=d.name,
        num_steps=len(seen),
        is_bitwise=d.action_kind is None,
        compared=tuple(off),
        is_identical=first is None,
        first_difference=first,
        joint_error=float(arm.max()),
        joint_error_step=int(arm.argmax()),
        gripper_error=float(np.abs(off[OPENING]).max()),
        object_error=distance,
        object_error_step=step,
        object_error_name="" if distance == 0.0 else d.objects[number],
        compares_objects=bool(d.objects),
        recorded_success=d.success,
        success=success,
        is_outcome_as_recorded=None in (success, d.success) or success == d.success or (d.gave_up and not d.success),
        failed_checks=failed,
        unreachable=unreachable,
        tracking=_tracking(d, off) if d.is_measured else {},
    )


def _tracking(d: Demonstration, off: Mapping[str, Array]) -> dict[str, tuple[float, float]]:
    columns = np.abs(np.column_stack([off[JOINTS], off[OPENING]])).T
    names = (*d.info.simulated.robot.arm_joints, "gripper")
    return {name: (float(np.median(column)), float(column.max())) for name, column in zip(names, columns, strict=True)}


def _other_condition(now: Sequence[SuccessCheck], recorded: Sequence[SuccessCheck]) -> str:
    """The first condition that differs from the recorded one."""
    pairs = zip_longest(now, recorded)
    return next(f"the condition {(one or other).name}" for one, other in pairs if one != other)


def _differences(d: Demonstration, seen: Sequence[Observation]) -> dict[str, Array]:
    """Compared quantity -> (T, D), replayed minus recorded values."""
    width = d.compared[JOINTS].shape[1]  # datasets have only the arm's joints
    now = [seen_in(observation) | {JOINTS: observation.joint_position[:width]} for observation in seen]
    return {
        name: np.array([values[name] for values in now]) - recorded[: len(seen)]
        for name, recorded in d.compared.items()
    }


def is_as_recorded(report: ReplayReport, *, tolerance: float = 0.0, bitwise: bool = True) -> bool:
    """Whether a replay agrees with the recording.

    Args:
        report: Report of the replay.
        tolerance: Maximum difference (m, rad) of equal states; for a real arm's data, 0 means unlimited.
        bitwise: Whether the states must be equal; otherwise (changed commands) only the outcome counts.
    """
    if report.tracking and tolerance:
        return max(report.joint_error, report.gripper_error) <= tolerance
    if not report.is_bitwise or not bitwise:
        return report.is_outcome_as_recorded
    errors = report.joint_error, report.gripper_error, report.object_error
    return report.is_outcome_as_recorded and (report.is_identical or 0.0 < max(errors) <= tolerance)


def replay_all(
    demonstrations: Iterable[Demonstration], options: ReplayOptions, *, out: Path | None = None, overwrite: bool = False
) -> Iterator[tuple[ReplayReport, tuple[Path, Path] | None]]:
    """Replay in sequence, in one world as long as robot and rate stay the same.

    Args:
        demonstrations: Demonstrations to replay.
        options: Options of the replay.
        out: Folder for recordings of the replays; None records nothing.
        overwrite: Whether recordings there may be replaced.

    Yields:
        The report, and (recording, recording of its replay) if one was made.

    Raises:
        NotAllowedError: A demonstration's task is in a module that `options` do not allow.
    """
    allow_models(options.allowed)
    with closing(SimulatorCache()) as simulators:
        for demonstration in demonstrations:
            if not (options.states or demonstration.is_measured):
                TASKS.check_name(demonstration.info.simulated.task, options.allowed)  # before anything is created
            if out is not None:
                yield record_replay(demonstration, simulators, options, out, overwrite=overwrite)
                continue
            yield _replay_blind(demonstration, simulators, options), None


def record_replay(
    demonstration: Demonstration, simulators: SimulatorCache, options: ReplayOptions, out: Path, *, overwrite: bool
) -> tuple[ReplayReport, tuple[Path, Path] | None]:
    """Replay and record it, with images of the recording's cameras, to a file with the same name in `out`.

    A recording that the same call has already made stays, unless it is to be replaced.

    Returns:
        As in `replay_all`.

    Raises:
        ConfigError: The new recording would replace its own source, or a file with that name exists already.
    """
    d = demonstration
    path = out / (d.name if d.source is not None else f"{d.name}.mcap")
    if d.source is not None and path.resolve() == d.source.resolve():
        raise ConfigError(f"The replay would replace its own source: choose another --out: {out}")
    view = recorded_view(d.info)
    make_folder(out)
    behaviour = view_behaviour(d.info, view)
    origin = f"replay of {d.digest[:16]}{options.changes}"
    info = with_simulation(replace(d.info, fps=d.fps, origin=origin), behaviour=behaviour)
    pair = None if d.source is None else (d.source, path)
    if not overwrite and finished_outcome(path, info) is not None:
        return _replay_blind(d, simulators, options), pair
    video = config_as(d.info.simulated.config.get("video", {}), VideoConfig)
    world, renderer = simulators.acquire(info)
    painter = view_painter(renderer, view, d.info.simulated.config) if renderer else None
    with EpisodeWriter(path, info, video=video, overwrite=overwrite) as writer:
        report, outcome = replay(d, world, options, painter=painter, sink=writer.write)
        writer.finish(outcome)
    return report, pair


def _replay_blind(d: Demonstration, simulators: SimulatorCache, options: ReplayOptions) -> ReplayReport:
    """Replay without images."""
    blind = replace(d.info.simulated.scene, cameras=())
    info = with_simulation(replace(d.info, fps=d.fps), scene=blind, config={})
    world, _ = simulators.acquire(info)
    return replay(d, world, options)[0]
