"""Send the commands of recordings to the simulator again, and compare every state with the recorded one."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import zip_longest

import numpy as np

from demorec.core.errors import RecordingError
from demorec.core.geometry import Array
from demorec.core.tables import TASKS
from demorec.episode.episode import Frame, Observation, Outcome, SuccessCheck, gave_up
from demorec.episode.simulated import with_simulation
from demorec.loop import Session, SimulatorCache, Step
from demorec.mcap import Recording
from demorec.mcap.frames import frames_of
from demorec.render.painter import Painter
from demorec.robots.assets import allow_models
from demorec.sim.world import World

_JOINTS, _OPENING, _POSE_OF = "joint positions", "gripper opening", "the pose of "


@dataclass(frozen=True, kw_only=True)
class ReplayReport:
    """Comparison of a replay with the recording.

    Attributes:
        name: Name of the recording's file.
        num_steps: Number of commands sent.
        first_difference: First step with a different state, and the quantity; None if all states, the final state's
        digest and the conditions of the outcome are bit-exact.
        joint_error: Largest difference of an arm joint, rad.
        gripper_error: Largest difference of the opening, m.
        object_error: Largest distance of an object from its recorded place, m; None without objects.
        recorded_success, success: Success of the recording and of the replay; None if unknown or not judged.
        is_outcome_as_recorded: Both are equal, or one is unknown. A failure with a recorded reason (the expert gave up)
        remains one even if the conditions hold.
        failed_checks: Conditions that do not hold in the replay.
    """

    name: str
    num_steps: int
    first_difference: tuple[int, str] | None
    joint_error: float
    gripper_error: float
    object_error: float | None
    recorded_success: bool | None
    success: bool | None
    is_outcome_as_recorded: bool
    failed_checks: tuple[str, ...] = ()

    @property
    def is_identical(self) -> bool:
        """Whether everything compared is bit-exact."""
        return self.first_difference is None


def replay_all(recordings: Iterable[Recording], allowed: Sequence[str] = ()) -> Iterator[ReplayReport]:
    """Replay in sequence, in one world as long as robot and rate stay the same.

    Args:
        recordings: Recordings to replay.
        allowed: The user's own modules that may be imported for them.

    Raises:
        NotAllowedError: A recording's task is in a module that is not allowed.
        RecordingError: A recording is damaged or empty.
    """
    allow_models(allowed)
    with closing(SimulatorCache()) as simulators:
        for recording in recordings:
            info = recording.info
            TASKS.check_name(info.simulated.task, allowed)  # before anything is created
            blind = with_simulation(info, scene=replace(info.simulated.scene, cameras=()), config={})
            world, _ = simulators.acquire(blind)
            yield replay(recording, world, allowed)[0]


def replay(
    recording: Recording,
    world: World,
    allowed: Sequence[str] = (),
    *,
    painter: Painter | None = None,
    sink: Callable[[Frame], None] | None = None,
) -> tuple[ReplayReport, Outcome]:
    """Send the commands of a recording and compare.

    Args:
        recording: Recording to replay.
        world: World of its robot and rate; it is reset.
        allowed: The user's own modules that may be imported for its task.
        painter: Draws the frames' images; None for none.
        sink: Called with every frame of the replay before its command is sent.

    Returns:
        The report, and the outcome of the replay.

    Raises:
        RecordingError: The recording is damaged or empty.
    """
    trajectory, simulated = recording.trajectory(), recording.info.simulated
    if trajectory.num_frames == 0:
        raise RecordingError(f"The recording has no frames: {recording.path}")
    recorded = tuple(frames_of(trajectory, recording.events(), recording.joint_samples()))
    session = Session(world, simulated.scene, TASKS.load(simulated.task, allowed)(), painter=painter)
    seen: list[Observation] = []
    for frame in session.run(_RecordedAgent(recorded)):
        seen.append(frame.observation)
        if sink is not None:
            sink(frame)
    return _report(recording, [frame.observation for frame in recorded], seen, session.outcome), session.outcome


class _RecordedAgent:
    """Agent that sends the recorded commands; label, phase and events are those of the recorded frames."""

    num_retries = 0

    def __init__(self, recorded: Sequence[Frame]) -> None:
        self._recorded = recorded

    def decide(self, world: World) -> Iterator[Step]:
        """See `demorec.loop.Agent`."""
        for frame in self._recorded:
            yield Step(
                action=frame.action,
                command=frame.command,
                phase=frame.phase,
                events=frame.events,
                is_deliberate_miss=frame.is_deliberate_miss,
            )

    def failure(self, failed: Sequence[str]) -> tuple[str, str]:
        """See `demorec.loop.Agent`."""
        return ("replay", failed[0]) if failed else ("", "")


def _sensed(observation: Observation) -> dict[str, Array]:
    """All sensed quantities: name -> (D,)."""
    return {
        _JOINTS: observation.joint_position,
        _OPENING: np.array([observation.gripper_width]),
        "joint velocities": observation.joint_velocity,
        "joint efforts": observation.joint_effort,
        "the contact force": np.array([observation.contact_force]),
        "the EE pose": observation.base_from_tcp.vector(),
        **{f"the {name}": values for name, values in observation.sensed.items()},
        **{f"{_POSE_OF}{name}": pose.vector() for name, pose in observation.object_poses.items()},
    }


def _differences(recorded: Sequence[Observation], seen: Sequence[Observation]) -> dict[str, Array]:
    """Quantity -> (T, D), replayed minus recorded values; without sensors that this version does not simulate."""
    before, now = list(map(_sensed, recorded)), list(map(_sensed, seen))
    names = [name for name in before[0] if name in now[0]]
    return {name: np.array([v[name] for v in now]) - np.array([v[name] for v in before]) for name in names}


def _report(
    recording: Recording, recorded: Sequence[Observation], seen: Sequence[Observation], outcome: Outcome
) -> ReplayReport:
    info, before = recording.info, recording.outcome
    off = _differences(recorded, seen)
    differs = np.array([~(values == 0).all(axis=1) for values in off.values()])  # as NaN does
    first = None
    if differs.any():
        step = int(differs.any(axis=0).argmax())
        first = step, list(off)[int(differs[:, step].argmax())]
    elif before is not None and before.final_state_digest:
        if before.final_state_digest != outcome.final_state_digest:
            first = len(seen), "the final state"
        elif before.checks != outcome.checks:
            first = len(seen), _other_condition(outcome.checks, before.checks)
    distances = [np.linalg.norm(way[:, :3], axis=1).max() for name, way in off.items() if name.startswith(_POSE_OF)]
    failed = tuple(check.name for check in outcome.checks if not check.passed)
    success = not failed if outcome.checks else None
    recorded_success = None if before is None else before.success
    has_reason = before is not None and gave_up(before, [event for _, event in recording.events()], info)
    return ReplayReport(
        name=recording.path.name,
        num_steps=len(seen),
        first_difference=first,
        joint_error=float(np.abs(off[_JOINTS][:, : len(info.simulated.robot.arm_joints)]).max()),
        gripper_error=float(np.abs(off[_OPENING]).max()),
        object_error=float(max(distances)) if distances else None,
        recorded_success=recorded_success,
        success=success,
        is_outcome_as_recorded=None in (success, recorded_success)
        or success == recorded_success
        or (has_reason and not recorded_success),
        failed_checks=failed,
    )


def _other_condition(now: Sequence[SuccessCheck], recorded: Sequence[SuccessCheck]) -> str:
    """The first condition that differs from the recorded one."""
    pairs = zip_longest(now, recorded)
    return next(f"the condition {(one or other).name}" for one, other in pairs if one != other)
