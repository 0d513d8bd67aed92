"""Do phases, events and retries tell the same story as the motion.

The skills of demorec's own tasks (docs/tasks.md) have phases with a meaning: in some the hand is told to be open, in
others closed, some go up and some go down, and one follows another. A script of somebody else's may call its phases
what it likes, so nothing is said about those.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from demorec.check.base import Found, Measurement, NotMeasured, alignment_check, outcome_check
from demorec.check.episode import CheckedEpisode
from demorec.core.tables import TASKS
from demorec.episode.episode import CORRECTED_PHASE, INTERJECTION_EVENT, MISTAKEN_PHASE, POLICY_PHASE

OPEN_PHASES = {
    MISTAKEN_PHASE,
    CORRECTED_PHASE,
    "approach",
    "descend",
    "release",
    "retreat",
    "verify",
    "recover",
    "open",
    "above_cube",
}
CLOSED_PHASES = {"close", "lift", "transport", "lower", "hold", "carry"}
UPWARD, DOWNWARD, STANDING = {"lift", "retreat", "hold"}, {"descend", "lower"}, {"close", "release"}
NEXT = {
    "": {"approach", "perceive", "open", MISTAKEN_PHASE},
    MISTAKEN_PHASE: {CORRECTED_PHASE},
    CORRECTED_PHASE: {"approach", "open"},
    "perceive": set(),
    "approach": {"descend"},
    "descend": {"close"},
    "close": {"lift", "recover", "hold"},
    "lift": {"transport", "recover"},
    "transport": {"lower", "recover"},
    "lower": {"release", "recover"},
    "release": {"retreat"},
    "retreat": {"approach", "perceive", "verify"},
    "recover": {"approach", "perceive"},
    "verify": {"approach", "perceive"},
    "open": {"above_cube"},
    "above_cube": {"descend"},
    "hold": {"carry"},
    "carry": {"release"},
}
"""Phase -> those that may follow; "" is the beginning. The last four rows are the tutorial's."""


@dataclass(frozen=True, kw_only=True)
class PhaseStretch:
    """Frames first to last (included) of one phase."""

    phase: str
    first: int
    last: int


def _stretches(phases: tuple[str, ...]) -> list[PhaseStretch]:
    starts = [frame for frame, phase in enumerate(phases) if frame == 0 or phase != phases[frame - 1]]
    ends = pairwise([*starts, len(phases)])
    return [PhaseStretch(phase=phases[first], first=first, last=end - 1) for first, end in ends]


def _is_scripted(episode: CheckedEpisode) -> NotMeasured | None:
    """None where the phases are those of demorec's own skills."""
    if episode.info.task not in TASKS.rows:
        return NotMeasured(why=f"phases of the task {episode.info.task!r} may mean anything")
    if POLICY_PHASE in episode.columns.phase:
        return NotMeasured(why="a policy acted, for whom there is no script")
    if not any(episode.columns.phase):
        return NotMeasured(why="the episode has no phases: no script made it")
    return None


@alignment_check(
    measures="frames whose phase says another thing than the gripper's command or the wanted motion",
    reads=("/phase", "/action", "/action/ee_pose"),
)
def phases_match_motion(episode: CheckedEpisode) -> Found:
    """The hand is told to be open or closed as the phase has it, from its first frame to its last; and up is up."""
    if (unknown := _is_scripted(episode)) is not None:
        return unknown
    c, robot = episode.columns, episode.info.robot
    closed = c.action_gripper < 0.5 * robot.gripper.max_width
    against_gripper = (CLOSED_PHASES, OPEN_PHASES)
    wrong = np.array([phase in against_gripper[shut] for phase, shut in zip(c.phase, closed.tolist(), strict=True)])
    for stretch in _stretches(c.phase):
        rise = float(c.action_base_from_tcp[stretch.last, 2] - c.action_base_from_tcp[stretch.first, 2])
        inner = slice(stretch.first + 1, stretch.last + 1)
        moved = np.abs(np.diff(c.action_joint_target[stretch.first : stretch.last + 1], axis=0)).max(initial=0.0)
        if stretch.last - stretch.first < 2:
            continue
        against = (stretch.phase in UPWARD and rise < 0) or (stretch.phase in DOWNWARD and rise > 0)
        if against or (stretch.phase in STANDING and moved > 1e-6):
            wrong[inner] = True
    frame = int(np.argmax(wrong)) if wrong.any() else None
    return Measurement(value=int(wrong.sum()), frame=frame, detail="" if frame is None else f"phase {c.phase[frame]!r}")


