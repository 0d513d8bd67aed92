"""Which recordings go into a dataset, and whether they go together."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from demorec.core.errors import ConfigError
from demorec.core.plain import listed
from demorec.datasets.episode import ExportEpisode
from demorec.datasets.options import CommonOptions, parse_episodes
from demorec.episode.episode import POLICY_PHASE, Outcome, interventions
from demorec.mcap import Recording, open_recording
from demorec.runs.find import EPISODE_FOLDERS, expect, expect_recordings


def find_recordings(paths: Sequence[Path]) -> list[Path]:
    """The recordings in the given files, runs (folders with episodes/) and folders of recordings, in order; those of
    failed attempts, too.

    Raises:
        ConfigError: A path is missing, holds no recording, or the same recording is given twice.
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


def is_wanted(recording: Recording, options: CommonOptions) -> bool:
    """Whether its episode is one of those that the options ask for (`--episodes`, `--corrected-only`).

    Raises:
        RecordingError: It is damaged.
    """
    if not parse_episodes(options.episodes)(recording.info.episode_index):
        return False
    if not options.corrected_only:
        return True
    phases = recording.phases
    return POLICY_PHASE not in phases or bool(interventions(phases).any())


def goes_in(recording: Recording, options: CommonOptions) -> bool:
    """Whether a recording of a wanted episode goes into the dataset, and is no failed attempt to be left out.

    An external episode of which nobody said whether it succeeded is no failure; whoever moved a recording into
    `failed` wants it left out, whatever it says.
    """
    return options.include_failures or not (recording.has_failed or recording.path.parent.name == "failed")


def places_of(files: Sequence[Path]) -> list[Path]:
    """What an export must not write over: the recordings, and a run's folders of them with all that is in there.

    A dataset that lies beside them, as a run's own does, may be replaced.
    """
    folders = dict.fromkeys(file.absolute().parent for file in files)
    return [*(folder for folder in folders if folder.name in ("episodes", "failed")), *files]


def _attempt_order(file: Path) -> tuple[str, bool, str]:
    """Failed attempts at an episode before the one that succeeded."""
    episode, _, attempt = file.stem.partition(".")
    return episode, not attempt, attempt


class Intake:
    """What goes into one dataset: recordings that go together, and the count of failed attempts that are left out.

    Args:
        found: All recordings of the export.
        options: Its options.

    Attributes:
        skipped_failures: Failed attempts that were left out so far.
        skipped_unknown: Recordings that were left out since they end before their outcome.
        num_taken: Recordings that go in.
    """

    def __init__(self, found: Sequence[Path], options: CommonOptions) -> None:
        self.skipped_failures = self.skipped_unknown = self.num_taken = 0
        self._found = found
        self._options = options
        self._first: tuple[Mapping[str, str], Path] | None = None

    def take(self, path: Path, traits: Mapping[str, str]) -> None:
        """Note a recording that goes in, and what it must have in common with the others (`ExportEpisode.traits`).

        Raises:
            ConfigError: It does not go together with the first one.
        """
        if self._first is None:
            self._first = traits, path
        elif traits != self._first[0]:
            _refuse_differences(*self._first, self._found, self._options)
        self.num_taken += 1

    def leave_out(self, outcome: Outcome | None) -> None:
        """Note a failed attempt, or one of unknown outcome, that only counts for the success rate."""
        if outcome is None:
            self.skipped_unknown += 1
        else:
            self.skipped_failures += 1

    @property
    def skipped_unwanted(self) -> int:
        """Recordings that the options do not ask for; known once all have been read."""
        return len(self._found) - self.num_taken - self.skipped_failures - self.skipped_unknown

    def check(self) -> None:
        """Raise ConfigError when not one recording has gone in."""
        if self._first is None:
            corrected = " or were not corrected" if self._options.corrected_only else ""
            raise ConfigError(
                f"Nothing to export. Recordings: {len(self._found)}, of failed attempts: {self.skipped_failures}, "
                f"of unknown outcome: {self.skipped_unknown} (--include-failures takes both); the others are not among "
                f"the wanted --episodes{corrected}."
            )


def _refuse_differences(
    traits: Mapping[str, str], reference: Path, files: Iterable[Path], options: CommonOptions
) -> None:
    """Raise ConfigError with every difference between the reference and any of the recordings that go in.

    Called only when one is known to differ: then all headers are read, so that the user hears of everything at once.
    """
    files_by_difference: dict[str, list[str]] = {}
    for file in files:
        with open_recording(file) as recording:
            if is_wanted(recording, options) and goes_in(recording, options):
                for what, value in ExportEpisode(recording, options).traits():
                    if traits.get(what, value) != value:
                        difference = f"{what} is {value} instead of {traits[what]}"
                        files_by_difference.setdefault(difference, []).append(file.name)
    if files_by_difference:
        differences = "; ".join(
            f"{difference} ({listed(files, 3, ', ')})" for difference, files in files_by_difference.items()
        )
        raise ConfigError(
            f"These recordings do not go into one dataset with {reference.name}: {differences}. Export them separately."
        )
