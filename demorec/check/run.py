"""Checks of a run's folder against its run.json, and the findings of an import.

`demorec import` keeps its findings in import.json: the bags themselves may be gone.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from demorec.check.base import Form, Found, Measurement, counted, run_check
from demorec.check.evidence import motion_vector
from demorec.core.errors import ConfigError, RecordingError, describe_error, resource_error
from demorec.core.files import open_regular, read_json_limited
from demorec.core.geometry import Array
from demorec.core.plain import digest
from demorec.episode.features import STATE
from demorec.episode.info import EpisodeInfo
from demorec.mcap import open_recording
from demorec.runs.run_file import EPISODES, FAILED, RUN_NAME, is_external_run, load_any_run_file

if TYPE_CHECKING:
    from demorec.sources.import_file import ImportFile

_MAX_JSON_BYTES = 2 << 30
_MAX_LISTED = 5
_LINE = {"episode_index": int, "attempt": int, "seed": int, "success": bool, "file": str, "sha256": str}
"""What the line of an attempt says, as far as it is checked."""


class CheckedRun:
    """A run on disk, read from its own files.

    Args:
        path: The folder with run.json.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    @cached_property
    def form(self) -> Form:
        """Whether demorec simulated its episodes or others recorded them."""
        return "external run" if is_external_run(self.path) else "run"

    @cached_property
    def run(self) -> dict[str, Any]:
        """run.json; ConfigError when it cannot be read."""
        try:
            run = read_json_limited(self.path / RUN_NAME, _MAX_JSON_BYTES)
            lines = run["episodes"]
            for line in (line for line in lines if line["state"] != "planned"):
                wrong = [key for key, kind in _LINE.items() if not isinstance(line[key], kind)]
                if wrong:
                    raise ValueError(f"the line of an episode with an impossible {wrong[0]}")
            if not isinstance(run["num_episodes"], int):
                raise ValueError("num_episodes is no whole number")
        except OSError as error:
            unusable = ConfigError(f"{RUN_NAME} cannot be used ({error.strerror}): {self.path}")
            raise resource_error(error) or unusable from error
        except (ValueError, KeyError, TypeError) as error:
            raise ConfigError(f"{RUN_NAME} cannot be used ({describe_error(error)}): {self.path}") from error
        return dict(run)

    @property
    def lines(self) -> list[dict[str, Any]]:
        """Of the attempts that have a recording."""
        return [line for line in self.run["episodes"] if line["state"] != "planned" and line.get("file")]

    @property
    def recordings(self) -> list[Path]:
        """Every recording there is, successes first."""
        return [path for folder in (EPISODES, FAILED) for path in sorted((self.path / folder).glob("*.mcap"))]

    @cached_property
    def attempts(self) -> dict[str, tuple[EpisodeInfo, dict[str, Any], Array]]:
        """File (relative) -> what it states about itself, of the recordings that can be read: before its first frame,
        after its last one (as run.json has it; nothing of one that was cut off), and `motion_vector` of its joints."""
        found = {}
        for path in self.recordings:
            try:
                with open_recording(path, simulated=True) as recording:
                    content, motion = recording.digest(), motion_vector(recording.columns().joint_position)
                    said: dict[str, Any] = {}
                    if (outcome := recording.outcome) is not None:
                        said = {
                            "success": outcome.success,
                            "phase": outcome.failure_phase,
                            "reason": outcome.failure_reason,
                            "num_frames": outcome.num_frames,
                            "num_bytes": path.stat().st_size,
                            "digest": content,
                        }
                    found[str(path.relative_to(self.path))] = recording.info, said, motion
            except (RecordingError, OSError):
                continue  # check `opens` or `readable` of that recording says so
        return found

    @property
    def listed(self) -> dict[str, str]:
        """File -> SHA-256 (hex), as run.json has them."""
        if self.form == "external run":
            return {line.file: line.sha256 for line in load_any_run_file(self.path).attempts}
        return {line["file"]: line["sha256"] for line in self.lines}

    @property
    def import_file(self) -> ImportFile | None:
        """What its import found; None where nothing says so."""
        from demorec.sources.import_file import load_import_file

        return load_import_file(self.path)

    @property
    def hint(self) -> str:
        """What becomes of a recording that run.json does not list."""
        is_complete = self.form == "external run" or self.run.get("complete", True)
        return "" if is_complete else " yet; the command that began the run takes it in and goes on"

    @property
    def has_equal_starts(self) -> bool:
        """Whether every episode starts alike because that was asked for."""
        return self.form == "run" and bool(self.run.get("config", {}).get("fixed"))

    def courses(self) -> tuple[list[str], list[Array]]:
        """Names of the recordings in episodes/ that can be read, and their motions."""
        if self.form == "external run":
            motions = dict(self._external_motions())
        else:
            motions = {file: motion for file, (_, _, motion) in self.attempts.items() if file.startswith("episodes/")}
        return list(motions), list(motions.values())

    def _external_motions(self) -> Iterator[tuple[str, Array]]:
        """Of the recordings that can be read and have a state."""
        for path in self.recordings:
            try:
                with open_recording(path) as recording:
                    if STATE in (features := recording.columns().features):
                        yield path.name, motion_vector(features[STATE])
            except (RecordingError, OSError):
                continue  # check `opens` or `readable` of that recording says so


