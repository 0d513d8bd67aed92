"""Options of an export to any format, and its report."""

from __future__ import annotations

import importlib
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from demorec.core.errors import ConfigError, OptionError
from demorec.core.options import Rare
from demorec.episode.features import ACTION, STATE, ActionKind

ProgressCallback = Callable[[int, int], None]
"""Called after every recording with (number finished, total)."""


@dataclass(frozen=True, kw_only=True)
class CommonOptions:
    """Options of an export to any format."""

    episodes: str = ""
    """Episodes of each run to export, by number: 0:100, ::2, 3,5,8:10; all by default."""
    corrected_only: Rare[bool] = False
    """Among episodes that a policy began, export only those that the expert corrected (demorec correct); demonstrations
    are always exported.
    """
    include_failures: bool = False
    """Export failed episodes too; the dataset records each one's success."""
    action: ActionKind = "joint"
    """Form of the action: joint (absolute joint targets), joint_increment (change since the previous frame), ee
    (absolute TCP pose), ee_delta (its change). The gripper's opening is always absolute.
    """
    privileged: bool = False
    """Add observation.environment_state: poses and sizes that no real robot senses."""
    features: tuple[str, ...] = ()
    """Features to export, all by default; observation.state, action and the format's own columns (times, indices) are
    always included. Fewer features make training faster. Simulated episodes have optional ones: command, and sensor
    values such as observation.effort (docs/dataset-format.md).
    """
    depth: Rare[bool] = False
    """Add depth images if the recordings have them."""
    overwrite: bool = False
    """Replace an existing dataset; a folder with any other content is never replaced."""

    def takes(self, feature: str) -> bool:
        """Whether the dataset includes a feature, if the recordings have it."""
        return not self.features or feature in self.features or feature in (STATE, ACTION)

    def validate(self) -> None:
        """Raise ConfigError for impossible values and combinations."""
        parse_episodes(self.episodes)


@dataclass(frozen=True, kw_only=True)
class ExportReport:
    """Result of an export.

    Attributes:
        path: Path of the dataset.
        num_episodes, num_frames: Current size of the dataset.
        new_episodes: Episodes added by this export.
        skipped_failures: Episodes left out because they failed, or their recordings have no outcome.
        skipped_unwanted: Recordings left out by `episodes` and `corrected_only`.
        transcoded: Cameras with re-encoded images, and the reason.
        left_out: Features missing from the dataset that was appended to.
        depth_left_out: Depth cameras of external episodes that were not requested.
        verified_frames: Frames compared through LeRobot; 0 if not requested, or without LeRobot.
        not_verified: Reason why LeRobot did not verify the dataset although requested, as a sentence, or "".
        digest: Content digest, as in `dataset_digest`.
        url: Upload URL, or "".
    """

    path: Path
    num_episodes: int
    num_frames: int
    new_episodes: int
    skipped_failures: int = 0
    skipped_unwanted: int = 0
    transcoded: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()
    depth_left_out: tuple[str, ...] = ()
    verified_frames: int = 0
    not_verified: str = ""
    digest: str = ""
    url: str = ""


_OPEN_END = 2**62


def parse_episodes(text: str) -> Callable[[int], bool]:
    """Parse "0:100", "::2", "7" and lists of them into a test of episode numbers; "" accepts all. Raises OptionError
    for invalid text.
    """
    parts = _ranges(text, "episodes")
    return lambda index: not parts or any(index in part for _, part in parts)


def select_episodes[E](episodes: Sequence[E], text: str, option: str = "episodes") -> list[E]:
    """Select episodes, numbered from 0, by a list as in `parse_episodes` and in its order; "" for all. Raises
    ConfigError for invalid text, or numbers out of range.
    """
    chosen: list[E] = []
    for word, part in _ranges(text, option):
        numbers = range(part.start, len(episodes) if part.stop == _OPEN_END else part.stop, part.step)
        if not numbers or numbers[-1] >= len(episodes):
            raise ConfigError(f"--{option} {word} is out of range: choose from 0 to {len(episodes) - 1}.")
        chosen += [episodes[number] for number in numbers]
    return chosen if text.strip() else list(episodes)


def _ranges(text: str, option: str) -> list[tuple[str, range]]:
    """Split a list at commas and spaces into its words and their numbers; an open end is `_OPEN_END`."""
    found = []
    for word in text.replace(",", " ").split():
        match = re.fullmatch(r"(\d*)(?:(:)(\d*)(?::(\d*))?)?", word)
        if match is None or (not match[2] and not match[1]) or match[4] == "0":
            raise OptionError(option, f"is {text!r}, expected numbers and ranges such as 0:100, ::2 or 3,5,8:10.")
        first = int(match[1] or 0)
        last = int(match[3] or _OPEN_END) if match[2] else first + 1
        part = range(first, last, int(match[4] or 1))
        if not part:
            raise OptionError(option, f"is {text!r}, but {word} ends before it begins.")
        found.append((word, part))
    return found


@dataclass(frozen=True, kw_only=True)
class Exporter[O: CommonOptions]:
    """A format for exporting recordings.

    Its module is loaded for `--help`, so heavy imports wait until `export` is called.

    Attributes:
        summary: Result in one line.
        options: Its flags; a dataclass with a docstring for each field.
        function: "module:name" of (sources, out, options, progress) -> report. It reads only recordings, those that
        `demorec.datasets.sources` finds, and writes `out` atomically. Raises ConfigError,
            ExportError and RecordingError.
    """

    summary: str
    options: type[O]
    function: str

    def export(self, sources: Sequence[Path], out: Path, options: O, progress: ProgressCallback | None) -> ExportReport:
        """Run the export."""
        module, _, name = self.function.partition(":")
        report: ExportReport = getattr(importlib.import_module(module), name)(sources, out, options, progress)
        return report
