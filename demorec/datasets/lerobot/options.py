"""What a user chooses about an export to LeRobot."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from demorec.annotate import KINDS, LanguageKind
from demorec.core.errors import ConfigError, OptionError, check_option
from demorec.datasets.options import CommonOptions, Exporter
from demorec.episode.features import STATE_KINDS, StateKind
from demorec.robots.motors import MotorUnits

MIN_FILE_MIB = 1e-6
MAX_FILE_MIB = 1e6
"""Sizes of files: from one byte to a terabyte."""


@dataclass(frozen=True, kw_only=True)
class ExportOptions(CommonOptions):
    """How recordings become a LeRobot dataset."""

    state: StateKind = "joint"
    """What observation.state holds: joint (joint positions, gripper opening), joint_ee (behind them the TCP's pose, for
    policies that look at this vector alone, such as LeRobot's ACT)."""
    motor_units: MotorUnits | None = None
    """Of the SO-101: what lerobot-record writes of the real arm (so101_follower), and nothing else: images, and as
    state and action the joints in degrees, or from -100 to 100 of their ranges (range_m100_100, as LeRobot without
    use_degrees), and the gripper from 0 to 100 (docs/robots.md)."""
    calibration: Path | None = None
    """With --motor-units: the file that LeRobot saved of your arm's servos (auto: an arm that is built as its URDF
    says)."""
    language: tuple[str, ...] | None = None
    """Add LeRobot's language columns: say in words what the robot does, from what was recorded. Named kinds alone
    (subtask plan memory motion task_aug), or all that the recordings support."""
    progress: bool = False
    """Add how far each frame has come (0 to 1) and the stages of the task, where LeRobot's sample weighting and SARM
    look for them."""
    boxes: bool = False
    """Write boxes of what the cameras see beside the dataset, in COCO's format (of recordings with segmentation)."""
    repo_id: str = "local/demorec"
    """Name of the dataset on the Hub, OWNER/NAME; also written into its card."""
    append: bool = False
    """Add the episodes to the dataset that is there already."""
    allow_duplicates: bool = False
    """With --append: add episodes whose content the dataset has already a second time, instead of refusing them."""
    intervention: bool = False
    """Add the column intervention of LeRobot's DAgger: true where the expert acts in an episode that a policy began."""
    verify: bool = True
    """Open the finished dataset with LeRobot, where that is installed, and compare samples with the recordings."""
    workers: int = 0
    """Processes that read recordings; 0: as many as pay."""
    push_to_hub: bool = False
    """Upload the dataset to the Hugging Face Hub as --repo-id."""
    public: bool = False
    """Make an uploaded dataset public."""
    license: str | None = None
    """Licence that the dataset card names (auto: apache-2.0 for simulated episodes, none for others)."""
    data_files_mb: float = 100
    """Size in MiB above which a new parquet file is begun."""
    video_files_mb: float = 200
    """Size in MiB above which a new mp4 file is begun."""
    files_per_chunk: int = 1000
    """How many files a chunk folder holds."""
    transcode_codec: Literal["h264", "av1"] = "h264"
    """Codec of images that cannot be taken as they are (jpeg, or --fps between keyframes)."""
    transcode_crf: int | None = 18
    """Constant rate factor of such images, smaller is better; auto is that of a recording."""

    @property
    def spoken(self) -> tuple[LanguageKind, ...]:
        """The kinds of language to be written."""
        named = self.language
        return () if named is None else tuple(kind for kind in KINDS if not named or kind in named)

    def validate(self) -> None:
        """Raise ConfigError for impossible values and combinations."""
        super().validate()
        if self.append and self.overwrite:
            raise ConfigError("--append and --overwrite exclude each other: choose one.")
        if self.allow_duplicates and not self.append:
            raise ConfigError("--allow-duplicates belongs to --append.")
        if self.append and self.boxes:
            raise ConfigError("--boxes are written for a whole dataset: leave --append out and export all of it anew.")
        if self.workers < 0:
            raise OptionError("workers", f"is {self.workers}, it must be 0 (as many as pay) or more.")
        if self.state not in STATE_KINDS:
            raise OptionError("state", f"is {self.state!r}, allowed are {', '.join(STATE_KINDS)}.")
        if self.calibration is not None and self.motor_units is None:
            raise ConfigError("--calibration belongs to --motor-units.")
        if unknown := [kind for kind in self.language or () if kind not in KINDS]:
            raise OptionError("language", f"names {unknown[0]!r}, its kinds are {', '.join(KINDS)}.")
        check_repo_id(self.repo_id)
        for name in ("data_files_mb", "video_files_mb"):
            check_option(name, getattr(self, name), MIN_FILE_MIB, MAX_FILE_MIB, "MiB")
        check_option("files_per_chunk", self.files_per_chunk, 1, 1_000_000)
        check_option("transcode_crf", self.transcode_crf, 0, 51 if self.transcode_codec == "h264" else 63)


def check_repo_id(repo_id: str) -> None:
    """Raise ConfigError for what cannot be OWNER/NAME on the Hub; LeRobot takes a dataset's name apart at the slash."""
    word = r"(?!.*(?:--|\.\.))[A-Za-z0-9_](?:[A-Za-z0-9_.-]*[A-Za-z0-9_])?"
    if len(repo_id) > 96 or repo_id.endswith(".git") or not re.fullmatch(f"{word}/{word}", repo_id):
        raise OptionError(
            "repo_id",
            f"is {repo_id!r}, but must be OWNER/NAME, for example me/cubes, of letters, digits and underscores "
            "with single dots and dashes between them.",
        )


LEROBOT = Exporter(
    summary="LeRobot v3.0, a folder: recorded video as it is, numbers bit for bit, statistics, card",
    options=ExportOptions,
    function="demorec.datasets.lerobot.export:export_lerobot",
)
