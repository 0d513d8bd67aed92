"""Content of a report as plain data, gathered from recordings or a dataset; `page.py` lays it out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from demorec.check.base import CheckResult, Finding
from demorec.core.replacing import shown
from demorec.episode.element_names import is_numbered
from demorec.episode.episode import Outcome
from demorec.episode.roles import Roles
from demorec.extensions.doctor.diagnosis import Diagnosis
from demorec.extensions.policies.statistics import Rate
from demorec.extensions.report.filmstrip import Filmstrip

VERDICTS = ("not measured", "good", "look", "broken")
State = Literal["unreadable", "failed", "flagged", "unknown", "succeeded"]
"""State of an episode. "flagged" is a success with a check that failed or warned."""


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


MAX_COMPONENTS = 64
"""Maximum components of state and action that are drawn."""
MAX_SAMPLES = 200
"""Maximum frames per episode from which a distribution is drawn, plus its extremes."""

Components = dict[tuple[Literal["state", "action"], str], list[NDArray[np.float32]]]
"""(role, component name) -> sampled values, one array per episode."""


def motion_components(roles: Roles, columns: Mapping[str, NDArray[Any]]) -> Components:
    """Sample the state and the action of one episode: finite values, evenly spaced, and the extremes.

    Args:
        roles: Roles of its features.
        columns: Feature -> (T, D).
    """
    found: Components = {}
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
                found[role, name] = [np.array([*sampled, finite.min(), finite.max()], dtype=np.float32)]
    return found


def add_components(into: Components, found: Components) -> None:
    """Add the components of one more episode."""
    for key, parts in found.items():
        into.setdefault(key, []).extend(parts)


def judged_episode(episode: ReportedEpisode, number: int, judged: Diagnosis | None) -> ReportedEpisode:
    """Add the doctor's findings and score of an episode."""
    if judged is None:
        return episode
    flags = [*episode.flags, *(finding for finding in judged.findings if finding.episode == number)]
    scores = [each.score for each in judged.episodes if each.episode == number and each.verdict != "good"]
    return replace(episode, flags=broken_first(flags), score=min(scores, default=1.0))


def broken_first(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Sort findings by severity."""
    return tuple(sorted(findings, key=lambda finding: finding.severity != "broken"))


class CheckSummaries:
    """Results of the checks over all subjects, in the order of the first results.

    Attributes:
        worst: Name of a check -> its first result of the worst verdict, and the subject.
        counts: Name of a check -> number of its results of each verdict.
        num_silent: Number of the doctor's checks without a finding.
        not_measured: The doctor's checks without a result -> the reason.
    """

    def __init__(self) -> None:
        self.worst: dict[str, tuple[CheckResult, str]] = {}
        self.counts: dict[str, Counter[str]] = {}
        self.num_silent = 0
        self.not_measured: Mapping[str, str] = {}

    def add(self, results: Iterable[CheckResult], where: str) -> None:
        """Count the results of one recording, run or dataset."""
        for result in results:
            self._count(result, where)

    def add_judged(self, judged: Diagnosis | None) -> None:
        """Count the doctor's findings."""
        if judged is None:
            return
        self.num_silent = judged.num_checks - len({finding.check for finding in judged.findings})
        self.not_measured = judged.not_measured
        for finding in judged.findings:
            where = "the whole set" if finding.episode is None else f"episode {finding.episode}"
            self._count(CheckResult(check=finding.check, findings=(finding,)), where)

    def _count(self, result: CheckResult, where: str) -> None:
        self.counts.setdefault(result.check, Counter())[result.verdict] += 1
        known = self.worst.get(result.check)
        if known is None or VERDICTS.index(result.verdict) > VERDICTS.index(known[0].verdict):
            self.worst[result.check] = result, where

    def of(self, *verdicts: str) -> list[tuple[CheckResult, str]]:
        """The worst results with one of these verdicts, verdict by verdict, each with its subject."""
        return [item for verdict in verdicts for item in self.worst.values() if item[0].verdict == verdict]


@dataclass(frozen=True, kw_only=True, eq=False)
class Report:
    """Content of a page.

    Attributes:
        title: Name of the run, recording or dataset.
        kind: Kind of the source, in words.
        facts: (name, value) of the summary.
        episodes: Every attempt, in order.
        distributions: Distributions of actions and states.
        has_units: Whether the components have demorec's names, and thus known units.
        checks: None if no checks were run.
        missing: Sentences about data missing from the source.
    """

    title: str
    kind: str
    facts: tuple[tuple[str, str], ...]
    episodes: tuple[ReportedEpisode, ...]
    distributions: Components
    has_units: bool
    checks: CheckSummaries | None
    missing: tuple[str, ...]


def success_rate(episodes: Sequence[ReportedEpisode]) -> Rate:
    """Success rate over the attempts with a known outcome."""
    known = [episode.success for episode in episodes if episode.success is not None]
    return Rate(successes=sum(known), trials=len(known))


def common_facts(episodes: Sequence[ReportedEpisode], files: Iterable[Path]) -> Iterator[tuple[str, str]]:
    """Facts about recordings and datasets; the size is that of `files`."""
    rate = success_rate(episodes)
    if rate.trials:
        yield "success", f"{rate}"
    seconds = sum(episode.num_frames / episode.fps for episode in episodes)
    unit, factor = ("h", 3600) if seconds >= 7200 else ("min", 60) if seconds >= 120 else ("s", 1)
    rates = few(f"{episode.fps} Hz" for episode in episodes if episode.num_frames)
    yield "frames", f"{sum(episode.num_frames for episode in episodes):,} ({seconds / factor:.1f} {unit} at {rates})"
    size = sum(file.stat().st_size for file in files)
    yield "size", f"{size / 1000:.0f} kB" if size < 1_000_000 else f"{size / 1e6:.1f} MB"


def few(values: Iterable[str]) -> str:
    """The first three distinct values."""
    return shown(list(dict.fromkeys(values)), 3) or "unknown"
