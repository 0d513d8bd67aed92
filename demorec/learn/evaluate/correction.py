"""The expert takes over from a policy and finishes the episode: corrections without a person.

Where a policy goes wrong it is in states that no demonstration has. What the expert does from there is what the policy
lacks (DAgger, Ross et al. 2011, https://arxiv.org/abs/1011.0686). Frames in which the policy acted have the phase
"policy", all others are the expert's.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from demorec.episode.episode import POLICY_PHASE, interventions
from demorec.loop import Episode
from demorec.mcap import SimulatedRecording
from demorec.sim.world import World
from demorec.tasks.script import Behaviour
from demorec.tasks.skills import Expert

TAKE_OVER_EVENT, _MESSAGE = "take_over", "the expert takes over: "


def begin_correction(world: World, behaviour: Behaviour, reason: str) -> Expert:
    """The expert who takes over, and says why with its first step."""
    expert = Expert(world, behaviour)
    expert.note(TAKE_OVER_EVENT, f"{_MESSAGE}{reason}")
    return expert


def correcting_behaviour(episode: Episode, *, noise: bool) -> Behaviour:
    """How the expert does it in an episode that it takes over: without a miss on purpose, with `noise` or without."""
    behaviour = replace(episode.behaviour, miss_x=0.0, miss_y=0.0)
    return behaviour if noise else replace(behaviour, action_noise=0.0)


@dataclass(frozen=True, kw_only=True)
class TakenOver:
    """What a recording tells of its corrections.

    Attributes:
        reasons: Why the expert took over, each time.
        num_frames: How many the expert acted in.
        has_interventions: Whether it did more than stop the arm (`interventions`).
    """

    reasons: tuple[str, ...]
    num_frames: int
    has_interventions: bool


def read_takeover(path: Path) -> TakenOver | None:
    """Of the recording of a rollout; None where the policy acted to the end.

    Raises:
        RecordingError: It cannot be read.
    """
    with SimulatedRecording(path) as recording:
        messages = [event.message for _, event in recording.events() if event.name == TAKE_OVER_EVENT]
        if not messages:
            return None
        phases = recording.columns().phase
    return TakenOver(
        reasons=tuple(message.removeprefix(_MESSAGE) for message in messages),
        num_frames=sum(phase != POLICY_PHASE for phase in phases),
        has_interventions=bool(interventions(phases).any()),
    )