@outcome_check(
    measures="phases out of order, and retries and events that do not fit them",
    reads=(
        "/phase",
        "/events",
        "outcome.num_retries",
        "info.scene.goals.object",
    ),
)
def story(episode: CheckedEpisode) -> Found:
    """Phases follow each other as the skills have them; each approach has its grasp, each retry its new approach."""
    if (unknown := _is_scripted(episode)) is not None:
        return unknown
    stretches = _stretches(episode.columns.phase)
    order = pairwise(["", *(stretch.phase for stretch in stretches)])
    strange = [
        (stretch.first, f"{after!r} after {before!r}")
        for stretch, (before, after) in zip(stretches, order, strict=True)
        if after not in NEXT.get(before, set())
    ]
    wrong = [text for _, text in strange]
    approaches = [stretch.first for stretch in stretches if stretch.phase in ("approach", "above_cube")]
    grasps = [time_ns for time_ns, event in episode.events if event.name == "grasp"]
    if len(grasps) != len(approaches):
        wrong.append(f"{len(grasps)} grasps announced, {len(approaches)} approached")
    else:
        off = [a for a, time in zip(approaches, grasps, strict=True) if int(episode.frame_times[a]) != time]
        wrong += [f"the grasp of frame {a} is announced at another" for a in off]
    corrected = [stretch.first for stretch in stretches if stretch.phase == CORRECTED_PHASE]
    told = [time_ns for time_ns, event in episode.recording.events() if event.name == INTERJECTION_EVENT]
    if [int(episode.frame_times[frame]) for frame in corrected] != told:
        wrong.append(f"{len(told)} interjections at other frames than those where the expert listens ({corrected})")
    outcome, goals = episode.outcome, episode.info.scene.goals
    if outcome is not None and outcome.success and len(approaches) != len(goals) + outcome.num_retries:
        wrong.append(f"{len(approaches)} approaches for {len(goals)} goals and {outcome.num_retries} retries")
    frame = strange[0][0] if strange else None
    return Measurement(value=len(wrong), frame=frame, detail="; ".join(wrong[:3]) or f"{len(stretches)} phases")


@outcome_check(
    measures="deliberate misses that are none, or are not said to be one",
    reads=(
        "/deliberate_miss",
        "/events",
        "info.behaviour",
    ),
)
def deliberate_misses(episode: CheckedEpisode) -> Found:
    """Frames of a deliberate miss go from an approach to the event that tells it, where the behaviour has one."""
    if (unknown := _is_scripted(episode)) is not None:
        return unknown
    flags, behaviour = episode.columns.is_deliberate_miss, episode.info.behaviour
    told = [
        int(np.searchsorted(episode.frame_times, time_ns))
        for time_ns, event in episode.events
        if event.name == "miss" and event.message.endswith("on purpose")
    ]
    starts = np.flatnonzero(np.diff(np.concatenate([[False], flags])) & flags).tolist()
    wrong = []
    if flags.any() and not (behaviour.get("miss_x", 0.0) or behaviour.get("miss_y", 0.0)):
        wrong.append("the behaviour has none")
    ends = (np.flatnonzero(np.diff(np.concatenate([flags, [False]])) & flags) + 1).tolist()
    if len(starts) > 1 or ends != told:
        wrong.append(f"flagged up to {ends}, told at {told}")
    if any(episode.columns.phase[start] != "approach" or (start and flags[start - 1]) for start in starts):
        wrong.append("flagged from the midst of a phase on")
    frame = starts[0] if starts else None
    return Measurement(value=len(wrong), frame=frame, detail="; ".join(wrong) or f"{int(flags.sum())} frames")
