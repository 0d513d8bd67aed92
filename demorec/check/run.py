"""Checks of a run's folder against its run.json, and of its episodes against each other."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from functools import cached_property, partial
from pathlib import Path

from demorec.check.base import Fault, Form, check, listed
from demorec.core.errors import DemorecError, resource_error
from demorec.core.files import sha256_of
from demorec.core.plain import to_plain
from demorec.episode.info import EpisodeInfo
from demorec.runs.recorded import recorded_line
from demorec.runs.run_file import EPISODES, FAILED, Attempt, GeneratedRun, RunFile, is_external_run, load_any_run_file

run_check = partial(
    check,
    family="files",
    on=("run", "external run"),
    needs="a run",
    why="The run differs from its run.json.",
    do="run the command that began it again, or restore the files",
)
_NOT_RECORDED = ("file", "seconds")
"""Keys of an attempt in run.json that are not in its recording."""


class CheckedRun:
    """A run on disk, read from its own files."""

    def __init__(self, path: Path) -> None:
        self.path = path

    @cached_property
    def form(self) -> Form:
        """Whether its episodes are simulated or external."""
        return "external run" if is_external_run(self.path) else "run"

    @cached_property
    def run(self) -> RunFile:
        """Content of run.json; a DemorecError if it cannot be read."""
        return load_any_run_file(self.path)

    @property
    def attempts(self) -> list[Attempt]:
        """Attempts that have a recording."""
        return [attempt for attempt in self.run.attempts if attempt.file]

    @property
    def recordings(self) -> list[Path]:
        """Every existing recording, successes first."""
        return [path for folder in (EPISODES, FAILED) for path in sorted((self.path / folder).glob("*.mcap"))]


@run_check(measures="files missing, changed, or not in run.json")
def run_files(run: CheckedRun) -> Iterator[Fault]:
    """Compare the recordings with those that run.json lists, and their SHA-256."""
    recorded = {attempt.file: attempt.sha256 for attempt in run.attempts}
    there = {str(path.relative_to(run.path)) for path in run.recordings}
    wrong = [f"{file} is missing" for file in sorted(recorded.keys() - there)]
    wrong += [f"{file} is not in run.json" for file in sorted(there - recorded.keys())]
    for file in sorted(there & recorded.keys()):
        try:
            if sha256_of(run.path / file) != recorded[file]:
                wrong.append(f"{file} has changed")
        except OSError as error:
            if (lack := resource_error(error, run.path / file)) is not None:
                raise lack from error
            wrong.append(f"{file} cannot be read ({error.strerror})")
    return listed(wrong)


@run_check(measures="requested episodes that are missing", unit="episodes")
def run_complete(run: CheckedRun) -> Iterator[Fault]:
    """Count the remaining episodes of an interrupted generation or import."""
    if missing := run.run.num_missing:
        yield Fault(severity="look", value=f"{missing} episodes", message=run.run.unfinished)


@run_check(measures="recordings that differ from run.json")
def run_agrees(run: CheckedRun) -> Iterator[Fault]:
    """Compare each recording with its line in number, attempt, seed, outcome and digest, and with the run's config and
    versions.
    """
    return listed([text for attempt in run.attempts for text in _contradictions(run, attempt)])


def _contradictions(run: CheckedRun, attempt: Attempt) -> Iterator[str]:
    try:
        recorded, info = recorded_line(run.path / attempt.file)
    except (DemorecError, OSError) as error:
        if (lack := resource_error(error)) is not None:
            raise lack from error
        return  # reported by that recording's checks
    listed = asdict(attempt)
    for name, value in asdict(recorded).items():
        if name not in _NOT_RECORDED and listed[name] != value:
            yield f"{name} of {attempt.file} is {str(value)[:40]!r}, run.json has {str(listed[name])[:40]!r}"
    if isinstance(run.run, GeneratedRun):
        yield from (f"{name} of {attempt.file} differs from the run's" for name in _other_config(run.run, info))


def _other_config(run: GeneratedRun, info: EpisodeInfo) -> Iterator[str]:
    """Names of config values in a recording that differ from the run's, and "versions"."""
    config = to_plain(run.config)
    yield from (
        name
        for name in sorted({*config, *info.simulated.config})
        if config.get(name) != info.simulated.config.get(name)
    )
    if run.versions and dict(info.versions) != dict(run.versions):
        yield "versions"
