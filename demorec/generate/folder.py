"""The folder of a run: opened under a lock, verified, kept up to date, never mixed with another run."""

from __future__ import annotations

import platform
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from demorec.config import GenerateConfig, deciding_versions
from demorec.errors import ConfigError, DemorecError, GenerationError
from demorec.generate.contents import PARTS, RUN
from demorec.generate.executor import peak_memory
from demorec.generate.lock import LOCK_NAME, run_lock
from demorec.generate.options import RunOptions, available_cores
from demorec.generate.plan import differences
from demorec.generate.run_file import (
    EPISODES,
    FAILED,
    RUN_NAME,
    UNFINISHED,
    Attempt,
    DamagedRunFileError,
    RunFile,
    Session,
    free_name,
    load_run_file,
    save_run_file,
)
from demorec.generate.survey import Inspector, recordings_of, survey
from demorec.replacing import check_replaceable, replaced_parts, settle_parts, shown

if TYPE_CHECKING:
    from demorec.generate.run import Progress, RunResult


class RunFolder:
    """An opened run. Lines are saved at intervals: one that a crash loses is read back from its recording.

    Attributes:
        path: Of the folder.
        run: All that is known.
        lost_workers: Of this session.
    """

    def __init__(self, path: Path, run: RunFile) -> None:
        self.path = path
        self.run = run
        self.lost_workers = 0
        self._attempts = {(a.episode_index, a.attempt): a for a in run.attempts}
        self._made: list[Attempt] = []
        self._peak_worker_bytes = 0
        self._session = Session(started=_now(), machine=machine())
        self._has_session = False
        self._started = time.monotonic()
        self._saved_at = -1e9
        self._save_seconds = 0.0

    @property
    def kept(self) -> str:
        """A sentence on what is there, for messages."""
        done = sum(a.success for a in self._attempts.values())
        return f"{done} of {self.run.num_episodes} episodes are complete and kept: {self.path}"

    def begin_session(self, *, executor: str, workers: int) -> None:
        """Work begins: write down who does it."""
        self._has_session = True
        self._session = replace(self._session, executor=executor, workers=workers)
        self.save()

    def add(self, attempt: Attempt, *, peak_worker_bytes: int) -> None:
        """Take a line in; saves when the last save is old enough to cost little."""
        self._attempts[attempt.episode_index, attempt.attempt] = attempt
        self._made.append(attempt)
        self._peak_worker_bytes = max(self._peak_worker_bytes, peak_worker_bytes)
        if time.monotonic() - self._saved_at > max(1.0, 50 * self._save_seconds):
            self.save()

    def end_session(self, state: str) -> None:
        """Work has ended, for whatever reason."""
        self._session = replace(self._session, ended=_now(), state=state)
        try:
            self.save()
        except GenerationError:
            if state != "stopped":  # else the reason why it stopped is the one to be told
                raise

    def save(self) -> None:
        """Write run.json; GenerationError when that is not possible."""
        start = time.monotonic()
        self._session = replace(
            self._session,
            wall_seconds=round(start - self._started, 3),
            lost_workers=self.lost_workers,
            peak_worker_bytes=self._peak_worker_bytes,
            peak_driver_bytes=peak_memory(),
        )
        sessions = self.run.sessions
        if self._has_session:
            earlier = sessions[:-1] if sessions and sessions[-1].started == self._session.started else sessions
            sessions = (*earlier, self._session)
        self.run = replace(self.run, sessions=sessions).with_attempts(self._attempts.values())
        try:
            save_run_file(self.run, self.path)
        except OSError as error:
            self.check_alive()
            raise GenerationError(
                f"run.json cannot be written ({error.strerror}); mend that and run the same command again, which "
                f"finds every complete episode: {self.path}"
            ) from error
        self._saved_at = time.monotonic()
        self._save_seconds = self._saved_at - start

    def check_alive(self) -> None:
        """Raise GenerationError when the folder has been moved or deleted under our feet."""
        if not (self.path / LOCK_NAME).exists() or not (self.path / EPISODES).is_dir():
            raise GenerationError(
                "The output folder has vanished while the run was writing to it: bring it back, or start again: "
                f"{self.path}"
            )

    def result(self, *, interrupted: bool) -> RunResult:
        """What this session has come to."""
        from demorec.generate.run import RunResult

        return RunResult(
            folder=self.path,
            run=self.run,
            session=self._session,
            made=tuple(self._made),
            interrupted=interrupted,
        )


