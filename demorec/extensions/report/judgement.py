"""Findings of the doctor for a report."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from demorec.check.base import Result
from demorec.extensions.doctor.base import DiagnosedFault
from demorec.extensions.doctor.examine import examine
from demorec.extensions.doctor.from_dataset import ReadOptions
from demorec.extensions.report.content import EpisodeResult


def results_of(path: Path, options: ReadOptions) -> list[EpisodeResult]:
    """The doctor's results for the report: each finding, and the score of each scored episode."""
    diagnosis, _ = examine(path, options)
    found = [EpisodeResult(each.episode, _as_result(each.check, each)) for each in diagnosis.findings]
    for each in diagnosis.episodes:
        if each.verdict != "good":
            worst = next(finding for finding in diagnosis.findings if finding.episode == each.episode)
            found.append(EpisodeResult(each.episode, replace(_as_result("score", worst), value=each.score)))
    return found


def _as_result(name: str, finding: DiagnosedFault) -> Result:
    return Result(
        check=name,
        group="doctor",
        level="fail" if finding.severity == "broken" else "warn",
        value=None,
        unit="",
        warn=0.0,
        fail=0.0,
        frame=None if finding.frames is None else finding.frames[0],
        detail=finding.message,
        why=finding.why,
        do=finding.do,
    )
