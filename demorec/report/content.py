"""What a report shows, as plain data: gathered from recordings or from a dataset, laid out by `demorec.report.page`."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from demorec.check.base import Level, Result
from demorec.evaluate.statistics import Rate
from demorec.report.filmstrip import Filmstrip
from demorec.report.histogram import Histogram
from demorec.scene.episode import EpisodeInfo, SuccessCheck

State = Literal["unreadable", "failed", "flagged", "unknown", "succeeded"]
"""Of an episode. "flagged" is a success for which a check failed or warned."""


@dataclass(frozen=True, kw_only=True)
class PhaseSpan:
    """A phase and its frames, from `first` up to but not including `end`."""

    name: str
    first: int
    end: int


@dataclass(frozen=True, kw_only=True, eq=False)
class ReportedEpisode:
    """One attempt at one episode. What the source does not state is None or empty.

    Attributes:
        name: "episode 3", or "episode 3, attempt 0" for one that failed.
        source: Its file, relative to the path of the report.
        problem: Why it cannot be read, or why nothing was recorded.
        instruction: As text.
        success: None when unknown.
        failure_phase, failure_reason: Of a failed attempt.
        num_frames, fps: Length and frame rate.
        num_retries: How often the expert tried again.
        seed: Root seed of the run.
        phases: In order.
        conditions: The task's conditions of success.
        flags: Results of checks that failed or warned, failures first.
        filmstrip: None without images, and for some successes in a long report.
        info: Everything known before the first frame.
    """

    name: str
    source: str = ""
    problem: str = ""
    instruction: str = ""
    success: bool | None = None
    failure_phase: str = ""
    failure_reason: str = ""
    num_frames: int = 0
    fps: int = 1
    num_retries: int = 0
    seed: int | None = None
    phases: tuple[PhaseSpan, ...] = ()
    conditions: tuple[SuccessCheck, ...] = ()
    flags: tuple[Result, ...] = ()
    filmstrip: Filmstrip | None = None
    info: EpisodeInfo | None = None

    @property
    def state(self) -> State:
        """Its status in one word."""
        if self.success is False:
            return "failed"
        if self.problem:
            return "unreadable"
        if self.flags:
            return "flagged"
        return "unknown" if self.success is None else "succeeded"

    @property
    def failure(self) -> str:
        """Why it failed and in which phase."""
        reason = self.failure_reason or "no reason recorded"
        return f"{reason} in phase {self.failure_phase}" if self.failure_phase else reason


Components = dict[tuple[str, str], Histogram]
"""(feature, name of the component) -> its values over all frames."""


def count(into: Components, feature: str, names: Iterable[str], values: NDArray[Any]) -> None:
    """Count the values of a feature (T, D) by component, as far as there are names."""
    for name, column in zip(names, values.T, strict=False):
        into.setdefault((feature, name), Histogram()).add(column)


def merge(into: Components, found: Components) -> None:
    """Add the counts of one episode to those of all."""
    for key, histogram in found.items():
        into.setdefault(key, Histogram()).merge(histogram)


@dataclass(kw_only=True)
class CheckSummary:
    """One check over everything that it looked at.

    Attributes:
        counts: Number of results of each level.
        worst: The result shown: of the highest level, and of those the one with the largest value.
        where: What that was found in.
    """

    worst: Result
    where: str
    counts: dict[Level, int] = field(default_factory=dict)


class CheckSummaries:
    """Name of a check -> its summary, in the order of the first results."""

    def __init__(self) -> None:
        self.by_name: dict[str, CheckSummary] = {}
        self.num_subjects = 0

    def add(self, results: Iterable[Result], where: str) -> None:
        """Count the results for one recording, run or dataset."""
        self.num_subjects += 1
        for result in results:
            summary = self.by_name.setdefault(result.check, CheckSummary(worst=result, where=where))
            summary.counts[result.level] = summary.counts.get(result.level, 0) + 1
            if _rank(result) > _rank(summary.worst):
                summary.worst, summary.where = result, where


def _rank(result: Result) -> tuple[int, float]:
    unknown = float("inf") if result.level == "fail" else float("-inf")
    return ("skip", "pass", "warn", "fail").index(result.level), unknown if result.value is None else result.value


@dataclass(frozen=True, kw_only=True, eq=False)
class Report:
    """Everything that a page shows.

    Attributes:
        title: Name of the run, recording or dataset.
        kind: What it is, in words.
        facts: (name, value) of the summary.
        episodes: Every attempt, in order.
        distributions: Of actions and states.
        has_units: Whether their components have demorec's names, and so known units.
        checks: None when no checks were run.
        missing: Sentences about what the source does not contain.
        configs: Resolved configurations.
    """

    title: str
    kind: str
    facts: tuple[tuple[str, str], ...]
    episodes: tuple[ReportedEpisode, ...]
    distributions: Components
    has_units: bool
    checks: CheckSummaries | None
    missing: tuple[str, ...]
    configs: tuple[Mapping[str, Any], ...]

    @property
    def rate(self) -> Rate:
        """Of success, over the attempts whose outcome is known."""
        return success_rate(self.episodes)

    @property
    def lengths(self) -> Histogram:
        """Of the episodes, seconds."""
        lengths = Histogram()
        lengths.add(np.array([episode.num_frames / episode.fps for episode in self.episodes if episode.num_frames]))
        return lengths


def success_rate(episodes: Sequence[ReportedEpisode]) -> Rate:
    """Over the attempts whose outcome is known."""
    known = [episode.success for episode in episodes if episode.success is not None]
    return Rate(successes=sum(known), trials=len(known))


def common_facts(episodes: Sequence[ReportedEpisode]) -> Iterator[tuple[str, str]]:
    """Facts that recordings and datasets share."""
    rate = success_rate(episodes)
    if rate.trials:
        yield "success", f"{rate}"
    seconds = sum(episode.num_frames / episode.fps for episode in episodes)
    rates = few(f"{episode.fps} Hz" for episode in episodes if episode.num_frames)
    yield "frames", f"{sum(episode.num_frames for episode in episodes):,} ({_duration(seconds)} at {rates})"


def _duration(seconds: float) -> str:
    for unit, factor in (("h", 3600.0), ("min", 60.0)):
        if seconds >= 2 * factor:
            return f"{seconds / factor:.1f} {unit}"
    return f"{seconds:.1f} s"


def size_text(num_bytes: int) -> str:
    """In kB or MB."""
    return f"{num_bytes / 1000:.0f} kB" if num_bytes < 1_000_000 else f"{num_bytes / 1e6:.1f} MB"


def few(values: Iterable[str]) -> str:
    """The first three distinct values."""
    distinct = list(dict.fromkeys(values))
    return (", ".join(distinct[:3]) + (", ..." if len(distinct) > 3 else "")) or "unknown"
