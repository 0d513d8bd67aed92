"""What a user chooses about an export, whatever its format, and what the export tells at the end."""

from __future__ import annotations

import importlib
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from demorec.core.errors import OptionError, check_option
from demorec.episode.features import ACTION, STATE, ActionKind

ProgressCallback = Callable[[int, int], None]
"""Called after every recording with (how many are done, how many there are)."""


@dataclass(frozen=True, kw_only=True)
class CommonOptions:
    """How recordings become a dataset, whatever its format."""

    episodes: str = ""
    """Which episodes of each run, by their number: 0:100, ::2, 3,5,8:10; all by default."""
    corrected_only: bool = False
    """Of the episodes that a policy began, export only those that the expert corrected (demorec correct);
    demonstrations are all exported."""
    include_failures: bool = False
    """Export failed episodes too; the dataset says of each whether it succeeded."""
    action: ActionKind = "joint"
    """Form of the action: joint (absolute joint targets), joint_increment (their change since the frame before),
    ee (absolute TCP pose), ee_delta (its change). The gripper's opening is always absolute."""
    privileged: bool = False
    """Add observation.environment_state: poses and sizes that no sensor of a real robot gives."""
    features: tuple[str, ...] = ()
    """Features to export, all by default; observation.state, action and what the format itself needs (times, indices)
    are always there. Fewer features make training faster. Simulated episodes have more that must be named: command, and
    sensed values such as observation.effort (docs/dataset-format.md)."""
    depth: bool = False
    """Add depth images of recordings that have depth."""
    fps: int | None = None
    """Frames per second of the dataset; divides that of the recordings, the frames between are left out."""
    hold_images: float = 0.0
    """Of external episodes: seconds for which a frame without an image of a camera shows the camera's last one, as a
    policy would see it; 0: such a frame is an error."""
    overwrite: bool = False
    """Replace an existing dataset; what is no dataset, or holds anything else, is never replaced."""

    def takes(self, feature: str) -> bool:
        """Whether the dataset shall have a feature, if the recordings give it."""
        return not self.features or feature in self.features or feature in (STATE, ACTION)

    def validate(self) -> None:
        """Raise ConfigError for impossible values and combinations."""
        parse_episodes(self.episodes)
        check_option("hold_images", self.hold_images, 0, 3600, "s")
        if self.fps is not None and self.fps < 1:
            raise OptionError("fps", f"is {self.fps}, it must be at least 1.")


@dataclass(frozen=True, kw_only=True)
class ExportReport:
    """What was done.

    Attributes:
        path: Of the dataset.
        num_episodes, num_frames: In the dataset now.
        new_episodes: Added by this export.
        skipped_failures: Failed episodes that were left out.
        skipped_unknown: Episodes that were left out since their recordings end before the outcome.
        skipped_unwanted: Recordings that `episodes` and `corrected_only` left out.
        transcoded: Cameras whose images had to be encoded anew, with the reason.
        left_out: Features that the dataset appended to does not have.
        depth_left_out: Depth cameras of external episodes that were not asked for.
        silent: Recordings of external episodes whose language was asked for, but whose source states no subtask.
        verified_frames: Frames that were compared through LeRobot; 0 when not asked for, or without LeRobot.
        not_verified: Why LeRobot did not verify what was asked for, as a sentence, or "".
        digest: Of the content, as `dataset_digest`.
        url: Where it was uploaded to, or "".
    """

    path: Path
    num_episodes: int
    num_frames: int
    new_episodes: int
    skipped_failures: int = 0
    skipped_unknown: int = 0
    skipped_unwanted: int = 0
    transcoded: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()
    depth_left_out: tuple[str, ...] = ()
    silent: tuple[str, ...] = ()
    verified_frames: int = 0
    not_verified: str = ""
    digest: str = ""
    url: str = ""


def parse_episodes(text: str) -> Callable[[int], bool]:
    """A test of episode numbers from "0:100", "::2", "7" and commas between them; "" takes all.

    Raises:
        OptionError: Something else.
    """
    parts: list[range] = []
    for part in text.split(",") if text.strip() else []:
        match = re.fullmatch(r"\s*(\d*)(?:(:)(\d*)(?::(\d*))?)?\s*", part)
        if match is None or (not match[2] and not match[1]) or match[4] == "0":
            raise OptionError("episodes", f"is {text!r}, expected numbers and ranges such as 0:100, ::2 or 3,5,8:10.")
        first = int(match[1] or 0)
        if not match[2]:
            parts.append(range(first, first + 1))
        else:
            parts.append(range(first, int(match[3]) if match[3] else 2**62, int(match[4] or 1)))
        if not parts[-1]:
            raise OptionError("episodes", f"is {text!r}, but {part.strip()} ends before it begins.")
    if not parts:
        return lambda index: True
    return lambda index: any(index in part for part in parts)


@dataclass(frozen=True, kw_only=True)
class Exporter[O: CommonOptions]:
    """A format that recordings are exported to.

    Its module is loaded for `--help`, so what is heavy is imported when `export` is called.

    Attributes:
        summary: What comes out, in one line.
        options: Its flags; a dataclass with a docstring below each field.
        function: "module:name" of (sources, out, options, progress) -> report. It reads recordings and nothing else,
            takes those that `demorec.datasets.sources` finds, and makes `out` whole or not at all. Raises ConfigError,
            ExportError and RecordingError.
    """

    summary: str
    options: type[O]
    function: str

    def export(self, sources: Sequence[Path], out: Path, options: O, progress: ProgressCallback | None) -> ExportReport:
        """Call it."""
        module, _, name = self.function.partition(":")
        report: ExportReport = getattr(importlib.import_module(module), name)(sources, out, options, progress)
        return report
