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
from demorec.core.errors import ExportError, RecordingError, check_option
from demorec.core.processes import process_pool
from demorec.core.tables import CHECKS
from demorec.episode.roles import NO_NAMES, NamedRoles
from demorec.robots.motors import Motors
from demorec.runs.find import EPISODE_FOLDERS, expect, expect_recordings, find
from demorec.runs.run_file import DATASET

_WORTH_PROCESSES = {"with images": 4, "without": 50}
"""Recordings from which on several processes check faster than one: each takes seconds to start."""
OPENS_IN_LEROBOT = "dataset_opens"
"""The check that starts LeRobot, which takes seconds: by request, or where another check failed."""
SubjectKind = Literal["recording", "run", "dataset"]
_SEVERITY: dict[Level, int] = {"skip": 0, "pass": 1, "warn": 2, "fail": 3}


@dataclass(frozen=True, kw_only=True)
class CheckOptions:
    """Which checks are run.

    Attributes:
        images: Whether images are decoded.
        only: Names of checks; empty for all.
        workers: Processes; 1 works in this one.
        lerobot: Whether LeRobot opens each dataset; otherwise only those in which another check failed.
        urdf: Text of the description of the robot, for recordings and datasets that do not have one; "" for none.
        motors: The servos whose values LeRobot recorded in datasets with elements of their names.
        named: Features whose role the user names, in what demorec did not simulate.
    """

    images: bool = True
    only: tuple[str, ...] = ()
    workers: int = 1
    lerobot: bool = False
    urdf: str = ""
    motors: Motors | None = None
    named: NamedRoles = NO_NAMES

    def validate(self) -> None:
        """Raise ConfigError for unknown names or impossible numbers."""
        for name in self.only:
            CHECKS.check_name(name)
        check_option("workers", self.workers, 1, 1024)

    def checks(self, *forms: Form) -> list[Check]:
        """Those of some forms, in the order of the table."""
        wanted = set(forms)
        return [
            check for check in _all_checks() if wanted & set(check.on) and (not self.only or check.name in self.only)
        ]


@cache
def _all_checks() -> tuple[Check, ...]:
    return tuple(CHECKS.load(name) for name in CHECKS.names())


@dataclass(frozen=True, kw_only=True)
class Subject:
    """Something to check.

    Attributes:
        path: Where it is.
        kind: What it is.
    """

    path: Path
    kind: SubjectKind


@dataclass(frozen=True, kw_only=True)
class SubjectReport(Subject):
    """All results about one subject.

    Attributes:
        results: In the order of the table.
        notes: Sentences about features without a role, which no check looked at.
    """

    results: tuple[Result, ...]
    notes: tuple[str, ...] = ()

    @property
    def level(self) -> Level:
        """The worst; "skip" where nothing was measured."""
        return max((result.level for result in self.results), key=lambda level: _SEVERITY[level], default="skip")

    def is_bad(self, *, strict: bool = False) -> bool:
        """Whether a check failed, or with `strict` warned."""
        return _SEVERITY[self.level] >= _SEVERITY["warn" if strict else "fail"]

    def count(self, level: Level) -> int:
        """How many results have a level."""
        return sum(result.level == level for result in self.results)


def find_subjects(paths: Sequence[Path]) -> list[Subject]:
    """Recordings, runs (with their recordings and their dataset) and datasets, in order, each once.

    Raises:
        ConfigError: A path is missing or holds nothing that can be checked.
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
    """How many processes check fastest: one for each core, or one where that many do not pay."""
    count = sum(subject.kind == "recording" for subject in subjects)
    return cores if count >= _WORTH_PROCESSES["with images" if images else "without"] else 1


def check_subjects(subjects: Sequence[Subject], options: CheckOptions) -> Iterator[SubjectReport]:
    """One report for each subject, in order."""
    if options.workers == 1 or len(subjects) < 2:
        for subject in subjects:
            yield check_subject(subject, options)
        return
    with process_pool(min(options.workers, len(subjects))) as pool:
        # Datasets take longest: they begin first.
        order = sorted(subjects, key=lambda subject: subject.kind != "dataset")
        begun = {subject: pool.submit(check_subject, subject, options) for subject in order}
        for subject in subjects:
            yield begun[subject].result()


def check_subject(subject: Subject, options: CheckOptions) -> SubjectReport:
    """All checks of one recording, run or dataset; ConfigError where it lacks a feature that the user names."""
    if subject.kind == "recording":
        with CheckedEpisode(subject.path, options.urdf, options.named) as episode:
            notes = _notes(episode)
            found = _run(options, episode)
    elif subject.kind == "run":
        notes = ()
        found = _run(options, CheckedRun(subject.path, options.named))
    else:
        dataset = CheckedDataset(subject.path, options.urdf, options.motors, options.named)
        notes = _notes(dataset)
        found = _run(options, dataset)
    results = tuple(replace(result, detail=_within(subject.path, result.detail)) for result in found)
    return SubjectReport(**vars(subject), results=results, notes=notes)


def _notes(subject: CheckedEpisode | CheckedDataset) -> tuple[str, ...]:
    """What has no role or was read by the rows; nothing of what cannot be read, which the checks report."""
    read_by_rows = subject.folder.notes if isinstance(subject, CheckedDataset) else ()
    try:
        return (*read_by_rows, *subject.roles.notes())
    except (RecordingError, ExportError):
        return ()


Checked = CheckedEpisode | CheckedDataset | CheckedRun


def _within(path: Path, detail: str) -> str:
    """The detail of a result without the path of its subject, which the report prints above it."""
    return detail.removesuffix(f": {path}").replace(f"{path}/", "")


def _run(options: CheckOptions, subject: Checked) -> list[Result]:
    """Run the checks of a subject in order. One that fails for the same unreadable part as another is blocked."""
    checks = [check for check in options.checks(subject.form) if options.images or not check.needs_images]
    results: list[Result] = []
    unreadable: set[str] = set()
    for check in checks:
        if check.name == OPENS_IN_LEROBOT and not (
            options.lerobot or check.name in options.only or any(result.level == "fail" for result in results)
        ):
            continue
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
