"""The attempts that stand beside a dataset, by the episode to which each belongs."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa

from demorec.datasets.lerobot.files import read_table
from demorec.datasets.lerobot.paths import SIDECAR_DIR
from demorec.datasets.lerobot.sidecar import ATTEMPT_SCHEMA

Row = dict[str, Any]


class Attempts:
    """Those of one dataset.

    Args:
        root: Its folder.
        episodes: `episode_index` of those of which demorec keeps something, in order.
    """

    def __init__(self, root: Path, episodes: Sequence[int]) -> None:
        paths = sorted((root / SIDECAR_DIR / "attempts").glob("*/*.parquet"))
        tables = [read_table(path, ATTEMPT_SCHEMA.names, schema=ATTEMPT_SCHEMA) for path in paths]
        self._table = pa.concat_tables(tables or [ATTEMPT_SCHEMA.empty_table()]).combine_chunks()
        is_inside = self._table.column("in_dataset").to_pylist()
        inside = [number for number, value in enumerate(is_inside) if value]
        # One row was written for every episode, in order.
        owners = dict(zip(inside, episodes, strict=True)) if len(inside) == len(episodes) else {}
        self._own = {episode: number for number, episode in owners.items()}
        self._failed: dict[int, list[int]] = {}
        self._homeless: list[int] = []
        indices = self._table.column("run_episode_index").to_pylist()
        same: dict[int | None, list[int]] = {}
        for number in owners:
            same.setdefault(indices[number], []).append(number)
        for number, value in enumerate(is_inside):
            if value:
                continue
            # Several runs may have an episode of that number: the rows of one run stand together.
            if others := same.get(indices[number]):
                place = bisect_left(others, number)
                nearest = min(others[max(place - 1, 0) : place + 1], key=lambda n: abs(n - number))
                self._failed.setdefault(owners[nearest], []).append(number)
            else:
                self._homeless.append(number)

    def _rows(self, numbers: Sequence[int]) -> list[Row]:
        found = [row for number in numbers for row in self._table.slice(number, 1).to_pylist()]
        return [{name: value for name, value in row.items() if name != "in_dataset"} for row in found]

    def of(self, episode_index: int) -> Row | None:
        """The one that became an episode of the dataset."""
        number = self._own.get(episode_index)
        return None if number is None else self._rows([number])[0]

    def failed(self, episode_index: int) -> list[Row]:
        """Those before it that failed."""
        return self._rows(self._failed.get(episode_index, []))

    def homeless(self) -> list[Row]:
        """Failed ones at episodes that the dataset has not."""
        return self._rows(self._homeless)

    def num_failed(self, episode_index: int) -> int:
        """How many failed before an episode."""
        return len(self._failed.get(episode_index, []))

    @property
    def num_homeless(self) -> int:
        """How many failed at episodes that the dataset has not."""
        return len(self._homeless)
