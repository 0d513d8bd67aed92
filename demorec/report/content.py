"""What a report tells, as plain data: gathered from recordings or from a dataset, laid out by `demorec.report.page`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from demorec.check.base import Level, Result
from demorec.check.report import SubjectReport
from demorec.report.histogram import Histogram
from demorec.scene.episode import EpisodeInfo, SuccessCheck

State = Literal["unreadable", "failed", "flagged", "unknown", "succeeded"]
"""Of an episode, the worst first. "flagged" is a success of which a check failed or warned."""

STATES: tuple[State, ...] = ("unreadable", "failed", "flagged", "unknown", "succeeded")


@dataclass(frozen=True, kw_only=True)
class Filmstrip:
    """Pictures of one camera beside each other, evenly spaced from the first frame to the last.

    Attributes:
        jpeg: All of them as one JPEG file.
        camera: Name.
        moments: How many pictures.
        width, height: Of the whole, pixels.
    """

    jpeg: bytes
    camera: str
    moments: int
    width: int
    height: int


@dataclass(frozen=True, kw_only=True)
class PhaseSpan:
    """A phase and its frames, from `first` to before `end`."""

    name: str
    first: int
    end: int


@dataclass(frozen=True, kw_only=True, eq=False)
class ReportedEpisode:
    """One attempt at one episode. What the source does not tell is None or empty.

    Attributes:
        name: "episode 3", or "episode 3, attempt 0" of a failed one.
        source: The file that it lies in, relative to what is reported on.
        problem: Why it cannot be read, or why nothing was recorded; "" otherwise.
        instruction: In words.
        success: None when nobody knows.
        failure_phase, failure_reason: Of an attempt that failed.
        num_frames: Length.
        fps: Frames per second.
        num_retries: How often the expert tried again.
        seed: Root seed of the run.
        phases: In order.
        conditions: The task's conditions of success.
        flags: Results of checks that failed or warned.
        filmstrip: None without pictures, and in a long report of some successes.
        info: All that was known before the first frame.
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
        """How it stands, in a word."""
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


@dataclass(kw_only=True)
class CheckSummary:
    """One check over everything that it looked at; filled by `CheckSummaries`.

    Attributes:
        counts: How many results have a level.
        worst: The result that stands for it: of the highest level, and of the largest value in it.
        where: What that was found in.
    """

    worst: Result
    where: str
    counts: dict[Level, int] = field(default_factory=dict)


_SEVERITY: Mapping[Level, int] = {"skip": 0, "pass": 1, "warn": 2, "fail": 3}


class CheckSummaries:
    """Name of a check -> its summary, in the order of the first results."""

    def __init__(self) -> None:
        self.by_name: dict[str, CheckSummary] = {}
        self.num_subjects = 0

    def add(self, results: Iterable[Result], where: str) -> None:
        """Count the results about one recording, run or dataset."""
        self.num_subjects += 1
        for result in results:
            summary = self.by_name.setdefault(result.check, CheckSummary(worst=result, where=where))
            summary.counts[result.level] = summary.counts.get(result.level, 0) + 1
            if _rank(result) > _rank(summary.worst):
                summary.worst, summary.where = result, where


def _rank(result: Result) -> tuple[int, float]:
    unknown = float("inf") if result.level == "fail" else float("-inf")
    return _SEVERITY[result.level], unknown if result.value is None else result.value


@dataclass(frozen=True, kw_only=True, eq=False)
class Report:
    """All that a page shows.

    Attributes:
        title: Name of the run, recording or dataset.
        kind: What it is, in words.
        facts: (name, value) of the summary.
        episodes: Every attempt, in order.
        distributions: Of actions and states.
        has_units: Whether their components have the names, and so the units, that we give them.
        checks: None when no checks were run.
        missing: Sentences about what the source does not tell.
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


def flags_of(report: SubjectReport) -> tuple[Result, ...]:
    """What failed or warned of one recording, run or dataset, the failures first."""
    found = [result for result in report.results if result.level in ("warn", "fail")]
    return tuple(sorted(found, key=lambda result: result.level != "fail"))
