"""Content of a report as plain data, gathered by `gather.py` and laid out by `page.py`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from demorec.check.base import Finding
from demorec.episode.element_names import is_numbered
from demorec.episode.episode import Outcome
from demorec.episode.roles import Roles
from demorec.extensions.doctor.diagnosis import Diagnosis
from demorec.extensions.policies.statistics import Rate
from demorec.extensions.report.filmstrip import Filmstrip

State = Literal["unreadable", "failed", "flagged", "unknown", "succeeded"]
"""State of an episode. "flagged" is a success with a finding of a check."""
MAX_COMPONENTS = 64
"""Maximum components of state and action that are drawn."""
MAX_SAMPLES = 200
"""Maximum frames per episode from which a distribution is drawn, plus its extremes."""

Components = dict[tuple[Literal["state", "action"], str], list[NDArray[np.float32]]]
"""(role, component name) -> sampled values, one array per episode."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ReportedEpisode:
    """One attempt at one episode. Facts missing from the source are None or empty.

    Attributes:
        name: "episode 3", or "episode 3, attempt 0" for a failed one.
        source: Its file, relative to the path of the report.
        problem: Reason why it cannot be read, or why nothing was recorded.
        instruction: Text of the instruction.
        outcome: None if unknown.
        num_frames, fps: Length and frame rate.
        seed: Root seed of the run.
        phases: (name, first frame, frame after the last) of each phase, in order.
        flags: Findings of checks, broken ones first.
        score: Score by the doctor; 1 for a good or unjudged episode.
        filmstrip: None without images, and for some successes in a long report.
        facts: (name, value) for the summary of all episodes: robot, cameras, ...
    """

    name: str
    source: str = ""
    problem: str = ""
    instruction: str = ""
    outcome: Outcome | None = None
    num_frames: int = 0
    fps: int = 1
    seed: int | None = None
    phases: tuple[tuple[str, int, int], ...] = ()
    flags: tuple[Finding, ...] = ()
    score: float = 1.0
    filmstrip: Filmstrip | None = None
    facts: tuple[tuple[str, str], ...] = ()

    @property
    def success(self) -> bool | None:
        """None if unknown."""
        return None if self.outcome is None else self.outcome.success

    @property
    def state(self) -> State:
        """State in one word."""
        if self.success is False:
            return "failed"
        if self.problem:
            return "unreadable"
        if self.flags:
            return "flagged"
        return "unknown" if self.success is None else "succeeded"

    @property
    def failure(self) -> str:
        """Reason and phase of a failure; "" otherwise."""
        if self.outcome is None or self.outcome.success is not False:
            return ""
        reason, phase = self.outcome.failure_reason or "no reason recorded", self.outcome.failure_phase
        return f"{reason} in phase {phase}" if phase else reason


@dataclass(frozen=True, kw_only=True, eq=False)
class Report:
    """Content of a page.

    Attributes:
        title: Name of the run, recording or dataset.
        kind: Kind of the source, in words.
        facts: (name, value) of the summary.
        episodes: Every attempt, in order.
        distributions: Distributions of actions and states.
        diagnosis: Results of the checks; None if none were run.
        missing: Sentences about data missing from the source.
    """

    title: str
    kind: str
    facts: tuple[tuple[str, str], ...]
    episodes: tuple[ReportedEpisode, ...]
    distributions: Components
    diagnosis: Diagnosis | None
    missing: tuple[str, ...]


def add_motion(into: Components, roles: Roles, columns: Mapping[str, NDArray[Any]]) -> None:
    """Add samples of the state and the action of an episode: finite values, evenly spaced, and the extremes.

    Args:
        into: The components of all episodes.
        roles: Roles of its features.
        columns: Feature -> (T, D).
    """
    drawn: dict[Literal["state", "action"], tuple[str, ...]] = {"state": roles.state, "action": roles.action}
    for role, parts in drawn.items():
        names = roles.elements(parts)[:MAX_COMPONENTS]
        if is_numbered(names):
            names = tuple(f"component {name}" for name in names)
        values = np.hstack([columns[part] for part in parts]) if parts else np.zeros((0, 0))
        for name, column in zip(names, values.T, strict=False):
            finite = column[np.isfinite(column)]
            if len(finite):
                sampled = finite[:: -(-len(finite) // MAX_SAMPLES)]
                samples = np.array([*sampled, finite.min(), finite.max()], dtype=np.float32)
                into.setdefault((role, name), []).append(samples)


def success_rate(episodes: Sequence[ReportedEpisode]) -> Rate:
    """Success rate over the attempts with a known outcome."""
    known = [episode.success for episode in episodes if episode.success is not None]
    return Rate(successes=sum(known), trials=len(known))
