"""run.json: identity, options and progress of a run; one line per episode, replaced atomically.

The recordings are authoritative, and this file is their index: a line lost in a crash is restored from its recording.
It has the options that decide the data (config, versions) and no others.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from demorec.core.config import GenerateConfig
from demorec.core.errors import ConfigError, DemorecError, describe_error, resource_error
from demorec.core.files import read_json_limited, replace_text, sync_path
from demorec.core.plain import digest, from_plain, to_plain
from demorec.core.replacing import json_object, shown

RUN_NAME = "run.json"
RUN_FORMAT = 1
MAX_EPISODES = 10_000_000
EPISODES, FAILED, UNFINISHED, DATASET = "episodes", "failed", "unfinished", "dataset"
_EXTERNAL = "collected"
"""The "kind" in run.json for external episodes."""
IMPORT_NAME = "import.json"
"""File next to run.json with the sources and findings of `demorec import`
(`demorec.extensions.imports.import_file`).
"""


class DamagedRunFileError(DemorecError):
    """run.json exists but cannot be read; the recordings have the same information."""


@dataclass(frozen=True, kw_only=True)
class Attempt:
    """A finished attempt at one episode: a line of run.json.

    Attributes:
        episode_index, attempt: Numbers of the episode and the attempt.
        seed: Root seed, which with index and attempt determines every random number (demorec.core.seeding).
        success: Whether every check of the task passed; None if unknown.
        file: Recording, relative to the run's folder; "" if no scene could be laid out, so that there is no recording.
        sha256: Hash of the file.
        digest: Hash of its content (states, actions, packets, relevant metadata).
        num_frames, num_bytes: Size of the recording.
        phase, reason: Phase and reason of the failure; "" on success.
        seconds: CPU seconds; not part of any digest.
        instruction: Instruction in words, of an external episode.
        drops: "frames" or camera -> number of frames or images that could not be recorded, of an external episode.
    """

    episode_index: int
    attempt: int = 0
    seed: int = 0
    success: bool | None
    file: str = ""
    sha256: str = ""
    digest: str = ""
    num_frames: int = 0
    num_bytes: int = 0
    phase: str = ""
    reason: str = ""
    seconds: float = 0.0
    instruction: str = ""
    drops: Mapping[str, int] = field(default_factory=dict)


_EXTERNAL_LINE = (
    "episode_index", "instruction", "success", "file", "sha256", "digest", "num_frames", "num_bytes", "drops", "reason"
)  # fmt: skip
"""Keys in the line of an external episode; a line of a generated attempt has all but the last."""
_LINE = tuple(one.name for one in fields(Attempt) if one.name not in ("instruction", "drops"))


@dataclass(frozen=True, kw_only=True)
class ExportRecord:
    """The dataset exported from this run: content digest, options and path."""

    run_digest: str
    repo_id: str
    dataset_digest: str = ""
    seconds: float = 0.0


@dataclass(frozen=True, kw_only=True)
class RunFile:
    """Content of run.json; this class describes a run of external episodes, `GeneratedRun` one that demorec generates.

    Attributes:
        robot, fps: Name of the robot and nominal frames per second, of external episodes.
        planned: Names of bags or dataset episodes that the last import was given and has not imported yet.
        attempts: Every finished attempt at the requested episodes, ordered by episode and attempt.
    """

    robot: str = ""
    fps: int = 0
    planned: tuple[str, ...] = ()
    attempts: tuple[Attempt, ...] = ()

    @property
    def successes(self) -> tuple[Attempt, ...]:
        """Attempts that produced an episode."""
        return tuple(a for a in self.attempts if a.success)

    @property
    def failures(self) -> tuple[Attempt, ...]:
        """Attempts that failed."""
        return tuple(a for a in self.attempts if not a.success)

    @property
    def num_missing(self) -> int:
        """Number of requested episodes neither finished nor given up."""
        return len(self.planned)

    @property
    def is_complete(self) -> bool:
        """Whether nothing is missing."""
        return not self.num_missing

    @property
    def unfinished(self) -> str:
        """Missing episodes, as a sentence without its end; "" for a complete run."""
        if self.is_complete:
            return ""
        return f"The run is unfinished, {self._missing}; the command that began it continues it"

    @property
    def _missing(self) -> str:
        return f"{shown(self.planned)} {'is' if self.num_missing == 1 else 'are'} not imported yet"

    @property
    def digest(self) -> str:
        """Content digest of the run: config and attempts in order, but not times, machines or versions."""
        return _digest_of(f"{a.episode_index} {a.success} {a.digest}" for a in self.attempts)

    def plain(self) -> dict[str, Any]:
        """The content as plain data."""
        plain = to_plain(self)
        about = {key: plain[key] for key in ("robot", "fps", "planned")}
        return {**about, "episodes": _lines(self.attempts, _EXTERNAL_LINE)}


@dataclass(frozen=True, kw_only=True)
class GeneratedRun(RunFile):
    """A run that demorec generates.

    Attributes:
        config: Options that decide the data.
        versions: package -> version, of the packages that decide the bits.
        num_episodes: Number of successes last requested: episodes 0 to num_episodes - 1.
        export: The dataset exported from it, if any.
    """

    config: GenerateConfig
    versions: Mapping[str, str]
    num_episodes: int
    export: ExportRecord | None = None

    @property
    def config_digest(self) -> str:
        """Digest of the config: equal digests and versions give equal episodes."""
        return digest(self.config)

    @property
    def given_up(self) -> tuple[int, ...]:
        """Episodes for which every allowed attempt failed."""
        succeeded = {a.episode_index for a in self.successes}
        last = self.config.max_attempts - 1
        return tuple(a.episode_index for a in self.failures if a.attempt == last and a.episode_index not in succeeded)

    @property
    def num_missing(self) -> int:
        """Number of requested episodes neither finished nor given up."""
        return max(0, self.num_episodes - len(self.successes) - len(self.given_up))

    @property
    def _missing(self) -> str:
        return f"{self.num_missing} of {self.num_episodes} episodes are missing"

    @property
    def digest(self) -> str:
        """Content digest of the run: config and attempts in order, but not times, machines or versions."""
        lines = [f"{a.episode_index} {a.attempt} {int(bool(a.success))} {a.digest}" for a in self.attempts]
        return _digest_of([self.config_digest, *lines])

    def with_attempts(self, attempts: Iterable[Attempt]) -> GeneratedRun:
        """Return the run with these attempts, in order."""
        return replace(self, attempts=tuple(sorted(attempts, key=lambda a: (a.episode_index, a.attempt))))

    def plain(self) -> dict[str, Any]:
        """The content as plain data."""
        plain = to_plain(self)
        about = {key: plain[key] for key in ("config", "versions", "num_episodes", "export")}
        return {**about, "attempts": _lines(self.attempts, _LINE)}


def _digest_of(lines: Iterable[str]) -> str:
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()[:16]


def _lines(attempts: Iterable[Attempt], keys: Iterable[str]) -> list[dict[str, Any]]:
    return [{key: line[key] for key in keys} for line in map(to_plain, attempts)]


def save_run_file(run: RunFile, folder: Path) -> None:
    """Replace run.json atomically: a reader sees the old or the new file, also after a crash."""
    plain, head = run.plain(), dict[str, Any](format=RUN_FORMAT)
    if isinstance(run, GeneratedRun):
        lines = plain.pop("attempts")
        head["config_digest"] = run.config_digest
    else:
        lines = plain.pop("episodes")
        head["kind"] = _EXTERNAL
    head |= {"digest": run.digest, "complete": run.is_complete, **plain}
    text = json.dumps(head, indent=2, allow_nan=False)[:-2]
    text += ',\n  "episodes": [\n' + ",\n".join("    " + json.dumps(line, allow_nan=False) for line in lines)
    text += "\n  ]\n}\n"
    replace_text(folder / RUN_NAME, text)
    sync_path(folder)


def is_external_run(folder: Path) -> bool:
    """Whether the folder has the run.json of a run of external episodes."""
    return json_object(folder / RUN_NAME).get("kind") == _EXTERNAL


def load_run_file(folder: Path) -> GeneratedRun:
    """Read run.json of a run that demorec generated.

    Raises:
        ConfigError: The file is missing, has a newer format, or lists external episodes.
        DamagedRunFileError: It is not a valid run file.
    """
    run = load_any_run_file(folder)
    if not isinstance(run, GeneratedRun):
        raise ConfigError(
            f"The episodes of this run were recorded by another robot or program, not generated: {folder}"
        )
    return run


def load_any_run_file(folder: Path) -> RunFile:
    """Read run.json of any run; errors as in `load_run_file`."""
    path = folder / RUN_NAME
    try:
        plain = read_json_limited(path)
        if not isinstance(plain, dict):
            raise ValueError("not a JSON object")
        if (version := plain.pop("format")) > RUN_FORMAT:
            raise ConfigError(f"run.json has format {str(version)[:40]}, this demorec knows up to {RUN_FORMAT}: {path}")
        del plain["digest"], plain["complete"]
        plain["attempts"] = plain.pop("episodes")
        if plain.pop("kind", "") == _EXTERNAL:
            external = from_plain(plain, RunFile)
            if not external.robot or external.fps < 1:
                raise ValueError("robot or fps is missing")
            return external
        del plain["config_digest"]
        run = from_plain(plain, GeneratedRun)
        _refuse_impossible(run)
        return run.with_attempts(run.attempts)
    except FileNotFoundError as error:
        raise ConfigError(f"This is not a run of generate-dataset, because run.json is missing: {folder}") from error
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        damaged = DamagedRunFileError(f"run.json is damaged ({describe_error(error)}): {path}")
        raise resource_error(error, path) or damaged from error


def recording_name(episode_index: int, attempt: int, *, success: bool | None) -> str:
    """episode_000003.mcap, or episode_000003.attempt_0.mcap for a failed attempt."""
    middle = "" if success else f".attempt_{attempt}"
    return f"episode_{episode_index:06d}{middle}.mcap"


def refuse_strangers(folder: Path, own: Collection[str]) -> None:
    """Raise ConfigError if a folder contains entries other than these, which a run writes."""
    strangers = sorted(p.name for p in folder.iterdir() if p.name not in own and not p.name.startswith(RUN_NAME))
    if strangers:
        raise ConfigError(
            f"The folder holds files that are not part of a run ({shown(strangers)}): choose another: {folder}"
        )


def _refuse_impossible(run: GeneratedRun) -> None:
    """Raise ValueError for numbers that generate-dataset never writes; larger ones would cause endless loops."""
    if not 1 <= run.num_episodes <= MAX_EPISODES:
        raise ValueError(f"num_episodes is {run.num_episodes}, allowed are 1 to {MAX_EPISODES:,}")
    seen: set[tuple[int, int]] = set()
    for line in run.attempts:
        which = f"episode {line.episode_index}, attempt {line.attempt}"
        if not 0 <= line.episode_index < MAX_EPISODES or not 0 <= line.attempt < run.config.max_attempts:
            raise ValueError(f"a line has {which}, beyond {MAX_EPISODES:,} or max_attempts")
        if (line.episode_index, line.attempt) in seen:
            raise ValueError(f"two lines have {which}")
        seen.add((line.episode_index, line.attempt))
        name = recording_name(line.episode_index, line.attempt, success=line.success)
        place = f"{EPISODES if line.success else FAILED}/{name}"
        if line.file != place and (line.file or line.success):
            raise ValueError(f"the line of {which} has the file {line.file!r} instead of {place}")
