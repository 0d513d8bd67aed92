"""A LeRobot dataset for its checks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

from numpy.typing import NDArray

from demorec.check.base import Form
from demorec.core.errors import ConfigError, ExportError
from demorec.datasets.lerobot.episode_table import EpisodePlace
from demorec.datasets.lerobot.folder import LeRobotFolder
from demorec.datasets.lerobot.inspect import noted, recorded_info
from demorec.datasets.lerobot.layout import DatasetInfo
from demorec.datasets.lerobot.sidecar import EPISODE_SCHEMA
from demorec.episode.info import EpisodeInfo
from demorec.episode.roles import NO_NAMES, NamedRoles, Roles
from demorec.robots.motors import Motors

Rows = Mapping[str, NDArray[Any]]


@dataclass(frozen=True, kw_only=True, eq=False)
class DescribedEpisode:
    """A simulated episode of a dataset, with its row of the sidecar.

    Attributes:
        number: Its `episode_index`.
        rows: Feature -> (T, D).
        kept: Its row of the sidecar.
        info: Metadata known before its first frame.
    """

    number: int
    rows: Rows
    kept: dict[str, Any]
    info: EpisodeInfo


class CheckedDataset:
    """A LeRobot dataset, opened for its checks; properties raise ExportError for missing data.

    Args:
        path: Its folder.
        motors: Servos whose values are the state and action, if the user names them.
        named: Features whose role the user names.
    """

    form: ClassVar[Form] = "dataset"

    def __init__(self, path: Path, motors: Motors | None = None, named: NamedRoles = NO_NAMES) -> None:
        self.path = path
        self.motors = motors
        self.named = named

    @cached_property
    def folder(self) -> LeRobotFolder:
        """The open dataset."""
        return LeRobotFolder(self.path, named=self.named)

    @property
    def roles(self) -> Roles:
        """The role of each feature."""
        return self.folder.roles

    @property
    def info(self) -> DatasetInfo:
        """meta/info.json."""
        return self.folder.info

    @property
    def rows(self) -> Mapping[int, Rows]:
        """Episode number -> feature -> (T, D), for the episodes with readable rows."""
        return self._rows_and_errors[0]

    @property
    def unreadable(self) -> Mapping[int, str]:
        """Episode number -> reason why its rows cannot be read."""
        return self._rows_and_errors[1]

    @cached_property
    def _rows_and_errors(self) -> tuple[dict[int, Rows], dict[int, str]]:
        reader = self.folder.rows(self.folder.columns)
        rows: dict[int, Rows] = {}
        errors: dict[int, str] = {}
        for number, place in enumerate(self.folder.listed):
            problems: list[str] = []
            with noted(problems, self.path):
                rows[number] = self._usable(place, reader.numbers(place))
            if problems:
                errors[number] = problems[0]
        return rows, errors

    def _usable(self, place: EpisodePlace, rows: Rows) -> Rows:
        if place.length == 0:
            raise ExportError(f"Episode {place.episode_index} has no frames: {self.path}")
        for name, values in rows.items():
            if self.info.features[name].dtype in ("int64", "bool") and values.dtype.kind not in "iub":
                raise ExportError(f"Episode {place.episode_index} lacks values of {name}: {self.path}")
        return rows

    @cached_property
    def sidecar(self) -> list[dict[str, Any]]:
        """The sidecar's rows for the episodes; empty for a dataset of another writer."""
        return self.folder.sidecar([name for name in EPISODE_SCHEMA.names if name != "episode_index"])

    def check_simulated(self) -> None:
        """Raise ConfigError for a dataset of external episodes, which cannot be simulated or replayed."""
        if any(row["episode_info"] is None for row in self.sidecar):
            raise ConfigError(
                f"The episodes of this dataset were recorded by another robot or program and have no scene: {self.path}"
            )

    def described(self) -> list[DescribedEpisode]:
        """Simulated episodes that the sidecar describes, in order; LeRobot's `resume` adds episodes without a
        description.
        """
        found = []
        for row in self.sidecar:
            number = row["episode_index"]
            if row["episode_info"] is None or number not in self.rows:
                continue
            info = recorded_info(row, self.path)
            found.append(DescribedEpisode(number=number, rows=self.rows[number], kept=row, info=info))
        return sorted(found, key=lambda episode: episode.number)
