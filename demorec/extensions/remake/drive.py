"""Send the actions of a demonstration to the simulator, record them if requested, and compare every state with the
recorded one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from itertools import zip_longest
from pathlib import Path

import numpy as np

from demorec.core.config import VideoConfig
from demorec.core.errors import ConfigError
from demorec.core.files import make_folder
from demorec.core.geometry import Array
from demorec.core.tables import TASKS
from demorec.episode.episode import Frame, Observation, Outcome, SuccessCheck
from demorec.episode.simulated import with_simulation
from demorec.extensions.remake.demonstration import JOINTS, OPENING, POSE_OF, Demonstration, ReplayOptions, seen_in
from demorec.extensions.remake.rerender import config_as, finished_outcome, recorded_view, view_behaviour, view_painter
from demorec.loop import Session, SimulatorCache, Step
from demorec.loop.actions import ActionDecoder
from demorec.mcap import EpisodeWriter
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
        world: World of its robot and rate; it is reset.
        options: Options of the replay.
        painter: Draws the frames' images; None for none.
        sink: Called with every frame of the replay before its command is sent.

    Returns:
        The report, and the outcome of the replay.
    """
    d = demonstration
    task = None if d.is_measured else TASKS.load(d.info.simulated.task, options.allowed)()
    session = Session(world, d.info.simulated.scene, task, painter=painter)
    agent = DemonstrationAgent(d)
    seen: list[Observation] = []
    for frame in session.run(agent):
        seen.append(frame.observation)
        if sink is not None:
            sink(frame)
    return _report(d, seen, session.outcome, unreachable=agent.num_unreachable), session.outcome


class DemonstrationAgent:
    """Agent that sends the recorded commands; label, phase and events are those of the recorded frames, if any."""

    num_retries = 0

    def __init__(self, demonstration: Demonstration) -> None:
        self._demonstration = demonstration
        self.num_unreachable = 0
        """Number of steps with an unreachable pose, or a target that is not finite."""

    def decide(self, world: World) -> Iterator[Step]:
        """See `demorec.loop.Agent`."""
        d = self._demonstration
        for frame in d.recorded:
            yield Step(
                action=frame.action,
                command=frame.command,
                phase=frame.phase,
                events=frame.events,
                is_deliberate_miss=frame.is_deliberate_miss,
            )
        if d.actions is None or d.action_kind is None:
            return
        decoder = ActionDecoder(world, d.action_kind, is_limited=False)
        num_held = 0
        for action in d.actions:
            command = decoder.command(action)
            if not np.isfinite(command.joint_target).all():  # from a damaged dataset: the arm stays in place
                num_held += 1
                command = replace(world.hold(), gripper_target=command.gripper_target)
            self.num_unreachable = num_held + decoder.num_unreachable
            yield Step(action=command)

    def failure(self, failed: Sequence[str]) -> tuple[str, str]:
        """See `demorec.loop.Agent`."""
        return ("replay", failed[0]) if failed else ("", "")


def _report(d: Demonstration, seen: Sequence[Observation], outcome: Outcome, *, unreachable: int) -> ReplayReport:
    off = _differences(d, seen)
    differs = np.array([~(np.abs(values).max(axis=1) <= d.tolerance) for values in off.values()])  # as NaN does
    first = None
    if differs.any():
        step = int(differs.any(axis=0).argmax())
        first = step, list(off)[int(differs[:, step].argmax())]
    elif d.outcome is not None and d.outcome.final_state_digest:
        if d.outcome.final_state_digest != outcome.final_state_digest:
            first = len(seen), "the final state"
        elif d.outcome.checks != outcome.checks:
            first = len(seen), _other_condition(outcome.checks, d.outcome.checks)
    arm = np.abs(off[JOINTS][:, : len(d.info.simulated.robot.arm_joints)]).max(axis=1)
    distances = np.array([np.linalg.norm(off[f"{POSE_OF}{name}"][:, :3], axis=1) for name in d.objects])
    number, step = divmod(int(distances.argmax()), distances.shape[1]) if len(distances) else (0, 0)
    distance = float(distances[number, step]) if len(distances) else 0.0
    failed = tuple(check.name for check in outcome.checks if not check.passed)
    success = not failed if outcome.checks else None
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
    return {name: np.array([values[name] for values in now]) - recorded for name, recorded in d.compared.items()}


def is_as_recorded(report: ReplayReport, *, tolerance: float = 0.0) -> bool:
    """Whether a replay agrees with the recording: a recording's states and outcome, a dataset's outcome.

    Args:
        report: Report of the replay.
        tolerance: Maximum difference (m, rad) of equal states; for a real arm's data, 0 means unlimited.
    """
    if report.tracking and tolerance:
        return max(report.joint_error, report.gripper_error) <= tolerance
    if not report.is_bitwise:
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
        out: Folder for recordings of the replays, under the same names and with images of the recorded cameras; one
            that the same call has already made stays. None records nothing.
        overwrite: Whether recordings there may be replaced.

    Yields:
        The report, and (recording, recording of its replay) if one was made.

    Raises:
        NotAllowedError: A demonstration's task is in a module that `options` do not allow.
        ConfigError: A new recording would replace its own source, or a file with that name exists already.
    """
    allow_models(options.allowed)
    with closing(SimulatorCache()) as simulators:
        for d in demonstrations:
            if not d.is_measured:
                TASKS.check_name(d.info.simulated.task, options.allowed)  # before anything is created
            if out is None:
                yield _replay_blind(d, simulators, options), None
                continue
            path = out / (d.name if d.source is not None else f"{d.name}.mcap")
            report = _record_replay(d, simulators, options, path, overwrite=overwrite)
            yield report, None if d.source is None else (d.source, path)


def _record_replay(
    d: Demonstration, simulators: SimulatorCache, options: ReplayOptions, path: Path, *, overwrite: bool
) -> ReplayReport:
    if d.source is not None and path.resolve() == d.source.resolve():
        raise ConfigError(f"The replay would replace its own source: choose another --out: {path.parent}")
    make_folder(path.parent)
    view = recorded_view(d.info)
    behaviour = view_behaviour(d.info, view)
    info = with_simulation(replace(d.info, origin=f"replay of {d.digest[:16]}"), behaviour=behaviour)
    if not overwrite and finished_outcome(path, info) is not None:
        return _replay_blind(d, simulators, options)
    video = config_as(d.info.simulated.config.get("video", {}), VideoConfig)
    world, renderer = simulators.acquire(info)
    painter = view_painter(renderer, view, d.info.simulated.config) if renderer else None
    with EpisodeWriter(path, info, video=video, overwrite=overwrite) as writer:
        report, outcome = replay(d, world, options, painter=painter, sink=writer.write)
        writer.finish(outcome)
    return report


def _replay_blind(d: Demonstration, simulators: SimulatorCache, options: ReplayOptions) -> ReplayReport:
    """Replay without images."""
    world, _ = simulators.acquire(with_simulation(d.info, scene=replace(d.info.simulated.scene, cameras=()), config={}))
    return replay(d, world, options)[0]
