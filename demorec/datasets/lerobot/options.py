"""Options of an export to LeRobot."""

from __future__ import annotations

import re
from dataclasses import dataclass, make_dataclass
from pathlib import Path

from demorec.core.errors import ConfigError, OptionError
from demorec.core.extension import ExtraFilesRow, rows_of
from demorec.core.options import Rare
from demorec.datasets.options import CommonOptions, Exporter
from demorec.episode.features import STATE_KINDS, StateKind
from demorec.robots.motors import MotorUnits

KINDS = tuple(dict.fromkeys(["subtask", *(kind for kind, _ in rows_of("statements"))]))
"""Kinds of language: the subtasks that a source specifies, and those that extensions derive."""


@dataclass(frozen=True, kw_only=True)
class ExportOptions(CommonOptions):
    """Options of an export to LeRobot."""

    state: StateKind = "joint"
    """Content of observation.state: joint (joint positions, gripper opening), joint_ee (also the TCP's pose, for
    policies that see only this vector, such as LeRobot's ACT).
    """
    motor_units: Rare[MotorUnits | None] = None
    """For the SO-101: export what lerobot-record writes for the real arm (so101_follower): images, and as state and
    action the joints in degrees, or -100..100 of their ranges (range_m100_100, as LeRobot without use_degrees), and the
    gripper from 0 to 100 (docs/robots.md).
    """
    calibration: Rare[Path | None] = None
    """With --motor-units: LeRobot's calibration file of your arm (auto: an arm that matches its URDF)."""
    language: tuple[str, ...] | None = None
    """Add LeRobot's language columns: statements about the robot's actions."""
    repo_id: str = "local/demorec"
    """Name of the dataset on the Hub, OWNER/NAME; also written into its card."""
    append: bool = False
    """Add the episodes to the existing dataset."""
    intervention: Rare[bool] = False
    """Add the column intervention of LeRobot's DAgger: true where the expert acts in an episode that a policy began."""
    verify: bool = True
    """Open the finished dataset with LeRobot, if installed, and compare samples with the recordings."""
    workers: Rare[int] = 0
    """Processes that read recordings; 0: as many as are useful."""
    push_to_hub: bool = False
    """Upload the dataset to the Hugging Face Hub as --repo-id."""
    public: Rare[bool] = False
    """Make an uploaded dataset public."""
    license: Rare[str | None] = None
    """Licence in the dataset card (auto: apache-2.0 for simulated episodes, none for others)."""

    @property
    def spoken(self) -> tuple[str, ...]:
        """Requested kinds of language."""
        named = self.language
        return () if named is None else tuple(kind for kind in KINDS if not named or kind in named)

    @property
    def extra_files(self) -> tuple[str, ...]:
        """Requested files of extensions, by the name of their flag."""
        return tuple(name for name in _FLAGS if getattr(self, name, False))

    def validate(self) -> None:
        """Raise ConfigError for impossible values and combinations."""
        super().validate()
        if self.append and self.overwrite:
            raise ConfigError("--append and --overwrite exclude each other: choose one.")
        for name in self.extra_files if self.append else ():
            flag = name.replace("_", "-")
            raise ConfigError(f"--{flag} is written for a whole dataset: leave out --append and export it again.")
        if self.workers < 0:
            raise OptionError("workers", f"is {self.workers}, allowed are 0 (as many as are useful) or more.")
        if self.state not in STATE_KINDS:
            raise OptionError("state", f"is {self.state!r}, allowed are {', '.join(STATE_KINDS)}.")
        if self.calibration is not None and self.motor_units is None:
            raise ConfigError("--calibration belongs to --motor-units.")
        if unknown := [kind for kind in self.language or () if kind not in KINDS]:
            raise OptionError("language", f"names {unknown[0]!r}, its kinds are {', '.join(KINDS)}.")
        check_repo_id(self.repo_id)


def check_repo_id(repo_id: str) -> None:
    """Raise ConfigError unless a name is OWNER/NAME for the Hub; LeRobot splits a dataset's name at the slash."""
    word = r"(?!.*(?:--|\.\.))[A-Za-z0-9_](?:[A-Za-z0-9_.-]*[A-Za-z0-9_])?"
    if len(repo_id) > 96 or repo_id.endswith(".git") or not re.fullmatch(f"{word}/{word}", repo_id):
        raise OptionError(
            "repo_id",
            f"is {repo_id!r}, but must be OWNER/NAME, for example me/cubes, of letters, digits and underscores "
            "with single dots and dashes between them.",
        )


_FLAGS: dict[str, ExtraFilesRow] = dict(rows_of("extra_files"))
_HELP = f"""Options of an export to LeRobot, with the flags and kinds of language of extensions.

Attributes:
    language: Add LeRobot's language columns: statements about the robot's actions, derived from the recording. Selected
        kinds ({" ".join(KINDS)}), or all that the recordings support.
""" + "\n".join(f"    {name}: {row.help}" for name, row in _FLAGS.items())
LeRobotOptions: type[ExportOptions] = make_dataclass(
    "LeRobotOptions",
    [(name, Rare[bool], False) for name in _FLAGS],
    bases=(ExportOptions,),
    namespace={"__doc__": _HELP},
    module=__name__,
    frozen=True,
    kw_only=True,
)

LEROBOT = Exporter(
    summary="LeRobot v3.0, a folder: recorded video unchanged, bit-exact numbers, statistics, card",
    options=LeRobotOptions,
    function="demorec.datasets.lerobot.export:export_lerobot",
)
