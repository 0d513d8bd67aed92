"""Run the checks over recordings, runs and datasets, and the proofs of extensions that can remake recordings."""

from __future__ import annotations

import pkgutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

from demorec.check.base import RANK, Check, Checkable, CheckResult, Finding, Form, Verdict
from demorec.check.file import CheckedEpisode
from demorec.check.run import CheckedRun
from demorec.core.errors import check_option, without_path
from demorec.core.extension import rows_of
from demorec.core.processes import in_turn
from demorec.core.tables import FILE_CHECKS
from demorec.runs.find import EPISODE_FOLDERS, expect, expect_recordings, find
from demorec.runs.run_file import DATASET

_WORTH_PROCESSES = {"with images": 4, "without": 50}
"""Minimum number of recordings for several processes to be faster than one: each takes seconds to start."""
SubjectKind = Literal["recording", "run", "dataset"]


@dataclass(frozen=True, kw_only=True)
class CheckOptions:
    """Selection of checks.

    Attributes:
        images: Whether images are decoded.
        colours: Whether colour images are decoded, too; the doctor also decodes them.
        only: Names of checks; empty for all.
        workers: Number of processes; 1 runs in this process.
    """

    images: bool = True
    colours: bool = True
    only: tuple[str, ...] = ()
    workers: int = 1

    def validate(self) -> None:
        """Raise ConfigError for unknown names or impossible numbers."""
        for name in self.only:
            FILE_CHECKS.check_name(name)
        check_option("workers", self.workers, 1, 1024)

    def checks(self, form: Form) -> list[Check]:
        """Selected checks of a form, in table order."""
        names = [name for name in FILE_CHECKS.names() if not self.only or name in self.only]
        return [check for check in map(FILE_CHECKS.load, names) if form in check.on]


@dataclass(frozen=True, kw_only=True)
class Subject:
    """Something to check."""

    path: Path
    kind: SubjectKind


@dataclass(frozen=True, kw_only=True)
class SubjectReport(Subject):
    """All results about one subject, in table order."""

    results: tuple[CheckResult, ...]

    @property
    def findings(self) -> list[Finding]:
        """Findings of all checks, in table order."""
        return [finding for result in self.results for finding in result.findings]

    @property
    def verdict(self) -> Verdict:
        """Severity of the worst finding."""
        return max((finding.severity for finding in self.findings), key=RANK.__getitem__, default="good")


def find_subjects(paths: Sequence[Path]) -> list[Subject]:
    """Find recordings, runs (with their recordings and dataset) and datasets, in order, each once.

    Raises:
        ConfigError: A path is missing or holds nothing to check.
    """
    found: list[Subject] = []
    for path in paths:
        there = expect(path, "recording", "dataset", *EPISODE_FOLDERS)
        if there.kind == "dataset":
            found.append(Subject(path=path, kind="dataset"))
        elif there.kind == "run":
            found.append(Subject(path=path, kind="run"))
            found += [Subject(path=file, kind="recording") for file in (*there.recordings, *there.failed)]
            if find(path / DATASET).kind == "dataset":
                found.append(Subject(path=path / DATASET, kind="dataset"))
        else:
            failed = there.failed if there.kind == "evaluation" else ()
            expect_recordings(there, (*there.recordings, *failed))
            found += [Subject(path=file, kind="recording") for file in (*there.recordings, *failed)]
    return list(dict.fromkeys(found))


def useful_workers(subjects: Sequence[Subject], *, images: bool, cores: int) -> int:
    """Return the fastest number of processes: one per core, or one if several do not pay off."""
    count = sum(subject.kind == "recording" for subject in subjects)
    return cores if count >= _WORTH_PROCESSES["with images" if images else "without"] else 1


def check_subjects(subjects: Sequence[Subject], options: CheckOptions) -> Iterator[SubjectReport]:
    """Yield one report per subject, in order."""
    return in_turn(partial(check_subject, options=options), subjects, options.workers)


def check_subject(subject: Subject, options: CheckOptions) -> SubjectReport:
    """Run all checks of one recording, run or dataset."""
    if subject.kind == "recording":
        with CheckedEpisode(subject.path, colours=options.colours) as episode:
            found = tuple(_run(options, episode, episode.form))
    elif subject.kind == "run":
        run = CheckedRun(subject.path)
        found = tuple(_run(options, run, run.form))
    else:
        found = tuple(_run(options, subject, "dataset"))
    return SubjectReport(**vars(subject), results=found)


def _run(options: CheckOptions, subject: Checkable, form: Form) -> Iterator[CheckResult]:
    """Run the checks of a subject in order, except those that fail on the same unreadable part as an earlier one."""
    path = subject.path
    known: set[str] = set()
    for check in options.checks(form):
        result = None if check.needs_images and not options.images else check.run(subject)
        if result is None or (result.findings and {finding.message for finding in result.findings} <= known):
            continue
        known |= {finding.message for finding in result.findings}
        yield replace(result, findings=tuple(_within(path, finding) for finding in result.findings))
        if check.name == "opens" and result.findings:
            return


def _within(path: Path, finding: Finding) -> Finding:
    """Remove the subject's path from a message; the report prints it above."""
    return replace(finding, message=without_path(finding.message, path))


@dataclass(frozen=True, kw_only=True)
class Proof:
    """Result of a proof of one recording.

    Attributes:
        path: The recording.
        level: "warn" if this machine cannot prove it, "fail" if the remake differs.
        problem: The difference; "" unless it failed.
    """

    path: Path
    level: Literal["pass", "warn", "fail"]
    problem: str = ""


def prove(paths: Sequence[Path], allowed: Sequence[str] = ()) -> Iterator[Proof]:
    """Yield the proofs of recordings; none without an extension for it. They may import the `allowed` modules."""
    for _, target in rows_of("proofs"):
        yield from pkgutil.resolve_name(target)(paths, allowed)