@run_check(
    measures="files missing, changed since they were made, or not in run.json",
    on=("run", "external run"),
    needs="a run",
)
def run_files(run: CheckedRun) -> Measurement:
    """The recordings are exactly those that run.json lists, with the same SHA-256."""
    listed = run.listed
    there = {str(path.relative_to(run.path)) for path in run.recordings}
    wrong = [f"{file} is missing" for file in sorted(listed.keys() - there)]
    wrong += [f"{file} is not in run.json{run.hint}" for file in sorted(there - listed.keys())]
    for file in sorted(there & listed.keys()):
        try:
            with open_regular(run.path / file) as stream:
                if hashlib.file_digest(stream, "sha256").hexdigest() != listed[file]:
                    wrong.append(f"{file} has changed")
        except OSError as error:
            if (lack := resource_error(error, run.path / file)) is not None:
                raise lack from error
            wrong.append(f"{file} cannot be read ({error.strerror})")
    return counted(wrong, f"{len(there)} recordings")


@run_check(
    measures="recordings whose own account differs from run.json or the run",
)
def run_agrees(run: CheckedRun) -> Measurement:
    """Number, attempt, seed and config, value by value, of each recording are those of its line and of the run."""
    wrong = [text for line in run.lines for text in _contradictions(run, line)]
    return counted(wrong, f"{len(run.lines)} lines")


def _contradictions(run: CheckedRun, line: dict[str, Any]) -> Iterator[str]:
    """What a line of run.json says otherwise than its recording."""
    file = line["file"]
    if file not in run.attempts:
        return
    info, found, _ = run.attempts[file]
    said = (line["episode_index"], line["attempt"], line["seed"])
    if (info.episode_index, info.attempt, info.root_seed) != said:
        yield f"{file} is episode {info.episode_index}, attempt {info.attempt}"
    if info.config_digest != run.run.get("config_digest"):
        yield f"{file} was made with another config"
    yield from (f"{name} of {file} is another in run.json" for name in _config_off(run.run.get("config"), info))
    if line["success"] != file.startswith("episodes/"):
        yield f"{file} lies in the wrong folder"
    versions = run.run.get("versions", {})
    if versions and dict(info.versions) != versions:
        yield f"{file} was made by other versions"
    stem = Path(file).name.partition(".")[0]
    if stem != f"episode_{info.episode_index:06d}":
        yield f"{file} is episode {info.episode_index}"
    for name, value in found.items():
        if line.get(name, value) != value:
            yield f"{name} of {file} is {str(value)[:40]!r}, run.json says {str(line[name])[:40]!r}"


def _config_off(config: Any, info: EpisodeInfo) -> Iterator[str]:
    """What a run's config, value by value, says otherwise than a recording's, and that otherwise than its digest."""
    if not isinstance(config, dict):
        yield "config"
        return
    own = info.config
    yield from (name for name in sorted({*config, *own}) if config.get(name) != own.get(name))
    known = {"task": info.task, "fps": info.fps, "physics_hz": info.physics_hz, "seed": info.root_seed}
    yield from (name for name, value in known.items() if own.get(name, value) != value)
    if digest(own) != info.config_digest:
        yield "config_digest"


import_check = partial(run_check, on=("external run",), needs="a run that was imported", fail=math.inf)


@import_check(measures="findings about clocks, losses, images and numbers in the bags that were imported")
def import_findings(run: CheckedRun) -> Found:
    """List what the import found in its bags."""
    if (found := run.import_file) is None:
        return None
    words = [
        f"{bag.name}: {finding.kind}, {finding.stream}: {finding.text}".replace(", : ", ": ")
        for bag in found.bags
        for finding in bag.odd
    ]
    return Measurement(value=len(words), detail="; ".join(words[:_MAX_LISTED]))


@import_check(
    measures="episodes that an import dropped, since something was missing or too old, and bags that it skipped",
)
def import_dropped(run: CheckedRun) -> Found:
    """Every episode that the bags hold is in the run, but those that a marker discards."""
    if (found := run.import_file) is None:
        return None
    rows = [row for bag in found.bags for row in bag.episodes if row.episode_index is None and not row.discarded]
    dropped = [row.reason for row in rows] + [f"{bag.name}: {bag.reason}" for bag in found.skipped]
    return Measurement(value=len(dropped), detail="; ".join(dropped[:_MAX_LISTED]))
