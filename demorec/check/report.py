"""Runs the checks over whatever a user names and tells what was found."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from demorec.assets import allow_models
from demorec.check.base import Check, Level, Result, Scope
from demorec.check.dataset import Dataset
from demorec.check.episode import RecordedEpisode
from demorec.check.run import RUN_NAME, RunFolder
from demorec.errors import ConfigError, DemorecError
from demorec.processes import SPAWN
from demorec.tables import CHECKS

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
    """

    path: Path
    kind: Scope
    results: tuple[Result, ...]

    @property
    def level(self) -> Literal["pass", "warn", "fail"]:
        """The worst."""
        severity = max((_SEVERITY[result.level] for result in self.results), default=0)
        return ("pass", "warn", "fail")[severity]

    def count(self, level: Level) -> int:
        """How many results have a level."""
        return sum(result.level == level for result in self.results)


@dataclass(frozen=True, kw_only=True)
class Subject:
    """Something to check."""

    path: Path
    kind: Scope


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
            found += [Subject(path=file, kind="recording") for file in RunFolder(path).recordings]
            if (path / "dataset" / "meta" / "info.json").is_file():
                found.append(Subject(path=path / "dataset", kind="dataset"))
        elif (path / "meta" / "info.json").is_file():
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
        results = _run(checks, RunFolder(subject.path), (), None)
    else:
        dataset = Dataset(subject.path)
        results = _run(checks, dataset, ("dataset_readable",), lambda: dataset.rows)
    return SubjectReport(path=subject.path, kind=subject.kind, results=tuple(results))


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
        except DemorecError as error:
            unreadable = str(error)
    for check in checks:
        if unreadable and check.group not in ("file", "time") and check.name not in gates:
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
