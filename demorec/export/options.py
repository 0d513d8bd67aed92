"""What a user chooses about an export, to any format and to LeRobot's, and what an export tells at the end."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from demorec.config import VideoConfig
from demorec.errors import ConfigError
from demorec.export.exporter import Exporter
from demorec.features import ACTION, STATE, ActionKind

Progress = Callable[[int, int], None]
"""Called after every recording with (how many are done, how many there are)."""


@dataclass(frozen=True, kw_only=True)
class CommonOptions:
    """How recordings become a dataset, whatever its format."""

    episodes: str = ""
    """Which episodes of each run, by their number: 0:100, ::2, 3,5,8:10; all by default."""
    include_failures: bool = False
    """Export failed episodes too; the dataset says of each whether it succeeded."""
    action: ActionKind = "joint"
    """Form of the action: joint (absolute joint targets), joint_increment (their change since the frame before),
    ee (absolute TCP pose), ee_delta (its change). The gripper's opening is always absolute."""
    privileged: bool = False
    """Add observation.environment_state: poses and sizes that no sensor of a real robot gives."""
    features: tuple[str, ...] = ()
    """Names of the features to have, the others are left out; all by default. observation.state, action and what the
    format itself needs (times, indices) stay whatever is named. Fewer features make training faster."""
    depth: bool = False
    """Add depth pictures of recordings that have depth: LeRobot's 12-bit videos, or float32 metres in HDF5."""
    fps: int | None = None
    """Frames per second of the dataset; divides that of the recordings, the frames between are left out."""
    overwrite: bool = False
    """Replace the dataset that is there already; anything else than a dataset, or with anything else in it, is not."""

    def takes(self, feature: str) -> bool:
        """Whether the dataset shall have a feature, if the recordings give it."""
        return not self.features or feature in self.features or feature in (STATE, ACTION)

    def validate(self) -> None:
        """Raise ConfigError for impossible values and combinations."""
        parse_episodes(self.episodes)
        if self.fps is not None and self.fps < 1:
            raise ConfigError(f"fps is {self.fps}, it must be at least 1.")


@dataclass(frozen=True, kw_only=True)
class ExportOptions(CommonOptions):
    """How recordings become a LeRobot dataset."""

    repo_id: str = "local/demorec"
    """Name of the dataset on the Hub, OWNER/NAME; also written into its card."""
    append: bool = False
    """Add the episodes to the dataset that is there already."""
    allow_duplicates: bool = False
    """With --append: add episodes whose content the dataset has already a second time, instead of refusing them."""
    verify: bool = True
    """Open the finished dataset with LeRobot, where that is installed, and compare samples with the recordings."""
    workers: int = 0
    """Processes that read recordings; 0: as many as pay."""
    push_to_hub: bool = False
    """Upload the dataset to the Hugging Face Hub as --repo-id."""
    public: bool = False
    """Make an uploaded dataset public."""
    license: str = "apache-2.0"
    """Licence that the dataset card names."""
    data_files_mb: float = 100
    """Size in MiB above which a new parquet file is begun."""
    video_files_mb: float = 200
    """Size in MiB above which a new mp4 file is begun."""
    files_per_chunk: int = 1000
    """How many files a chunk folder holds."""
    transcode_codec: Literal["h264", "av1"] = "h264"
    """Codec of pictures that cannot be taken as they are (jpeg, or --fps between keyframes)."""
    transcode_crf: int | None = 18
    """Constant rate factor of such pictures, smaller is better; auto is that of a recording."""

    @property
    def transcode(self) -> VideoConfig:
        """How pictures are coded that cannot be taken as they are."""
        return VideoConfig(codec=self.transcode_codec, crf=self.transcode_crf)

    def validate(self) -> None:
        """Raise ConfigError for impossible values and combinations."""
        super().validate()
        if self.append and self.overwrite:
            raise ConfigError("--append and --overwrite exclude each other: choose one.")
        if self.allow_duplicates and not self.append:
            raise ConfigError("--allow-duplicates belongs to --append.")
        if self.workers < 0:
            raise ConfigError(f"workers is {self.workers}, it must be 0 (as many as pay) or more.")
        check_repo_id(self.repo_id)
        if self.data_files_mb <= 0 or self.video_files_mb <= 0 or self.files_per_chunk < 1:
            raise ConfigError("data-files-mb, video-files-mb and files-per-chunk must be above 0.")
        self.transcode.validate()


def check_repo_id(repo_id: str) -> None:
    """Raise ConfigError for what cannot be OWNER/NAME on the Hub; LeRobot takes a dataset's name apart at the slash."""
    word = r"(?!.*(?:--|\.\.))[A-Za-z0-9_](?:[A-Za-z0-9_.-]*[A-Za-z0-9_])?"
    if len(repo_id) > 96 or repo_id.endswith(".git") or not re.fullmatch(f"{word}/{word}", repo_id):
        raise ConfigError(
            f"repo-id is {repo_id!r}, but must be OWNER/NAME, for example me/cubes, of letters, digits and underscores "
            "with single dots and dashes between them."
        )


@dataclass(frozen=True, kw_only=True)
class ExportReport:
    """What was done.

    Attributes:
        path: Of the dataset.
        num_episodes, num_frames: In the dataset now.
        new_episodes, new_frames: Added by this export.
        skipped_failures: Failed episodes that were left out.
        transcoded: Cameras whose pictures had to be coded anew, with the reason.
        left_out: Features that the dataset appended to does not have.
        verified_frames: Frames that were compared through LeRobot; 0 when not asked for, or without LeRobot.
        not_verified: Why LeRobot did not verify what was asked for, as a sentence, or "".
        digest: Of the content, as `dataset_digest`.
        url: Where it was uploaded to, or "".
    """

    path: Path
    num_episodes: int
    num_frames: int
    new_episodes: int
    new_frames: int
    skipped_failures: int = 0
    transcoded: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()
    verified_frames: int = 0
    not_verified: str = ""
    digest: str = ""
    url: str = ""


def parse_episodes(text: str) -> Callable[[int], bool]:
    """A test of episode numbers from "0:100", "::2", "7" and commas between them; "" takes all.

    Raises:
        ConfigError: Something else.
    """
    parts: list[range] = []
    for part in text.split(",") if text.strip() else []:
        match = re.fullmatch(r"\s*(\d*)(?:(:)(\d*)(?::(\d*))?)?\s*", part)
        if match is None or (not match[2] and not match[1]) or match[4] == "0":
            raise ConfigError(f"episodes is {text!r}, expected numbers and ranges such as 0:100, ::2 or 3,5,8:10.")
        first = int(match[1] or 0)
        if not match[2]:
            parts.append(range(first, first + 1))
        else:
            parts.append(range(first, int(match[3]) if match[3] else 2**62, int(match[4] or 1)))
        if not parts[-1]:
            raise ConfigError(f"episodes is {text!r}, but {part.strip()} ends before it begins.")
    if not parts:
        return lambda index: True
    return lambda index: any(index in part for part in parts)


def _export(sources: Sequence[Path], out: Path, options: ExportOptions, progress: Progress | None) -> ExportReport:
    from demorec.export.lerobot import export_lerobot

    return export_lerobot(sources, out, options, progress)


LEROBOT = Exporter(
    summary="LeRobot v3.0, a folder: recorded video as it is, numbers bit for bit, statistics, card",
    options=ExportOptions,
    export=_export,
)