@contextmanager
def open_run(
    config: GenerateConfig, options: RunOptions, *, progress: Progress, inspect: Inspector
) -> Iterator[RunFolder]:
    """Open, continue or begin a run in `options.out`, locked until the context ends.

    Raises:
        ConfigError: The folder is in use, holds another run or somebody's files, or cannot be written to; or what is
            to be overwritten is not a run alone.
    """
    assert options.out is not None
    path = options.out.absolute()
    _make_folder(path)
    with run_lock(path):
        settle_parts(path, PARTS)
        replaces = options.overwrite and ((path / RUN_NAME).exists() or bool(recordings_of(path)))
        if replaces:
            check_replaceable(path, RUN, overwrite=True)
        else:
            _refuse_strangers(path)
        asked = RunFile(config=config, versions=deciding_versions(), num_episodes=options.num_episodes)
        # What is overwritten is deleted when the new run's run.json is there, and put back when that cannot be made.
        with replaced_parts(path, PARTS) if replaces else nullcontext():
            folder = _begin_or_continue(path, asked, progress=progress, inspect=inspect)
        yield folder


def _begin_or_continue(path: Path, asked: RunFile, *, progress: Progress, inspect: Inspector) -> RunFolder:
    """Bring the folder and its run.json to what is known now."""
    run = _known_run(path, asked, progress=progress, inspect=inspect)
    if run.num_episodes > asked.num_episodes:
        progress.says(f"The run has {run.num_episodes} episodes already, more than asked; all of them stay.")
    run = replace(run, num_episodes=max(run.num_episodes, asked.num_episodes))
    try:
        for name in (EPISODES, FAILED, UNFINISHED):
            (path / name).mkdir(exist_ok=True)
        found = survey(path, run, inspect=inspect, progress=progress.verifying)
    except OSError as error:
        raise ConfigError(f"The output folder cannot be used ({error.strerror}): {path}") from error
    for file, reason in found.set_aside.items():
        progress.says(f"{file} was moved to {UNFINISHED}/: {reason}.")
    for line in (line for line in found.attempts if line.episode_index >= run.num_episodes):
        run = replace(run, num_episodes=line.episode_index + 1)
    folder = RunFolder(path, run.with_attempts(found.attempts))
    folder.save()
    return folder


def machine() -> dict[str, str]:
    """What a session runs on, for people."""
    return {
        "host": platform.node(),
        "system": platform.platform(),
        "processor": _processor(),
        "cores": str(available_cores()),
        "python": sys.version.split()[0],
    }


def _known_run(path: Path, asked: RunFile, *, progress: Progress, inspect: Inspector) -> RunFile:
    """What the folder says it holds, if that is the run that is asked for."""
    if (path / RUN_NAME).exists():
        try:
            run = load_run_file(path)
        except DamagedRunFileError as error:
            # The recordings know what they are of; a run.json that nobody can read is kept for whoever wants to try.
            damaged = free_name(path / f"{RUN_NAME}.damaged")
            run = _run_of_recordings(path, asked, inspect)
            (path / RUN_NAME).rename(damaged)
            progress.says(f"{error}. It is kept as {damaged.name}; the recordings are read instead.")
    elif recordings_of(path):
        run = _run_of_recordings(path, asked, inspect)
    else:
        return asked
    different = differences(run, asked.config, asked.versions)
    if different:
        raise ConfigError(
            f"The output folder holds another run ({'; '.join(different)}): choose another --out, ask for the same, or "
            f"give --overwrite to delete it: {path}"
        )
    return run


def _run_of_recordings(path: Path, asked: RunFile, inspect: Inspector) -> RunFile:
    """The run that the first readable recording belongs to; the survey looks at each of them."""
    from demorec.plain import from_plain

    for file in recordings_of(path):
        try:
            found = inspect(file)
            config = from_plain(dict(found.config), GenerateConfig)
        except (DemorecError, OSError, ValueError):
            continue
        return RunFile(config=config, versions=found.versions, num_episodes=asked.num_episodes)
    return asked


def _make_folder(path: Path) -> None:
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(
            f"The output folder cannot be made ({error.strerror}): choose another --out: {path}"
        ) from error


def _refuse_strangers(path: Path) -> None:
    if (path / RUN_NAME).exists() or recordings_of(path):
        return
    strangers = sorted(p.name for p in path.iterdir() if p.name not in (*PARTS, LOCK_NAME, f"{RUN_NAME}.part"))
    if strangers:
        raise ConfigError(
            f"The output folder holds files that are of no run ({shown(strangers)}): choose another --out: {path}"
        )


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="milliseconds")


def _processor() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()
