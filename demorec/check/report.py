"""Run the checks over recordings, runs and datasets."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Literal

from demorec.check.base import BLOCKED, Check, Form, Level, Result
from demorec.check.dataset import CheckedDataset
from demorec.check.episode import CheckedEpisode
from demorec.check.run import CheckedRun
from demorec.core.errors import check_option
from demorec.core.processes import process_pool
from demorec.core.tables import FILE_CHECKS
from demorec.runs.find import EPISODE_FOLDERS, expect, expect_recordings, find
from demorec.runs.run_file import DATASET

_WORTH_PROCESSES = {"with images": 4, "without": 50}
"""Minimum number of recordings for several processes to be faster than one: each takes seconds to start."""
SubjectKind = Literal["recording", "run", "dataset"]
_SEVERITY: dict[Level, int] = {"skip": 0, "pass": 1, "warn": 2, "fail": 3}


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

    def checks(self, *forms: Form) -> list[Check]:
        """Selected checks of some forms, in table order."""
        wanted = set(forms)
        return [
            check for check in _all_checks() if wanted & set(check.on) and (not self.only or check.name in self.only)
        ]


@cache
def _all_checks() -> tuple[Check, ...]:
    return tuple(FILE_CHECKS.load(name) for name in FILE_CHECKS.names())


@dataclass(frozen=True, kw_only=True)
class Subject:
    """Something to check.

    Attributes:
        path: Its path.
        kind: Its kind.
    """

    path: Path
    kind: SubjectKind


@dataclass(frozen=True, kw_only=True)
class SubjectReport(Subject):
    """All results about one subject.

    Attributes:
        results: Results in table order.
    """

    results: tuple[Result, ...]

    @property
    def level(self) -> Level:
        """The worst level; "skip" if nothing was measured."""
        return max((result.level for result in self.results), key=lambda level: _SEVERITY[level], default="skip")

    def is_bad(self, *, strict: bool = False) -> bool:
        """Whether a check failed or, with `strict`, warned."""
        return _SEVERITY[self.level] >= _SEVERITY["warn" if strict else "fail"]

    def count(self, level: Level) -> int:
        """Count the results with a level."""
        return sum(result.level == level for result in self.results)


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
    if options.workers == 1 or len(subjects) < 2:
        for subject in subjects:
            yield check_subject(subject, options)
        return
    with process_pool(min(options.workers, len(subjects))) as pool:
        # Datasets take longest, so they start first.
        order = sorted(subjects, key=lambda subject: subject.kind != "dataset")
        begun = {subject: pool.submit(check_subject, subject, options) for subject in order}
        for subject in subjects:
            yield begun[subject].result()


def check_subject(subject: Subject, options: CheckOptions) -> SubjectReport:
    """Run all checks of one recording, run or dataset."""
    if subject.kind == "recording":
        with CheckedEpisode(subject.path, colours=options.colours) as episode:
            found = _run(options, episode)
    elif subject.kind == "run":
        found = _run(options, CheckedRun(subject.path))
    else:
        found = _run(options, CheckedDataset(subject.path))
    results = tuple(replace(result, detail=_within(subject.path, result.detail)) for result in found)
    return SubjectReport(**vars(subject), results=results)


Checked = CheckedEpisode | CheckedDataset | CheckedRun


def _within(path: Path, detail: str) -> str:
    """Remove the subject's path from a result's detail; the report prints it above."""
    return detail.removesuffix(f": {path}").replace(f"{path}/", "")


def _run(options: CheckOptions, subject: Checked) -> list[Result]:
    """Run the checks of a subject in order. A check that fails on the same unreadable part as another is blocked."""
    checks = [check for check in options.checks(subject.form) if options.images or not check.needs_images]
    results: list[Result] = []
    unreadable: set[str] = set()
    for check in checks:
        result = check.run(subject)
        if result.level == "fail" and result.value is None:
            if result.detail in unreadable:
                result = check.skipped(BLOCKED)
            unreadable.add(result.detail)
        results.append(result)
        if check.name == "opens" and result.level == "fail":
            results += [other.skipped(BLOCKED) for other in checks if other is not check]
            break
    return results
