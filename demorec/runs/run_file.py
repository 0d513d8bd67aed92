"""run.json: what a run is, what it is made with, and how far it is; one line per episode, replaced atomically.

The recordings are the truth and this file their table of contents: a line that a crash lost is read back from its
recording. What decides the data (config, versions) is kept apart from what does not (machine, times). A run whose
episodes demorec did not generate is one without a `Generation`.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from demorec.core.config import GenerateConfig
from demorec.core.errors import ConfigError, DemorecError, describe_error, resource_error
from demorec.core.files import MAX_JSON_BYTES, read_json_limited, replace_text, sync_path
from demorec.core.plain import digest, from_plain, to_plain
from demorec.core.replacing import json_object, shown

RUN_NAME = "run.json"
RUN_FORMAT = 1
MAX_EPISODES = 10_000_000
EPISODES, FAILED, UNFINISHED, DATASET = "episodes", "failed", "unfinished", "dataset"
_EXTERNAL = "collected"
"""The "kind" that run.json has where the episodes are external; see `demorec.runs.external`."""
IMPORT_NAME = "import.json"
"""Beside run.json: what `demorec import` read, and what it found in it (`demorec.extensions.imports.import_file`)."""
STARTING = "starting"
"""What a worker does before its first frame, once: it compiles, or loads, and fills caches that later episodes find."""


class DamagedRunFileError(DemorecError):
    """run.json is there but cannot be read; the recordings tell what it held."""


@dataclass(frozen=True, kw_only=True)
class Attempt:
    """One attempt at one episode that has come to its end: a line of run.json.

    Attributes:
        episode_index, attempt: Which.
        seed: Root seed; with index and attempt it gives every random number (demorec.core.seeding).
        success: Whether every check of the task passed; None when nobody said.
        file: Recording, relative to the run's folder; "" when no scene could be laid out, so that nothing was
            recorded.
        sha256: Of the file.
        digest: Of its content (states, actions, packets, metadata that matter).
        num_frames, num_bytes: Of the recording.
        phase, reason: Of the failure; "" on success.
        seconds: stage -> CPU seconds: "simulation", "rendering", "recording", and "starting" for the first
            attempt of a worker. Not part of any digest.
        instruction: In words, of an external episode.
        drops: Of an external episode: "frames" or camera -> how many of them could not be taken.
    """

    episode_index: int
    attempt: int = 0
    seed: int = 0
    success: bool | None
    file: str
    sha256: str
    digest: str
    num_frames: int
    num_bytes: int
    phase: str = ""
    reason: str = ""
    seconds: Mapping[str, float] = field(default_factory=dict)
    instruction: str = ""
    drops: Mapping[str, int] = field(default_factory=dict)


_EXTERNAL_LINE = (
    "episode_index", "instruction", "success", "file", "sha256", "digest", "num_frames", "num_bytes", "drops", "reason"
)  # fmt: skip
"""What the line of an external episode says; that of an attempt at a generated one says all but the last of these."""
_LINE = tuple(one.name for one in fields(Attempt) if one.name not in ("instruction", "drops"))


@dataclass(frozen=True, kw_only=True)
class RunSession:
    """One start of the command that worked on this run. Wall-clock times in UTC, ISO 8601."""

    started: str
    ended: str = ""
    state: str = "running"
    machine: Mapping[str, str] = field(default_factory=dict)
    executor: str = "local"
    workers: int = 0
    wall_seconds: float = 0.0
    lost_workers: int = 0
    peak_worker_bytes: int = 0
    peak_driver_bytes: int = 0


@dataclass(frozen=True, kw_only=True)
class ExportRecord:
    """The dataset that was made from this run: of which content, with which options, as what."""

    run_digest: str
    repo_id: str
    dataset_digest: str = ""
    seconds: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Generation:
    """What a run that demorec generates is made with, and how far it shall go.

    Attributes:
        config: What decides the data.
        versions: package -> version, of what decides the bits.
        num_episodes: How many successes were asked for last: of the episodes 0 to num_episodes - 1.
        beyond: As `RunFile.attempts`, of later episodes, which were made when more was asked for. They stay, and are no
            part of the run: not of its digest, not of its dataset.
        export: The dataset made from it, if any.
    """

    config: GenerateConfig
    versions: Mapping[str, str]
    num_episodes: int
    beyond: tuple[Attempt, ...] = ()
    export: ExportRecord | None = None


@dataclass(frozen=True, kw_only=True)
class RunFile:
    """The content of run.json.

    Attributes:
        generation: None of a run whose episodes are external; its values, read as those of the run, raise ConfigError
            then.
        robot, fps: Of external episodes: name of the robot, nominal frames per second.
        planned: Of external episodes: bags, or episodes of a dataset, that the last import was given and has not taken
            in yet, in words.
        attempts: Every finished attempt at the episodes that are asked for, ordered by episode and attempt.
        sessions: Every start of the command, or of a program that added episodes.
    """

    generation: Generation | None = None
    robot: str = ""
    fps: int = 0
    planned: tuple[str, ...] = ()
    attempts: tuple[Attempt, ...] = ()
    sessions: tuple[RunSession, ...] = ()

    @property
    def generated(self) -> Generation:
        """The generation; ConfigError for a run whose episodes are external."""
        if self.generation is None:
            raise ConfigError("The episodes of this run were recorded by another robot or program, not generated.")
        return self.generation

    @property
    def config(self) -> GenerateConfig:
        """The configuration of the generation."""
        return self.generated.config

    @property
    def versions(self) -> Mapping[str, str]:
        """The versions of the generation."""
        return self.generated.versions

    @property
    def num_episodes(self) -> int:
        """The number of successes asked for last."""
        return self.generated.num_episodes

    @property
    def beyond(self) -> tuple[Attempt, ...]:
        """The attempts at later episodes than asked for."""
        return self.generated.beyond

    @property
    def export(self) -> ExportRecord | None:
        """The dataset made from the run."""
        return self.generated.export

    def with_generation(self, **changes: Any) -> RunFile:
        """Return the same run with other values of its generation, which it must have."""
        return replace(self, generation=replace(self.generated, **changes))

    @property
    def config_digest(self) -> str:
        """Of the config: equal digests and versions, equal episodes."""
        return digest(self.config)

    @property
    def successes(self) -> tuple[Attempt, ...]:
        """The attempts that made an episode."""
        return tuple(a for a in self.attempts if a.success)

    @property
    def failures(self) -> tuple[Attempt, ...]:
        """The attempts that did not."""
        return tuple(a for a in self.attempts if not a.success)

    @property
    def given_up(self) -> tuple[int, ...]:
        """Episodes for which every allowed attempt failed."""
        succeeded = {a.episode_index for a in self.successes}
        last = self.config.max_attempts - 1
        return tuple(a.episode_index for a in self.failures if a.attempt == last and a.episode_index not in succeeded)

    @property
    def num_missing(self) -> int:
        """Episodes that are neither there nor given up; of external episodes, what is planned."""
        if self.generation is None:
            return len(self.planned)
        return max(0, self.num_episodes - len(self.successes) - len(self.given_up))

    @property
    def is_complete(self) -> bool:
        """Whether nothing is missing."""
        return not self.num_missing

    @property
    def unfinished(self) -> str:
        """What is missing, as a sentence without its end; "" for a complete run."""
        if self.is_complete:
            return ""
        if self.generation is None:
            missing = f"{shown(self.planned)} {'is' if self.num_missing == 1 else 'are'} not imported yet"
        else:
            missing = f"{self.num_missing} of {self.num_episodes} episodes are missing"
        return f"The run is unfinished, {missing}; the command that began it continues it"

    @property
    def digest(self) -> str:
        """Content digest of the run: of config and attempts, in order; not of times, machines or versions."""
        if self.generation is None:
            lines = [f"{a.episode_index} {a.success} {a.digest}" for a in self.attempts]
        else:
            lines = [self.config_digest]
            lines += [f"{a.episode_index} {a.attempt} {int(bool(a.success))} {a.digest}" for a in self.attempts]
        return hashlib.sha256("\n".join(lines).encode()).hexdigest()[:16]

    @property
    def known(self) -> tuple[Attempt, ...]:
        """Every finished attempt, those beyond what was asked for included."""
        return self.attempts + self.beyond

    def with_attempts(self, attempts: Iterable[Attempt]) -> RunFile:
        """This run with these attempts, in order; those of later episodes than asked for are `beyond`."""
        ordered = sorted(attempts, key=lambda a: (a.episode_index, a.attempt))
        within = tuple(a for a in ordered if a.episode_index < self.num_episodes)
        beyond = tuple(a for a in ordered if a.episode_index >= self.num_episodes)
        return replace(self.with_generation(beyond=beyond), attempts=within)

    def plain(self) -> dict[str, Any]:
        """All of it as plain data."""
        plain: dict[str, Any] = to_plain(self)
        if self.generation is None:
            about = {key: plain[key] for key in ("robot", "fps", "planned")}
            sessions = [{key: session[key] for key in ("started", "ended")} for session in plain["sessions"]]
            return {**about, "sessions": sessions, "episodes": _lines(self.attempts, _EXTERNAL_LINE)}
        generation = {key: value for key, value in plain["generation"].items() if key not in ("beyond", "export")}
        about = {"sessions": plain["sessions"], "export": plain["generation"]["export"]}
        lines = {"attempts": _lines(self.attempts, _LINE), "beyond": _lines(self.beyond, _LINE)}
        return {**generation, **about, **lines}


def _lines(attempts: Iterable[Attempt], keys: Iterable[str]) -> list[dict[str, Any]]:
    return [{key: line[key] for key in keys} for line in map(to_plain, attempts)]


def save_run_file(run: RunFile, folder: Path) -> None:
    """Replace run.json in one step: a reader or a crash sees the old or the new one, never a mixture."""
    plain, head = run.plain(), dict[str, Any](format=RUN_FORMAT)
    if run.generation is None:
        lines = plain.pop("episodes")
        head |= {"kind": _EXTERNAL, "digest": run.digest, "complete": run.is_complete, **plain}
    else:
        lines = _episode_lines(run, plain.pop("attempts") + plain.pop("beyond"))
        head |= {"config_digest": run.config_digest, "digest": run.digest, "complete": run.is_complete, **plain}
    text = json.dumps(head, indent=2, allow_nan=False)[:-2]
    text += ',\n  "episodes": [\n' + ",\n".join("    " + json.dumps(line, allow_nan=False) for line in lines)
    text += "\n  ]\n}\n"
    replace_text(folder / RUN_NAME, text)
    sync_path(folder)


def is_external_run(folder: Path) -> bool:
    """Whether the folder has a run.json of a run whose episodes are external."""
    return json_object(folder / RUN_NAME).get("kind") == _EXTERNAL


def load_run_file(folder: Path) -> RunFile:
    """Read run.json of a run that demorec generated.

    Raises:
        ConfigError: There is none, or it is of a newer format, or of external episodes.
        DamagedRunFileError: It is no run file.
    """
    run = load_any_run_file(folder)
    if run.generation is None:
        raise ConfigError(
            f"The episodes of this run were recorded by another robot or program, not generated: {folder}"
        )
    return run


def load_any_run_file(folder: Path) -> RunFile:
    """Read run.json, whatever the run's episodes are; errors as of `load_run_file`."""
    path = folder / RUN_NAME
    try:
        plain = read_json_limited(path, MAX_JSON_BYTES)
        if not isinstance(plain, dict):
            raise ValueError("no JSON object")
        if (version := plain.pop("format")) > RUN_FORMAT:
            raise ConfigError(f"run.json has format {str(version)[:40]}, this demorec knows up to {RUN_FORMAT}: {path}")
        lines, sessions = plain.pop("episodes"), plain.pop("sessions", [])
        del plain["digest"], plain["complete"]
        if plain.pop("kind", "") == _EXTERNAL:
            external = from_plain({**plain, "attempts": lines, "sessions": sessions}, RunFile)
            if not external.robot or external.fps < 1:
                raise ValueError("robot or fps is missing")
            return external
        attempts = [line for line in lines if line.pop("state") != "planned"]
        del plain["config_digest"]
        run = from_plain({"generation": plain, "attempts": attempts, "sessions": sessions}, RunFile)
        _refuse_impossible(run)
        return run.with_attempts(run.attempts)
    except FileNotFoundError as error:
        raise ConfigError(f"No run.json, so this is no run of generate-dataset: {folder}") from error
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        damaged = DamagedRunFileError(f"run.json is damaged ({describe_error(error)}): {path}")
        raise resource_error(error, path) or damaged from error


