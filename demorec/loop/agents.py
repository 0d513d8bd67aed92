"""What an agent is to a session, and the agent that follows a task's script."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

from demorec.episode.episode import Action, Event
from demorec.loop.noise import ActionNoise
from demorec.loop.prepare import Episode
from demorec.sim.world import World
from demorec.tasks.interjection import mistake
from demorec.tasks.script import Step
from demorec.tasks.skills import Expert, GaveUp


@dataclass(frozen=True, kw_only=True)
class Decision:
    """What an agent wants done in one control step; recorded in the `Frame` of that step.

    Attributes:
        action: The label, what a policy shall learn to say.
        command: What is sent to the motors.
        phase, events, is_deliberate_miss: As of `Frame`.
    """

    action: Action
    command: Action
    phase: str = ""
    events: tuple[Event, ...] = ()
    is_deliberate_miss: bool = False


class Agent(Protocol):
    """Acts in a run of a session."""

    @property
    def num_retries(self) -> int:
        """How often something had to be tried again."""

    def decide(self, world: World) -> Iterator[Decision]:
        """One decision a control step, from a reset world on; the world has advanced when the iterator resumes."""

    def failure(self, failed: Sequence[str]) -> tuple[str, str]:
        """Phase and reason of a failure, ("", "") for a success.

        Args:
            failed: Names of the task's conditions that do not hold in the end.
        """


class ScriptAgent:
    """The expert, who follows the task's script; exploration noise is on the commands, never on the labels."""

    def __init__(self, episode: Episode) -> None:
        self._episode = episode
        self._expert: Expert | None = None
        self._gave_up: GaveUp | None = None

    @property
    def num_retries(self) -> int:
        """See `Agent`."""
        return 0 if self._expert is None else self._expert.num_retries

    def decide(self, world: World) -> Iterator[Decision]:
        """See `Agent`."""
        behaviour = self._episode.behaviour
        self._expert, self._gave_up = Expert(world, behaviour), None
        noise = ActionNoise(world, sigma=behaviour.action_noise, rng=self._episode.rng("noise"), fps=world.fps)
        for step in self._steps(self._expert):
            yield Decision(
                action=step.action,
                command=noise.command(step),
                phase=step.phase,
                events=step.events,
                is_deliberate_miss=step.is_deliberate_miss,
            )

    def _steps(self, expert: Expert) -> Iterator[Step]:
        """The script; when the expert gives up, one step more, which carries the events that say why."""
        try:
            if self._episode.interjection is not None:
                yield from mistake(expert, self._episode.interjection)
            yield from self._episode.task.script(expert)
        except GaveUp as error:
            self._gave_up = error
            yield expert.step()

    def failure(self, failed: Sequence[str]) -> tuple[str, str]:
        """See `Agent`."""
        if self._gave_up is not None:
            return self._gave_up.phase, self._gave_up.reason
        if not failed or self._expert is None:
            return "", ""
        return self._expert.trouble[0] or self._expert.phase, failed[0]
