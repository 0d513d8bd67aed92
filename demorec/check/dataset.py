"""A LeRobot dataset for its checks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from numpy.typing import NDArray

from demorec.core.errors import ConfigError, ExportError
from demorec.datasets.lerobot.episode_places import EpisodePlace
from demorec.datasets.lerobot.folder import LeRobotFolder
from demorec.datasets.lerobot.inspect import noted, recorded_info
from demorec.datasets.lerobot.sidecar import EPISODE_SCHEMA
from demorec.episode.info import EpisodeInfo

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


class CheckedDataset(LeRobotFolder):
    """An open dataset with its rows and its sidecar in memory."""

    @property
    def numbers(self) -> Mapping[int, Rows]:
        """Episode number -> feature -> (T, D), for the episodes with readable rows."""
        return self._rows_and_errors[0]

    @property
    def unreadable(self) -> Mapping[int, str]:
        """Episode number -> reason why its rows cannot be read."""
        return self._rows_and_errors[1]

    @cached_property
    def _rows_and_errors(self) -> tuple[dict[int, Rows], dict[int, str]]:
        reader = self.rows(self.columns)
        rows: dict[int, Rows] = {}
        errors: dict[int, str] = {}
        for number, place in enumerate(self.listed):
            problems: list[str] = []
            with noted(problems, self.root):
                rows[number] = self._usable(place, reader.numbers(place))
            if problems:
                errors[number] = problems[0]
        return rows, errors

    def _usable(self, place: EpisodePlace, rows: Rows) -> Rows:
        if place.length == 0:
            raise ExportError(f"Episode {place.episode_index} has no frames: {self.root}")
        for name, values in rows.items():
            if self.info.features[name].dtype in ("int64", "bool") and values.dtype.kind not in "iub":
                raise ExportError(f"Episode {place.episode_index} lacks values of {name}: {self.root}")
        return rows

    @cached_property
    def records(self) -> list[dict[str, Any]]:
        """The sidecar's rows for the episodes; empty for a dataset of another writer."""
        return self.sidecar([name for name in EPISODE_SCHEMA.names if name != "episode_index"])

    def check_simulated(self) -> None:
        """Raise ConfigError for a dataset of external episodes, which cannot be simulated or replayed."""
        if any(row["episode_info"] is None for row in self.records):
            raise ConfigError(
                f"The episodes of this dataset were recorded by another robot or program and have no scene: {self.root}"
            )

    def described(self) -> list[DescribedEpisode]:
        """Simulated episodes that the sidecar describes, in order; LeRobot's `resume` adds episodes without a
        description.
        """
        found = []
        for row in self.records:
            number = row["episode_index"]
            if row["episode_info"] is None or number not in self.numbers:
                continue
            info = recorded_info(row, self.root)
            found.append(DescribedEpisode(number=number, rows=self.numbers[number], kept=row, info=info))
        return sorted(found, key=lambda episode: episode.number)
