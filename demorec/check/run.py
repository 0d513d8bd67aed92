"""Does a run's folder hold what its run.json says, each episode once, and do they cover what was randomised.

Of an imported run also what the import found in its bags, which need not be there any more: the report that
`demorec import` keeps in import.json, judged again.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterator
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from demorec.check.base import SCENE, Form, Found, Lacking, Measurement, NotMeasured, check, run_check, worst
from demorec.check.coverage import MIN_EPISODES, motion_vector, pieces, start_vector, twins, worst_gap
from demorec.check.dataset import Dataset
from demorec.core.errors import ConfigError, RecordingError, describe_error, resource_error
from demorec.core.files import open_regular, read_json_limited
from demorec.core.geometry import Array
from demorec.core.plain import digest
from demorec.datasets.lerobot.files import read_json
from demorec.datasets.lerobot.paths import INFO_PATH
from demorec.episode.features import STATE
from demorec.episode.info import EpisodeInfo
from demorec.mcap import open_recording
from demorec.runs.run_file import EPISODES, FAILED, RUN_NAME, is_external_run, load_any_run_file

if TYPE_CHECKING:
    from demorec.sources.import_file import ImportFile

_MAX_JSON_BYTES = 2 << 30
_TIMES = frozenset(
    ("clock_offset", "clock_jump", "clock_drift", "unstamped", "drops", "gap", "slow", "fps", "jitter", "order")
) | {"duplicates", "late_start", "early_end", "cut_off", "repeats", "skips"}
_IMAGES = frozenset(("frozen", "same_pictures", "swapped", "size", "format", "keyframe", "frame_id"))
_MOST_LISTED = 5
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

    def courses(self) -> tuple[list[str], list[Array], list[Array]]:
        """Files of the successes, their motions and their starts, as far as these are known."""
        if self.form == "external run":
            motions = dict(self._external_motions())
            return list(motions), list(motions.values()), []
        kept = {file: attempt for file, attempt in self.attempts.items() if file.startswith("episodes/")}
        starts = [start_vector(info.scene) for info, _, _ in kept.values()]
        return list(kept), [motion for _, _, motion in kept.values()], starts

    def _external_motions(self) -> Iterator[tuple[str, Array]]:
        """Of the recordings that can be read and have a state."""
        for path in self.recordings:
            try:
                with open_recording(path) as recording:
                    if STATE in (features := recording.columns().features):
                        yield path.name, motion_vector(features[STATE])
            except (RecordingError, OSError):
                continue  # check `opens` or `readable` of that recording says so

    @property
    def successes(self) -> list[EpisodeInfo]:
        """Infos of the recordings in episodes/ that were asked for last (others may be there from a larger request)."""
        asked = self.run["num_episodes"]
        infos = [info for file, (info, _, _) in self.attempts.items() if file.startswith("episodes/")]
        return [info for info in infos if info.episode_index < asked]


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
    return Measurement(value=len(wrong), detail="; ".join(wrong[:3]) or f"{len(there)} recordings")


@run_check(
    measures="recordings whose own account differs from run.json or the run",
)
def run_agrees(run: CheckedRun) -> Measurement:
    """Number, attempt, seed and config, value by value, of each recording are those of its line and of the run."""
    wrong = [text for line in run.lines for text in _contradictions(run, line)]
    return Measurement(value=len(wrong), detail="; ".join(wrong[:3]) or f"{len(run.lines)} lines")


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


@run_check(
    measures="episodes that have the start or the motion of another, or a piece of it",
    on=("run", "external run", "dataset"),
    needs="two episodes",
)  # fmt: skip
def duplicates(subject: CheckedRun | Dataset) -> Found:
    """Every episode is there once: no two start alike (within a tenth of a millimetre) or move alike; and in datasets
    none has a piece of another one, or twice of itself, bit for bit."""
    names, motions, starts = subject.courses()
    if len(names) < 2:
        return Lacking(need="two episodes")
    if subject.has_equal_starts:
        return NotMeasured(why="--fixed asks for one layout, every episode of which starts alike")
    found = [twins(starts, names, "starts")] if starts else []
    found += [pieces(subject.numbers, names)] if isinstance(subject, Dataset) else []
    return worst(*found, twins(motions, names, "motions"))


@run_check(
    measures="largest gap in the range of a randomised quantity, share",
    warn=0.35,
    fail=0.6,
    on=("run", "dataset"),
    needs=f"{MIN_EPISODES} episodes, each with {SCENE}",
)  # fmt: skip
def coverage(subject: CheckedRun | Dataset) -> Found:
    """Start places, yaws, sizes and goals are spread over their ranges (judged from 50 episodes on)."""
    return worst_gap(subject.successes)


@run_check(
    measures="episodes that the run's dataset lacks or has too many",
)
def run_dataset(run: CheckedRun) -> Measurement | None:
    """The dataset that was made from the run has an episode for each success of those asked for last."""
    path = run.path / "dataset" / INFO_PATH
    if not path.is_file():
        return None
    try:
        episodes = int(read_json(path)["total_episodes"])
    except (OSError, ValueError, KeyError, TypeError, OverflowError) as error:
        raise ConfigError(f"info.json of the dataset cannot be used ({describe_error(error)}): {path}") from error
    successes = sum(1 for line in run.lines if line["success"] and line["episode_index"] < run.run["num_episodes"])
    return Measurement(value=abs(episodes - successes), detail=f"{episodes} in the dataset, {successes} successes")


import_check = partial(check, on=("external run",), needs="a run that was imported", fail=math.inf)


@import_check(
    group="time",
    measures="findings about times in the bags that were imported: clocks, losses, gaps, repeats, jitter, order",
)
def import_times(run: CheckedRun) -> Found:
    """The streams of the bags were whole, in order and on one clock."""
    return _found(run, lambda kind: kind in _TIMES)


@import_check(
    group="images",
    measures="findings about cameras in the bags that were imported: frozen, swapped, of several sizes",
)
def import_images(run: CheckedRun) -> Found:
    """Each camera showed its own images, of one size and kind."""
    return _found(run, lambda kind: kind in _IMAGES)


@import_check(
    group="physics",
    measures="findings about numbers in the bags that were imported: NaN, stuck sensors, spikes, units",
)
def import_numbers(run: CheckedRun) -> Found:
    """The numbers of the bags were such as robots have."""
    return _found(run, lambda kind: kind not in _TIMES | _IMAGES)


@import_check(
    group="run",
    measures="episodes that an import dropped, since something was missing or too old, and bags that it skipped",
)
def import_dropped(run: CheckedRun) -> Found:
    """Every episode that the bags hold is in the run, but those that a marker discards."""
    if (found := run.import_file) is None:
        return None
    rows = [row for bag in found.bags for row in bag.episodes if row.episode_index is None and not row.discarded]
    dropped = [row.reason for row in rows] + [f"{bag.name}: {bag.reason}" for bag in found.skipped]
    return Measurement(value=len(dropped), detail="; ".join(dropped[:_MOST_LISTED]))


def _found(run: CheckedRun, is_mine: Callable[[str], bool]) -> Found:
    if (found := run.import_file) is None:
        return None
    words = [
        f"{bag.name}: {finding.kind}, {finding.stream}: {finding.text}".replace(", : ", ": ")
        for bag in found.bags
        for finding in bag.odd
        if is_mine(finding.kind)
    ]
    return Measurement(value=len(words), detail="; ".join(words[:_MOST_LISTED]))
