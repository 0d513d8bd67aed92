"""Folder of a run of external episodes: numbered recordings in episodes/, run.json, a lock.

The recordings are authoritative; run.json has a line for each and can be rebuilt from them. An episode cut off by a
crash is recovered when the folder is opened again; existing files are never overwritten.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from hashlib import sha256
from pathlib import Path

from demorec.core.errors import ConfigError, RecordingError, resource_error
from demorec.core.files import LOCK_NAME, free_name, make_folder, run_lock
from demorec.core.plain import plain_differences
from demorec.core.replacing import RECORDING, json_object
from demorec.episode.info import EpisodeInfo
from demorec.extensions.recovery.recover import recover
from demorec.mcap import Recording
from demorec.runs.recorded import recorded_line
from demorec.runs.run_file import (
    DATASET,
    EPISODES,
    IMPORT_NAME,
    RUN_NAME,
    Attempt,
    DamagedRunFileError,
    RunFile,
    is_external_run,
    load_any_run_file,
    recording_name,
    refuse_strangers,
    save_run_file,
)


class ExternalFolder:
    """An opened run.

    Attributes:
        path: Path of the folder.
        episodes: Existing episodes, in order.
        recovered: Recordings that were recovered on opening.
        planned: See `RunFile`; written to run.json with the next change.

    Args:
        path: Path of the folder.
        recovers: Whether to recover episodes cut off by a crash; an import records them again instead.
    """

    def __init__(self, path: Path, *, recovers: bool = True) -> None:
        self.path = path
        self.recovered: list[Path] = []
        self._begun_with: EpisodeInfo | None = None
        known, is_damaged = RunFile(), False
        if os.path.lexists(path / RUN_NAME):
            try:
                known = _load(path)
            except DamagedRunFileError:  # the recordings have the same information
                is_damaged = True
        if recovers:
            self._recover_parts()
        self.planned: Sequence[str] = known.planned
        lines = {line.file: line for line in known.attempts}
        self.episodes = [self._line(file, lines) for file in sorted((path / EPISODES).glob("episode_*.mcap"))]
        if is_damaged:
            (path / RUN_NAME).rename(free_name(path / f"{RUN_NAME}.damaged"))

    def _recover_parts(self) -> None:
        for part in sorted((self.path / EPISODES).glob("episode_*.mcap.part")):
            target = part.with_suffix("")
            if os.path.lexists(target):
                continue
            try:
                recover(part, target)
            except RecordingError:  # no complete frame: the file stays, and its number is not used again
                continue
            part.rename(free_name(part.with_name(f"{part.name}.recovered")))
            self.recovered.append(target)

    def _line(self, file: Path, known: Mapping[str, Attempt]) -> Attempt:
        """Line of a recording in run.json, or from the recording itself if the file is another one."""
        _refuse_foreign(file)
        line = known.get(f"{EPISODES}/{file.name}")
        if line is not None and line.num_bytes == file.stat().st_size:
            return line
        return external_line(file)

    @property
    def next_index(self) -> int:
        """Number of the next episode, greater than all existing ones, finished or not."""
        numbers = [line.episode_index for line in self.episodes]
        for path in (self.path / EPISODES).glob("episode_*"):
            if path.suffix == ".part" and not path.stat().st_size:
                continue  # an episode without frames: the next one takes its place
            digits = path.name.removeprefix("episode_").partition(".")[0]
            numbers.append(int(digits) if digits.isdecimal() else -1)
        return max(numbers, default=-1) + 1

    def kind(self) -> EpisodeInfo | None:
        """Description of the last episode, which new ones must match; None for an empty run.

        ConfigError if another file has replaced it.
        """
        if not self.episodes:
            return None
        last = self.path / self.episodes[-1].file
        _refuse_foreign(last)
        with Recording(last) as recording:
            return recording.info

    def check_fits(self, info: EpisodeInfo) -> None:
        """Raise ConfigError with all differences between a new episode and the last existing one."""
        kind = self.kind()
        if kind is not None and (different := differences(kind, info)):
            raise ConfigError(
                f"The run's episodes differ from this one ({'; '.join(different)}): record into another folder: "
                f"{self.path}"
            )

    def has(self, info: EpisodeInfo) -> bool:
        """Whether an earlier start of the same import has written an episode; ConfigError if it is another
        recording.
        """
        path = episode_path(self.path, info.episode_index)
        if not path.exists():
            return False
        _refuse_foreign(path)
        with Recording(path) as recording:
            if recording.info == info and recording.outcome is not None:
                return True
        raise ConfigError(
            f"Another recording exists already: import the same files as before, or choose another --out: {path}"
        )

    def begin(self, info: EpisodeInfo) -> None:
        """Write run.json before a planned episode is recorded, so that a run cut off by a crash lists its missing
        episodes.
        """
        if self._begun_with is None:
            self._begun_with = info
            self.save()

    def add(self, recording: Path) -> Attempt:
        """Add a finished recording to run.json."""
        line = external_line(recording)
        self.planned = [what for what in self.planned if what != planned_episode(line.episode_index)]
        self.extend([line])
        return line

    def extend(self, lines: Iterable[Attempt]) -> None:
        """Add finished recordings to run.json, by their `external_line`."""
        self.episodes = sorted([*self.episodes, *lines], key=lambda line: line.episode_index)
        self.save()

    def save(self) -> None:
        """Write run.json, unless the run is empty."""
        if (info := self.kind() or self._begun_with) is None:
            return
        run = RunFile(
            robot=info.robot_name,
            fps=info.fps,
            planned=tuple(self.planned),
            attempts=tuple(self.episodes),
        )
        try:
            save_run_file(run, self.path)
        except OSError as error:
            unwritable = RecordingError(
                f"run.json cannot be written ({error.strerror}), the recordings are all there: {self.path}"
            )
            raise resource_error(error) or unwritable from error


def _load(path: Path) -> RunFile:
    """Read run.json; ConfigError if it belongs to another kind of run, even if damaged."""
    if json_object(path / RUN_NAME) and not is_external_run(path):
        raise ConfigError(f"The folder holds a run of another kind: choose another folder: {path}")
    return load_any_run_file(path)


@contextmanager
def open_external_run(path: Path, *, recovers: bool = True) -> Iterator[ExternalFolder]:
    """Open, continue or begin a run, locked until the context ends; arguments as in `ExternalFolder`.

    Raises:
        ConfigError: The folder is in use, holds another kind of run or foreign files (also under a recording's name),
        or is not writable.
        RecordingError: One of its recordings is damaged.
    """
    path = path.absolute()
    was_there = path.exists()
    if was_there and not path.is_dir():
        raise ConfigError(f"A run needs a folder, and this is a file: choose another path: {path}")
    if path.is_dir() and not is_external_run(path):
        if (path / RUN_NAME).exists():
            with suppress(DamagedRunFileError):  # its recordings have the same information
                _load(path)
        refuse_strangers(path, (EPISODES, DATASET, IMPORT_NAME, LOCK_NAME))
    make_folder(path / EPISODES)
    with run_lock(path):
        folder = ExternalFolder(path, recovers=recovers)
        folder.save()
        try:
            yield folder
        finally:
            folder.save()
            if folder._begun_with is not None and not folder.episodes:
                (path / RUN_NAME).unlink(missing_ok=True)
            if not was_there and not (path / RUN_NAME).exists():
                with suppress(OSError):  # only a recording or an unfinished one is removed
                    (path / EPISODES).rmdir()
                    (path / LOCK_NAME).unlink()
                    path.rmdir()


def _refuse_foreign(path: Path) -> None:
    """Raise ConfigError for an entry with a recording's name that is not a recording."""
    if not path.is_file() or not RECORDING.recognises(path):
        raise ConfigError(f"This is not a recording and is in the way, move it elsewhere: {path}")


def planned_episode(episode_index: int) -> str:
    """Name of an episode among those that an import plans."""
    return f"episode {episode_index}"


def episode_path(run: Path, episode_index: int) -> Path:
    """Path of an episode's recording."""
    return run / EPISODES / recording_name(episode_index, 0, success=True)


def external_line(file: Path) -> Attempt:
    """Build a recording's line of run.json; RecordingError if it is damaged."""
    return replace(recorded_line(file)[0], file=f"{EPISODES}/{file.name}")


def differences(there: EpisodeInfo, new: EpisodeInfo) -> tuple[str, ...]:
    """Describe the differences between two episodes in properties that a run or dataset must share."""
    return plain_differences(_traits(there), _traits(new))


def _traits(info: EpisodeInfo) -> dict[str, str]:
    urdf = f"one of digest {sha256(info.urdf.encode()).hexdigest()[:8]}" if info.urdf else "none"
    features = {f"feature {one.name}": f"{one.dtype} of {', '.join(one.names)}" for one in info.features}
    cameras = {f"camera {one.name}": f"{one.width}x{one.height} {one.kept}".strip() for one in info.cameras}
    return {"robot": info.robot_name, "fps": str(info.fps), **features, **cameras, "URDF": urdf}