def recording_name(episode_index: int, attempt: int, *, success: bool | None) -> str:
    """episode_000003.mcap, or episode_000003.attempt_0.mcap for a failed attempt."""
    middle = "" if success else f".attempt_{attempt}"
    return f"episode_{episode_index:06d}{middle}.mcap"


def utc_now() -> str:
    """In ISO 8601."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


def refuse_strangers(folder: Path, own: Collection[str]) -> None:
    """Raise ConfigError for a folder that holds other things than what a run writes, of these names."""
    strangers = sorted(p.name for p in folder.iterdir() if p.name not in own and not p.name.startswith(RUN_NAME))
    if strangers:
        raise ConfigError(f"The folder holds files that are of no run ({shown(strangers)}): choose another: {folder}")


def _refuse_impossible(run: RunFile) -> None:
    """Raise ValueError for numbers that generate-dataset never writes: others would be counted up to, for ever."""
    if not 1 <= run.num_episodes <= MAX_EPISODES:
        raise ValueError(f"num_episodes is {run.num_episodes}, allowed are 1 to {MAX_EPISODES:,}")
    seen: set[tuple[int, int]] = set()
    for line in run.attempts:
        which = f"episode {line.episode_index}, attempt {line.attempt}"
        if not 0 <= line.episode_index < MAX_EPISODES or not 0 <= line.attempt < run.config.max_attempts:
            raise ValueError(f"a line is of {which}, beyond {MAX_EPISODES:,} or max_attempts")
        if (line.episode_index, line.attempt) in seen:
            raise ValueError(f"two lines are of {which}")
        seen.add((line.episode_index, line.attempt))
        name = recording_name(line.episode_index, line.attempt, success=line.success)
        place = f"{EPISODES if line.success else FAILED}/{name}"
        if line.file != place and (line.file or line.success):
            raise ValueError(f"the line of {which} names the file {line.file!r} instead of {place}")


def _episode_lines(run: RunFile, attempts: list[dict[str, Any]]) -> Iterable[dict[str, Any]]:
    """One line an attempt, and one for each episode that has not been tried yet."""
    tried: set[int] = set()
    given_up = set(run.given_up)
    for line in attempts:
        index = line["episode_index"]
        tried.add(index)
        state = "done" if line["success"] else ("given up" if index in given_up else "failed")
        yield {"state": state, **line}
    for index in range(run.num_episodes):
        if index not in tried:
            yield {"state": "planned", "episode_index": index, "seed": run.config.seed}
