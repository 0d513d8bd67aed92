"""The folder of a run: opened under a lock, verified, kept up to date, never mixed with another run."""

from __future__ import annotations

import os
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from demorec.core.config import GenerateConfig, deciding_versions
from demorec.core.errors import (
    ConfigError,
    DemorecError,
    GenerationError,
    NotGeneratedError,
    resource_error,
    write_error,
)
from demorec.core.files import LOCK_NAME, free_name, make_folder, run_lock
from demorec.core.own_versions import version_differences
from demorec.core.plain import from_plain, plain_differences, to_plain
from demorec.core.replacing import check_replaceable, delete_parts, files_below, obstacle
from demorec.generate.contents import PARTS, RUN, Inspector, check_dataset_place, clear_scratch, recordings_of, survey
from demorec.generate.options import RunObserver, RunOptions, RunResult
from demorec.runs.run_file import (
    EPISODES,
    FAILED,
    RUN_NAME,
    UNFINISHED,
    Attempt,
    DamagedRunFileError,
    GeneratedRun,
    load_run_file,
    refuse_strangers,
    save_run_file,
)


class RunFolder:
    """An opened run. Lines are saved at intervals; one lost in a crash is read back from its recording."""

    def __init__(self, path: Path, run: GeneratedRun) -> None:
        self.path = path
        self.run = run
        self._attempts = {(a.episode_index, a.attempt): a for a in run.attempts}
        self._made: list[Attempt] = []
        self._started = time.monotonic()
        self._saved_at = -1e9
        self._save_seconds = 0.0

    @property
    def kept(self) -> str:
        """Progress of the run in one sentence, for messages."""
        done = sum(bool(a.success) for a in self._attempts.values())
        return f"{done} of {self.run.num_episodes} episodes are complete and kept: {self.path}"

    def add(self, attempt: Attempt) -> None:
        """Add a line; saves if the last save is old enough to cost little."""
        self._attempts[attempt.episode_index, attempt.attempt] = attempt
        self._made.append(attempt)
        if time.monotonic() - self._saved_at > max(1.0, 50 * self._save_seconds):
            self.save()

    def save(self) -> None:
        """Write run.json; GenerationError if that fails."""
        start = time.monotonic()
        self.run = self.run.with_attempts(self._attempts.values())
        try:
            save_run_file(self.run, self.path)
        except OSError as error:
            self.check_alive()
            raise resource_error(error) or GenerationError(
                f"run.json cannot be written ({error.strerror}); fix that and run the same command again, which "
                f"finds every complete episode: {self.path}"
            ) from error
        self._saved_at = time.monotonic()
        self._save_seconds = self._saved_at - start

    def check_alive(self) -> None:
        """Raise GenerationError if the folder has been moved or deleted meanwhile."""
        if not (self.path / LOCK_NAME).exists() or not (self.path / EPISODES).is_dir():
            raise GenerationError(
                "The output folder has vanished while the run was writing to it: bring it back, or start again: "
                f"{self.path}"
            )

    def result(self, *, interrupted: bool) -> RunResult:
        """Return the result of this session."""
        return RunResult(
            folder=self.path,
            run=self.run,
            made=tuple(self._made),
            seconds=time.monotonic() - self._started,
            interrupted=interrupted,
        )


@contextmanager
def open_run(
    config: GenerateConfig, options: RunOptions, *, progress: RunObserver, inspect: Inspector
) -> Iterator[RunFolder]:
    """Open, continue or begin a run in `options.out`, locked until the context ends.

    Nothing is written, not even the lock, before the request is known to fit the folder.

    Raises:
        ConfigError: The folder is in use, contains another run or the user's files, or is not writable; or it contains
            more than a run to be overwritten.
    """
    assert options.out is not None
    path = options.out.absolute()
    asked = GeneratedRun(config=config, versions=deciding_versions(config), num_episodes=options.num_episodes)
    with _told_as_unusable(path):
        _check_request(path, asked, options, inspect=inspect)
    make_folder(path)
    with run_lock(path):  # from here on no other process changes it, so it is examined again
        if _check_request(path, asked, options, inspect=inspect):
            delete_parts(path, PARTS)
        folder = _begin_or_continue(path, asked, progress=progress, inspect=inspect)
        yield folder
        clear_scratch(path, folder.run)


