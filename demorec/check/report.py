"""Runs the checks over whatever a user names and tells what was found."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from demorec.check.base import Check, Group, Level, Result, Scope
from demorec.check.dataset import Dataset
from demorec.check.episode import RecordedEpisode
from demorec.check.run import RUN_NAME, CheckedRun
from demorec.errors import ConfigError, resource_error
from demorec.lerobot.paths import is_dataset
from demorec.processes import SPAWN
from demorec.scene.assets import allow_models
from demorec.tables import CHECKS

_OF_THE_FILE: tuple[Group, ...] = ("file", "time")
"""Groups of the checks that look at the file itself, not at what was recorded."""
_SEVERITY: dict[Level, int] = {"skip": 0, "pass": 0, "warn": 1, "fail": 2}


@dataclass(frozen=True, kw_only=True)
class CheckOptions:
    """Which checks are run.

    Attributes:
        pictures: Whether pictures are decoded.
        only: Names of checks; empty for all.
        workers: Processes; 1 works in this one.
        allowed: The user's own modules beside which models of robots may be read.
    """

    pictures: bool = True
    only: tuple[str, ...] = ()
    workers: int = 1
    allowed: tuple[str, ...] = ()

    def validate(self) -> None:
        """Raise ConfigError for unknown names or impossible numbers."""
        for name in self.only:
            CHECKS.check_name(name)
        if not 1 <= self.workers <= 1024:
            raise ConfigError(f"workers is {self.workers}, allowed are 1 to 1024.")

    def checks(self, scope: Scope) -> list[Check]:
        """Those of a scope, in the order of the table."""
        loaded = [CHECKS.load(name) for name in CHECKS.names() if not self.only or name in self.only]
        return [check for check in loaded if check.scope == scope and (self.pictures or not check.needs_pictures)]


@dataclass(frozen=True, kw_only=True)
class SubjectReport:
    """All results about one recording, run or dataset.

    Attributes:
        path: What was checked.
        kind: What it is.
        results: In the order of the table.
        is_failed_attempt: As in `Subject`.
    """

    path: Path
    kind: Scope
    results: tuple[Result, ...]
    is_failed_attempt: bool = False

    @property
    def level(self) -> Literal["pass", "warn", "fail"]:
        """The worst."""
        severity = max((_SEVERITY[result.level] for result in self.results), default=0)
        return ("pass", "warn", "fail")[severity]

    def is_bad(self, *, strict: bool = False) -> bool:
        """Whether it must not be as it is: a check failed, or with `strict` warned.

        A failed attempt that a run keeps may have dropped its cube or hit the table, that is why it failed; bad is one
        whose file is damaged, which the checks of file and time find.
        """
        limit = _SEVERITY["warn" if strict else "fail"]
        return any(
            _SEVERITY[result.level] >= limit
            for result in self.results
            if not self.is_failed_attempt or result.group in _OF_THE_FILE
        )

    def count(self, level: Level) -> int:
        """How many results have a level."""
        return sum(result.level == level for result in self.results)


@dataclass(frozen=True, kw_only=True)
class Subject:
    """Something to check.

    Attributes:
        path: Where it is.
        kind: What it is.
        is_failed_attempt: Whether it is a failed attempt that a run keeps, found there and not named by the user: it
            is judged apart from what the run made.
    """

    path: Path
    kind: Scope
    is_failed_attempt: bool = False


def find_subjects(paths: Sequence[Path]) -> list[Subject]:
    """Recordings, runs (with their recordings and their dataset) and datasets, in order, each once.

    Raises:
        ConfigError: A path is missing or holds nothing that can be checked.
    """
    found: list[Subject] = []
    for path in paths:
        before = len(found)
        if path.is_file():
            found.append(Subject(path=path, kind="recording"))
        elif (path / RUN_NAME).is_file():
            found.append(Subject(path=path, kind="run"))
            found += [
                Subject(path=file, kind="recording", is_failed_attempt=file.parent.name == "failed")
                for file in CheckedRun(path).recordings
            ]
            if is_dataset(path / "dataset"):
                found.append(Subject(path=path / "dataset", kind="dataset"))
        elif is_dataset(path):
            found.append(Subject(path=path, kind="dataset"))
        elif path.is_dir():
            files = [*sorted(path.glob("*.mcap")), *sorted((path / "episodes").glob("*.mcap"))]
            found += [Subject(path=file, kind="recording") for file in files]
        else:
            raise ConfigError(f"There is no such file or folder: {path}")
        if len(found) == before:
            raise ConfigError(f"The folder holds no recording, run or dataset: {path}")
    return list(dict.fromkeys(found))


def check_subjects(subjects: Sequence[Subject], options: CheckOptions) -> Iterator[SubjectReport]:
    """One report for each subject, in order."""
    if options.workers == 1 or len(subjects) < 2:
        for subject in subjects:
            yield check_subject(subject, options)
        return
    # Spawned: forked children would share decoders and libraries in the middle of something.
    with ProcessPoolExecutor(max_workers=min(options.workers, len(subjects)), mp_context=SPAWN) as pool:
        yield from pool.map(check_subject, subjects, [options] * len(subjects))


def check_subject(subject: Subject, options: CheckOptions) -> SubjectReport:
    """All checks of one recording, run or dataset."""
    allow_models(options.allowed)
    checks = options.checks(subject.kind)
    if subject.kind == "recording":
        with RecordedEpisode(subject.path) as episode:
            results = _run(checks, episode, ("opens", "readable"), lambda: episode.columns)
    elif subject.kind == "run":
        results = _run(checks, CheckedRun(subject.path), (), None)
    else:
        dataset = Dataset(subject.path)
        results = _run(checks, dataset, ("dataset_readable",), lambda: dataset.rows)
    return SubjectReport(
        path=subject.path,
        kind=subject.kind,
        results=tuple(results),
        is_failed_attempt=subject.is_failed_attempt,
    )


def _run(
    checks: Sequence[Check], subject: object, gates: tuple[str, ...], read: Callable[[], object] | None
) -> list[Result]:
    """Run checks in order; when a gate fails, what needs the numbers is skipped rather than failing in the same words.

    The checks of file and time look at the file itself and are run as far as it can be opened.
    """
    results: list[Result] = []
    unreadable = ""
    if read is not None:
        try:
            read()
        except Exception as error:
            if (lack := resource_error(error)) is not None:
                raise lack from error
            unreadable = str(error) or "the numbers cannot be read"
    for check in checks:
        if unreadable and check.group not in _OF_THE_FILE and check.name not in gates:
            results.append(check.skipped("the numbers cannot be read"))
            continue
        results.append(check.run(subject))
        if check.name == "opens" and results[-1].level == "fail":
            results += [other.skipped("the recording cannot be opened") for other in checks if other is not check]
            break
    if unreadable and all(result.level in ("pass", "skip") for result in results):
        # No chosen check looks at what is broken; it must not pass for that.
        gate = CHECKS.load(gates[-1])
        results.append(gate.run(subject))
    return results
