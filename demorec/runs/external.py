"""The folder of a run whose episodes were collected: numbered recordings in episodes/, run.json, a lock.

The recordings are the truth; run.json has a line for each and can be made again from them. An episode that a crash cut
off is made whole when the folder is opened again, and nothing that is there is ever written over.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path

from demorec.core.errors import ConfigError, RecordingError, in_words, resource_error
from demorec.core.files import LOCK_NAME, MAX_JSON_BYTES, make_folder, read_json_limited, run_lock
from demorec.core.plain import from_plain, to_plain
from demorec.core.replacing import json_object
from demorec.episode.info import EpisodeInfo
from demorec.mcap import Recording, recover
from demorec.runs.run_file import (
    COLLECTED,
    DATASET,
    EPISODES,
    IMPORT_NAME,
    RUN_FORMAT,
    RUN_NAME,
    DamagedRunFileError,
    free_name,
    recording_name,
    refuse_strangers,
    replace_run_file,
    sha256_of,
    utc_now,
)


@dataclass(frozen=True, kw_only=True)
class ExternalEpisode:
    """One episode: a line of run.json.

    Attributes:
        episode_index: Which.
        instruction: In words.
        success: None when nobody said.
        file: Recording, relative to the run's folder.
        sha256: Of the file.
        digest: Of its content.
        num_frames, num_bytes: Of the recording.
        drops: "frames" or camera -> how many of them could not be taken.
        reason: Why it is no success.
    """

    episode_index: int
    instruction: str
    success: bool | None
    file: str
    sha256: str
    digest: str
    num_frames: int
    num_bytes: int
    drops: Mapping[str, int] = field(default_factory=dict)
    reason: str = ""


@dataclass(frozen=True, kw_only=True)
class ExternalRun:
    """The content of run.json.

    Attributes:
        robot: Its name.
        fps: Nominal frames per second.
        episodes: Every one, in order.
        sessions: "started" and "ended" (UTC, ISO 8601; "" while it goes on) of each program that added some.
    """

    robot: str
    fps: int
    episodes: tuple[ExternalEpisode, ...] = ()
    sessions: tuple[Mapping[str, str], ...] = ()

    @property
    def digest(self) -> str:
        """Content digest of the run: of its episodes in order; not of times."""
        lines = [f"{line.episode_index} {line.success} {line.digest}" for line in self.episodes]
        return sha256("\n".join(lines).encode()).hexdigest()[:16]


def is_external_run(folder: Path) -> bool:
    """Whether the folder has a run.json of a run whose episodes were collected."""
    return json_object(folder / RUN_NAME).get("kind") == COLLECTED


def load_external_run(folder: Path) -> ExternalRun:
    """Read run.json.

    Raises:
        ConfigError: It is of another kind of run, or of a newer format.
        DamagedRunFileError: It is no run file.
    """
    path = folder / RUN_NAME
    try:
        plain = read_json_limited(path, MAX_JSON_BYTES)
        if not isinstance(plain, dict):
            raise ValueError("no JSON object")
        if plain.get("kind") != COLLECTED or plain.get("format", 0) > RUN_FORMAT:
            raise ConfigError(f"The folder holds a run of another kind: choose another folder: {folder}")
        for derived in ("format", "kind", "digest"):
            plain.pop(derived)
        return from_plain(plain, ExternalRun)
    except (OSError, ValueError, KeyError, TypeError) as error:
        damaged = DamagedRunFileError(f"run.json is damaged ({in_words(error)}): {path}")
        raise resource_error(error, path) or damaged from error


class ExternalFolder:
    """An opened run.

    Attributes:
        path: Of the folder.
        episodes: What is there, in order.
        recovered: Recordings that were made whole when it was opened.

    Args:
        path: Of the folder.
        recovers: Whether what a crash left of an episode is made whole; an import makes it again.
    """

    def __init__(self, path: Path, *, recovers: bool = True) -> None:
        self.path = path
        self.recovered: list[Path] = []
        self._session = {"started": utc_now(), "ended": ""}
        known, is_damaged = ExternalRun(robot="", fps=1), False
        if os.path.lexists(path / RUN_NAME):
            try:
                known = load_external_run(path)
            except DamagedRunFileError:  # the recordings know what it said
                is_damaged = True
        if recovers:
            self._recover_parts()
        self._sessions = known.sessions
        lines = {line.file: line for line in known.episodes}
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
            except RecordingError:  # not one whole frame: it stays as it is, and its number is not used again
                continue
            part.rename(free_name(part.with_name(f"{part.name}.recovered")))
            self.recovered.append(target)

    def _line(self, file: Path, known: Mapping[str, ExternalEpisode]) -> ExternalEpisode:
        """What run.json says of a recording, or what it says itself where that is not the same file."""
        line = known.get(f"{EPISODES}/{file.name}")
        if line is not None and line.num_bytes == file.stat().st_size:
            return line
        return external_line(file)

    @property
    def next_index(self) -> int:
        """The number of the next episode: above all that are there, finished or not."""
        numbers = [line.episode_index for line in self.episodes]
        for path in (self.path / EPISODES).glob("episode_*"):
            if path.suffix == ".part" and not path.stat().st_size:
                continue  # of an episode that was opened, and given no frame: the next one takes its place
            digits = path.name.removeprefix("episode_").partition(".")[0]
            numbers.append(int(digits) if digits.isdecimal() else -1)
        return max(numbers, default=-1) + 1

    def path_of(self, episode_index: int) -> Path:
        """Where the recording of an episode goes."""
        return episode_path(self.path, episode_index)

    def kind(self) -> EpisodeInfo | None:
        """Description of the last episode, which new ones must be like; None of an empty run."""
        if not self.episodes:
            return None
        with Recording(self.path / self.episodes[-1].file) as recording:
            return recording.info

    def check_fits(self, info: EpisodeInfo) -> None:
        """Raise ConfigError with everything in which a new episode differs from the last one that is there."""
        kind = self.kind()
        if kind is not None and (different := differences(kind, info)):
            raise ConfigError(
                f"The run holds episodes of another kind ({'; '.join(different)}): record into another folder: "
                f"{self.path}"
            )

    def has(self, info: EpisodeInfo) -> bool:
        """Whether an earlier start of the same import has written an episode; ConfigError for another recording."""
        path = self.path_of(info.episode_index)
        if not path.exists():
            return False
        with Recording(path) as recording:
            if recording.info == info and recording.outcome is not None:
                return True
        raise ConfigError(
            f"Another recording is there already: import what the interrupted call was given, or choose another --out: "
            f"{path}"
        )

    def add(self, recording: Path) -> ExternalEpisode:
        """Take a finished recording into run.json."""
        line = external_line(recording)
        self.extend([line])
        return line

    def extend(self, lines: Iterable[ExternalEpisode]) -> None:
        """Take finished recordings into run.json, by their `collected_line`."""
        self.episodes = sorted([*self.episodes, *lines], key=lambda line: line.episode_index)
        self.save()

    def save(self, *, ended: bool = False) -> None:
        """Write run.json, if there is anything to tell."""
        if (info := self.kind()) is None:
            return
        session = self._session | ({"ended": utc_now()} if ended else {})
        run = ExternalRun(
            robot=info.robot_name, fps=info.fps, episodes=tuple(self.episodes), sessions=(*self._sessions, session)
        )
        plain = to_plain(run)
        lines = plain.pop("episodes")
        try:
            head = {"format": RUN_FORMAT, "kind": COLLECTED, "digest": run.digest, **plain}
            replace_run_file(self.path, head, lines)
        except OSError as error:
            unwritable = RecordingError(
                f"run.json cannot be written ({error.strerror}), the recordings are all there: {self.path}"
            )
            raise resource_error(error) or unwritable from error


@contextmanager
def open_external_run(path: Path, *, recovers: bool = True) -> Iterator[ExternalFolder]:
    """Open, continue or begin a run, locked until the context ends; arguments as of `ExternalFolder`.

    Raises:
        ConfigError: The folder is in use, holds another kind of run or somebody's files, or cannot be written to.
        RecordingError: One of its recordings is damaged.
    """
    path = path.absolute()
    if path.exists() and not path.is_dir():
        raise ConfigError(f"This is a file, no folder for a run: choose another: {path}")
    if path.is_dir() and not is_external_run(path):
        if (path / RUN_NAME).exists():
            with suppress(DamagedRunFileError):  # whose recordings know what it said
                load_external_run(path)
        refuse_strangers(path, (EPISODES, DATASET, IMPORT_NAME, LOCK_NAME))
    make_folder(path / EPISODES)
    with run_lock(path):
        folder = ExternalFolder(path, recovers=recovers)
        folder.save()
        try:
            yield folder
        finally:
            folder.save(ended=True)


def episode_path(run: Path, episode_index: int) -> Path:
    """Where the recording of an episode goes."""
    return run / EPISODES / recording_name(episode_index, 0, success=True)


def external_line(file: Path) -> ExternalEpisode:
    """The line of run.json that a recording speaks for; RecordingError when it is damaged."""
    with Recording(file) as recording:
        info, outcome = recording.info, recording.outcome
        return ExternalEpisode(
            episode_index=info.episode_index,
            instruction=info.instruction,
            success=None if outcome is None else outcome.success,
            file=f"{EPISODES}/{file.name}",
            sha256=sha256_of(file),
            digest=recording.digest(),
            num_frames=recording.num_frames,
            num_bytes=file.stat().st_size,
            drops={} if outcome is None else outcome.drops,
            reason="cut off by a crash" if outcome is None else outcome.failure_reason,
        )


def differences(there: EpisodeInfo, new: EpisodeInfo) -> list[str]:
    """In what two episodes differ that one run or dataset must have in common, in words."""
    traits = [("robot", there.robot_name, new.robot_name), ("fps", str(there.fps), str(new.fps))]
    for kind, old_ones, new_ones in (
        ("feature", _features(there), _features(new)),
        ("camera", _cameras(there), _cameras(new)),
    ):
        for name in dict.fromkeys([*old_ones, *new_ones]):
            traits.append((f"{kind} {name}", old_ones.get(name, "missing"), new_ones.get(name, "missing")))
    traits.append(("URDF", _short(there.urdf), _short(new.urdf)))
    return [f"{what} is {asked} instead of {found}" for what, found, asked in traits if found != asked]


def _features(info: EpisodeInfo) -> dict[str, str]:
    return {one.name: f"{one.dtype} of {', '.join(one.names)}" for one in info.features}


def _cameras(info: EpisodeInfo) -> dict[str, str]:
    return {one.name: f"{one.width}x{one.height} {one.kept}".strip() for one in info.cameras}


def _short(urdf: str) -> str:
    return f"one of digest {sha256(urdf.encode()).hexdigest()[:8]}" if urdf else "none"