def _check_request(path: Path, asked: GeneratedRun, options: RunOptions, *, inspect: Inspector) -> bool:
    """Reject a request that does not fit the folder; return whether to replace its run. Only reads."""
    if options.overwrite and _would_replace(path):
        check_replaceable(path, RUN, overwrite=True)
        return True
    if path.is_dir() and not (path / RUN_NAME).exists() and not recordings_of(path):
        refuse_strangers(path, (*PARTS, UNFINISHED, LOCK_NAME))
    run, _ = _known_run(path, asked, inspect=inspect)
    if options.export:
        check_dataset_place(path, run)
    return False


def _would_replace(path: Path) -> bool:
    """Check whether anything exists at the run's place, part of a run or not."""
    parts = [path / name for name in PARTS if os.path.lexists(path / name)]
    return any(not part.is_dir() or any(files_below(part)) for part in parts)


def _begin_or_continue(path: Path, asked: GeneratedRun, *, progress: RunObserver, inspect: Inspector) -> RunFolder:
    """Update the folder and its run.json to the known state."""
    run, damage = _known_run(path, asked, inspect=inspect)
    if damage:
        kept = free_name(path / f"{RUN_NAME}.damaged")
        (path / RUN_NAME).rename(kept)
        progress.says(f"{damage}. It is kept as {kept.name}; the recordings are read instead.")
    with _told_as_unusable(path):
        for name in (EPISODES, FAILED, UNFINISHED):
            (path / name).mkdir(exist_ok=True)
        attempts, set_aside = survey(path, run, inspect=inspect, progress=progress.verifying)
    for file, reason in set_aside.items():
        progress.says(f"{file} was moved to {UNFINISHED}/: {reason}.")
    begun = 1 + max((line.episode_index for line in attempts), default=-1)
    if begun > asked.num_episodes:
        progress.says(f"{begun} episodes have been begun before, so the run has {begun} (export --episodes selects).")
    run = replace(run, num_episodes=max(begun, asked.num_episodes))
    folder = RunFolder(path, run.with_attempts(attempts))
    folder.save()
    return folder


def _known_run(path: Path, asked: GeneratedRun, *, inspect: Inspector) -> tuple[GeneratedRun, str]:
    """Find the folder's run, if it is the requested one, and the problem of its run.json ("" if none).

    Only reads. A run without episodes is replaced by the requested one.

    Raises:
        ConfigError: The folder contains another run.
    """
    run, damage = asked, ""
    try:
        if (path / RUN_NAME).exists():
            run = load_run_file(path)
    except DamagedRunFileError as error:
        # The recordings identify their run; an unreadable run.json is kept in case it can be repaired.
        damage = str(error)
    recordings = recordings_of(path)
    if run is asked and recordings:
        run = _run_of_recordings(recordings, asked, inspect)
    different = plain_differences(to_plain(run.config), to_plain(asked.config))
    different += version_differences(run.versions, asked.versions)
    if different and not recordings and not any(line.file for line in run.attempts):
        return asked, damage
    if different:
        delete = "" if obstacle(path, RUN) else ", or let it delete this one with --overwrite"
        raise ConfigError(
            f"The output folder holds another run ({'; '.join(different)}): choose another --out, or ask "
            f"generate-dataset for the same{delete}: {path}"
        )
    return run, damage


def _run_of_recordings(recordings: Iterable[Path], asked: GeneratedRun, inspect: Inspector) -> GeneratedRun:
    """Identify the run of the first readable recording; the survey examines each of them."""
    strange: NotGeneratedError | None = None
    for file in recordings:
        try:
            _, made_with, versions = inspect(file)
            config = from_plain(dict(made_with), GenerateConfig)
        except NotGeneratedError as error:
            strange = error
            continue
        except (DemorecError, OSError, ValueError, MemoryError) as error:
            if (lack := resource_error(error, file)) is not None:
                raise lack from error
            continue
        return replace(asked, config=config, versions=versions)
    if strange is not None:
        raise ConfigError(f"Nothing in the output folder was generated; choose another --out: {strange}")
    return asked


@contextmanager
def _told_as_unusable(path: Path) -> Iterator[None]:
    """Convert errors of the file system to one sentence about the folder."""
    try:
        yield
    except OSError as error:
        raise resource_error(error) or write_error("The output folder", error, path, GenerationError) from error
