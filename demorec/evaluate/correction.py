"""The expert takes over from a policy and finishes the episode: corrections without a person.

Where a policy goes wrong it is in states that no demonstration has. What the expert does from there is what the policy
lacks (DAgger, Ross et al. 2011, https://arxiv.org/abs/1011.0686). Frames in which the policy acted have the phase
"policy", all others are the expert's.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from demorec.evaluate.moments import TakeOver
from demorec.geometry import Array
from demorec.gym_env import SUCCESS_FRAMES, DemorecEnv, Situation
from demorec.loop import Episode
from demorec.loop.agents import Decision
from demorec.recording import Recording
from demorec.scene.episode import POLICY_PHASE
from demorec.tasks.script import Behaviour, Step
from demorec.tasks.skills import Expert, GaveUp

TAKE_OVER_EVENT, _MESSAGE = "take_over", "the expert takes over: "
_STILL_METRES, _STILL_WIDTH = 0.005, 0.002
"""A hand is stuck while its TCP stays within so much along each axis, and its opening within so much."""


class Watch:
    """Watches a policy in one episode; a function of the episode and of what the policy does.

    Args:
        rules: When the expert takes over.
        episode: Whose random stream says at which moment, if at a random one.
        max_frames: Time limit of the policy.
    """

    def __init__(self, rules: TakeOver, episode: Episode, *, max_frames: int) -> None:
        fps = episode.info.fps
        self._limit = min(max_frames, round(rules.after_seconds * fps) or max_frames)
        random = episode.rng("takeover")
        is_random, moment = random.random() < rules.random_share, int(random.integers(1, self._limit + 1))
        self._moment = moment if is_random else self._limit
        self._past: deque[Array] = deque(maxlen=max(2, round(rules.stuck_seconds * fps)))
        self._minds_stillness = rules.stuck_seconds > 0

    def reason(self, situation: Situation) -> str:
        """Why the expert takes over now; "" while the policy goes on. To be asked once a frame."""
        observation = situation.observation
        self._past.append(np.array([*observation.base_from_tcp.position, observation.gripper_width]))
        if situation.frame_index >= self._limit:
            return "the policy has had its time"
        if situation.frame_index >= self._moment:
            return "a random moment"
        if self._minds_stillness and len(self._past) == self._past.maxlen:
            spread = np.ptp(np.array(self._past), axis=0)
            if (spread[:3] < _STILL_METRES).all() and spread[3] < _STILL_WIDTH:
                return "the policy is stuck"
        return ""


def correcting_behaviour(episode: Episode) -> Behaviour:
    """How the expert does it in an episode that it takes over: without noise and without a miss on purpose."""
    return replace(episode.behaviour, miss_x=0.0, miss_y=0.0, action_noise=0.0)


@dataclass
class Correction:
    """The expert at work in an environment that a policy has left.

    Args:
        env: As the policy left it.
        reason: Why the expert takes over.

    Attributes:
        gave_up: (phase, reason), once the expert has given up; else ("", "").
        num_retries: How often it tried something again.
    """

    env: DemorecEnv
    reason: str
    gave_up: tuple[str, str] = ("", "")
    num_retries: int = 0

    def decisions(self) -> Iterator[Decision]:
        """One a control step, the labels without noise, until the task is done or given up; then a few that hold."""
        expert = Expert(self.env.world, correcting_behaviour(self.env.episode))
        expert.note(TAKE_OVER_EVENT, f"{_MESSAGE}{self.reason}")
        for step in self._steps(expert):
            self.num_retries = expert.num_retries
            yield Decision(action=step.action, command=step.action, phase=step.phase, events=step.events)

    def _steps(self, expert: Expert) -> Iterator[Step]:
        try:
            yield from self.env.episode.task.resume(expert)
        except GaveUp as error:
            self.gave_up = error.phase, error.reason
            yield expert.step()  # which carries the events that say why
            return
        for _ in range(SUCCESS_FRAMES):
            yield expert.step()


@dataclass(frozen=True, kw_only=True)
class TakenOver:
    """What a recording tells of a correction.

    Attributes:
        reason: Why the expert took over.
        num_frames: How many the expert acted in.
    """

    reason: str
    num_frames: int


def read_takeover(path: Path) -> TakenOver | None:
    """Of the recording of a rollout; None where the policy acted to the end.

    Raises:
        RecordingError: It cannot be read.
    """
    with Recording(path) as recording:
        messages = [event.message for _, event in recording.events() if event.name == TAKE_OVER_EVENT]
        if not messages:
            return None
        acted = sum(phase != POLICY_PHASE for phase in recording.columns().phase)
    return TakenOver(reason=messages[0].removeprefix(_MESSAGE), num_frames=acted)
