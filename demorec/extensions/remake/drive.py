"""Send the actions of a demonstration to the simulator, record them if requested, and compare every state with the
recorded one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import zip_longest
from pathlib import Path

import numpy as np

from demorec.core.config import VideoConfig
from demorec.core.errors import ConfigError
from demorec.core.files import make_folder
from demorec.core.geometry import Array
from demorec.core.tables import RENDERERS, TASKS
from demorec.episode.episode import Frame, Observation, Outcome, SuccessCheck
from demorec.episode.info import EpisodeInfo
from demorec.episode.simulated import with_simulation
from demorec.extensions.remake.demonstration import JOINTS, OPENING, POSE_OF, Demonstration, seen_in
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
        is_identical: All states, the final state's digest and the conditions of a recording's outcome are bit-exact
        (float32 datasets: equal up to rounding).
        first_difference: First step with a different state, and the quantity; None if all are equal.
        joint_error: Largest difference of an arm joint, rad.
        gripper_error: Largest difference of the opening, m.
        object_error: Largest distance of an object from its recorded place, m; None if no object was recorded.
        recorded_success, success: Success of the recording and of the replay; None if unknown or not judged.
        is_outcome_as_recorded: Both are equal, or one is unknown. A failure with a recorded reason (the expert gave up)
        remains one even if the conditions hold.
        failed_checks: Conditions that do not hold in the replay.
        unreachable: Number of steps with a pose out of reach (the arm held its last target).
    """

    name: str
    num_steps: int
    is_bitwise: bool
    is_identical: bool
    first_difference: tuple[int, str] | None
    joint_error: float
    gripper_error: float
    object_error: float | None
    recorded_success: bool | None
    success: bool | None
    is_outcome_as_recorded: bool
    failed_checks: tuple[str, ...] = ()
    unreachable: int = 0


def replay(
    demonstration: Demonstration,
    world: World,
    allowed: Sequence[str] = (),
    *,
    painter: Painter | None = None,
    sink: Callable[[Frame], None] | None = None,
) -> tuple[ReplayReport, Outcome]:
    """Send the actions of a demonstration and compare.

    Args:
        demonstration: Demonstration to replay.
        world: World of its robot and rate; it is reset.
        allowed: The user's own modules that may be imported for its task.
        painter: Draws the frames' images; None for none.
        sink: Called with every frame of the replay before its command is sent.

    Returns:
        The report, and the outcome of the replay.
    """
    simulated = demonstration.info.simulated
    session = Session(world, simulated.scene, TASKS.load(simulated.task, allowed)(), painter=painter)
    agent = DemonstrationAgent(demonstration)
    seen: list[Observation] = []
    for frame in session.run(agent):
        seen.append(frame.observation)
        if sink is not None:
            sink(frame)
    return _report(demonstration, seen, session.outcome, unreachable=agent.num_unreachable), session.outcome


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
    distances = [np.linalg.norm(way[:, :3], axis=1).max() for name, way in off.items() if name.startswith(POSE_OF)]
    failed = tuple(check.name for check in outcome.checks if not check.passed)
    success = not failed if outcome.checks else None
    recorded = None if d.outcome is None else d.outcome.success
    return ReplayReport(
        name=d.name,
        num_steps=len(seen),
        is_bitwise=d.action_kind is None,
        is_identical=first is None,
        first_difference=first,
        joint_error=float(np.abs(off[JOINTS][:, : len(d.info.simulated.robot.arm_joints)]).max()),
        gripper_error=float(np.abs(off[OPENING]).max()),
        object_error=float(max(distances)) if distances else None,
        recorded_success=recorded,
        success=success,
        is_outcome_as_recorded=None in (success, recorded) or success == recorded or (d.gave_up and not recorded),
        failed_checks=failed,
        unreachable=unreachable,
    )


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
        tolerance: Maximum difference (m, rad) of equal states.
    """
    if not report.is_bitwise:
        return report.is_outcome_as_recorded
    errors = report.joint_error, report.gripper_error, report.object_error or 0.0
    return report.is_outcome_as_recorded and (report.is_identical or 0.0 < max(errors) <= tolerance)


def replay_all(
    demonstrations: Iterable[Demonstration],
    allowed: Sequence[str] = (),
    *,
    out: Path | None = None,
    overwrite: bool = False,
) -> Iterator[ReplayReport]:
    """Replay in sequence, in one world as long as robot and rate stay the same.

    Args:
        demonstrations: Demonstrations to replay.
        allowed: The user's own modules that may be imported for them.
        out: Folder for recordings of the replays, under the same names and with images of the recorded cameras; one
            that the same call has already made stays. None records nothing.
        overwrite: Whether recordings there may be replaced.

    Raises:
        NotAllowedError: A demonstration's task is in a module that is not allowed.
        ConfigError: A new recording would replace its own source, or a file with that name exists already.
    """
    allow_models(allowed)
    with closing(SimulatorCache()) as simulators:
        for d in demonstrations:
            TASKS.check_name(d.info.simulated.task, allowed)  # before anything is created
            if out is not None:
                path = out / (d.name if d.source is not None else f"{d.name}.mcap")
                if d.source is not None and path.resolve() == d.source.resolve():
                    raise ConfigError(f"The replay would replace its own source: choose another --out: {path.parent}")
                make_folder(path.parent)
                behaviour = view_behaviour(d.info, recorded_view(d.info))
                info = with_simulation(replace(d.info, origin=f"replay of {d.digest[:16]}"), behaviour=behaviour)
                if overwrite or finished_outcome(path, info) is None:
                    yield record_replay(d, info, path, simulators, allowed, overwrite=overwrite)
                    continue
            blind = with_simulation(d.info, scene=replace(d.info.simulated.scene, cameras=()), config={})
            world, _ = simulators.acquire(blind)
            yield replay(d, world, allowed)[0]


def record_replay(
    demonstration: Demonstration,
    info: EpisodeInfo,
    path: Path,
    simulators: SimulatorCache,
    allowed: Sequence[str],
    *,
    overwrite: bool = False,
    labelled: Callable[[Outcome], Outcome] = lambda outcome: outcome,
) -> ReplayReport:
    """Replay into a new recording, with images of the recorded cameras.

    Args:
        demonstration: Demonstration to replay.
        info: Description of the new recording.
        path: File to create.
        simulators: Provides world and renderer.
        allowed: The user's own modules that may be imported for it.
        overwrite: Whether `path` may be replaced.
        labelled: Outcome of the replay -> the recorded one.
    """
    config = info.simulated.config
    RENDERERS.check_name(str(config.get("renderer", "raster")))
    world, renderer = simulators.acquire(info)
    painter = None if renderer is None else view_painter(renderer, recorded_view(info), config)
    video = config_as(config.get("video", {}), VideoConfig)
    with EpisodeWriter(path, info, video=video, overwrite=overwrite) as writer:
        report, outcome = replay(demonstration, world, allowed, painter=painter, sink=writer.write)
        writer.finish(labelled(outcome))
    return report
