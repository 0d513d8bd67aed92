"""Selection of the recordings for a dataset, and the check that they fit together."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal

from demorec.core.errors import ConfigError
from demorec.datasets.options import CommonOptions, parse_episodes
from demorec.episode.episode import POLICY_PHASE, interventions
from demorec.mcap import Recording
from demorec.runs.find import EPISODE_FOLDERS, expect, expect_recordings


def find_recordings(paths: Sequence[Path]) -> list[Path]:
    """Return the recordings in files, runs (folders with episodes/) and folders of recordings, in order. Recordings of
    failed attempts are included. Raises ConfigError if a path is missing, holds no recording, or the same recording is
    given twice.
    """
    found: list[Path] = []
    for path in paths:
        there = expect(path, "recording", *EPISODE_FOLDERS)
        of_path = [*there.recordings, *there.failed]
        expect_recordings(there, of_path)
        found += sorted(of_path, key=_attempt_order)
    seen: set[Path] = set()
    for file in found:
        resolved = file.resolve()
        if resolved in seen:
            raise ConfigError(f"The same recording is given twice: {file}")
        seen.add(resolved)
    return found


LeftOut = Literal["unwanted", "failures"]
"""Kind of a recording that is not exported: not requested, or a failed attempt or one cut off by a crash."""


def why_left_out(recording: Recording, options: CommonOptions) -> LeftOut | None:
    """Find out why a recording is not exported; None if it is. An episode with unknown success is not a failure; a
    recording in a folder `failed` always is. Raises RecordingError if it is damaged.
    """
    if not parse_episodes(options.episodes)(recording.info.episode_index):
        return "unwanted"
    if options.corrected_only:
        phases = recording.phases
        if POLICY_PHASE in phases and not interventions(phases).any():
            return "unwanted"
    if options.include_failures or not (recording.success is False or recording.path.parent.name == "failed"):
        return None
    return "failures"


def places_of(files: Sequence[Path]) -> list[Path]:
    """Return the paths that an export must not overwrite: the recordings, and a run's folders of recordings. A dataset
    next to these folders, such as the run's own, may be replaced.
    """
    folders = dict.fromkeys(file.absolute().parent for file in files)
    return [*(folder for folder in folders if folder.name in ("episodes", "failed")), *files]


def _attempt_order(file: Path) -> tuple[str, bool, str]:
    """Sort key that puts failed attempts at an episode before the successful one."""
    episode, _, attempt = file.stem.partition(".")
    return episode, not attempt, attempt


class Intake:
    """The recordings of one export: selected ones, and counts of those left out.

    Attributes:
        num_taken: Number of selected recordings.
        skipped: Number of recordings left out, by kind.
    """

    def __init__(self, found: Sequence[Path], options: CommonOptions) -> None:
        self.num_taken = 0
        self.skipped: Counter[LeftOut] = Counter()
        self._found = found
        self._options = options
        self._first: tuple[Mapping[str, str], Path] | None = None

    def take(self, path: Path, traits: Mapping[str, str]) -> None:
        """Count a selected recording. Raises ConfigError if its `traits` (`ExportEpisode.traits`) differ from the
        first one's.
        """
        expected, first = self._first = self._first or (traits, path)
        wrong = {name: value for name, value in traits.items() if expected.get(name, value) != value}
        if wrong:
            differences = [f"{name} is {value} instead of {expected[name]}" for name, value in wrong.items()]
            raise ConfigError(
                f"The recording does not fit into one dataset with {first.name}: {'; '.join(differences)}. Export it "
                f"separately: {path}"
            )
        self.num_taken += 1

    def leave_out(self, reason: LeftOut) -> None:
        """Count a recording that is not exported."""
        self.skipped[reason] += 1

    def nothing_to_export(self) -> ConfigError:
        """Return the error for an export without selected recordings."""
        corrected = " or were not corrected" if self._options.corrected_only else ""
        return ConfigError(
            f"Nothing to export. Recordings: {len(self._found)}, failed or unfinished attempts: "
            f"{self.skipped['failures']} (--include-failures selects them); the others are not in "
            f"--episodes{corrected}."
        )
