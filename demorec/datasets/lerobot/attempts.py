"""Attempts of a run at its episodes, as the sidecar of its dataset lists them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa

from demorec.datasets.lerobot.files import read_table
from demorec.datasets.lerobot.sidecar import ATTEMPT_SCHEMA


class Attempts:
    """The attempts, by the episode to which each belongs.

    Args:
        paths: Tables of the sidecar.

    Raises:
        ExportError: A table cannot be read.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        tables = [read_table(path, ATTEMPT_SCHEMA.names, schema=ATTEMPT_SCHEMA) for path in paths]
        self._table = pa.concat_tables(tables or [ATTEMPT_SCHEMA.empty_table()]).combine_chunks()
        self._own: dict[int, int] = {}
        self._failed: dict[int, list[int]] = {}
        self._homeless: list[int] = []
        run_indices = self._table.column("run_episode_index").to_pylist()
        waiting: list[int] = []
        for number, episode in enumerate(self._table.column("episode_index").to_pylist()):
            if episode is None:
                waiting.append(number)
                continue
            self._own[episode] = number
            self._failed[episode] = [n for n in waiting if run_indices[n] == run_indices[number]]
            self._homeless += [n for n in waiting if run_indices[n] != run_indices[number]]
            waiting = []
        self._homeless += waiting

    def _rows(self, numbers: Sequence[int]) -> list[dict[str, Any]]:
        return [row for number in numbers for row in self._table.slice(number, 1).to_pylist()]

    def of(self, episode_index: int) -> dict[str, Any] | None:
        """Return the attempt that became an episode of the dataset."""
        number = self._own.get(episode_index)
        return None if number is None else self._rows([number])[0]

    def failed(self, episode_index: int) -> list[dict[str, Any]]:
        """Return the failed attempts before an episode."""
        return self._rows(self._failed.get(episode_index, []))

    def failures(self) -> list[dict[str, Any]]:
        """Return all attempts that are not in the dataset."""
        episodes = self._table.column("episode_index").to_pylist()
        return self._rows([number for number, episode in enumerate(episodes) if episode is None])

    def homeless(self) -> list[dict[str, Any]]:
        """Return the failed attempts at episodes that the dataset does not have."""
        return self._rows(self._homeless)
