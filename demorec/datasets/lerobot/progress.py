"""Progress and stages where LeRobot's SARM and its sample weighting look for them.

- `sarm_progress.parquet`: `progress_sparse` and `progress_dense` of every row of the dataset, which
  `lerobot-train --sample_weighting.type=rabc` weighs samples by;
- columns `sparse_subtask_names`, `..._start_frames`, `..._end_frames` and the same with `dense_` in the table of
  episodes, which SARM is trained with;
- `meta/temporal_proportions_sparse.json` and `_dense.json`: the stages' mean shares of the time.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from demorec.annotate.progress import (
    WHOLE_TASK,
    StageRun,
    dense_stages,
    progress,
    proportions,
    sparse_runs,
    sparse_stages,
)
from demorec.core.errors import ExportError, in_words
from demorec.datasets.lerobot.files import read_table
from demorec.datasets.staging import sync_file

PROGRESS_PATH = "sarm_progress.parquet"
PROPORTIONS_PATH = "meta/temporal_proportions_{head}.json"

Head = Literal["sparse", "dense"]
_HEADS: tuple[Head, Head] = ("sparse", "dense")
_PARTS = ("subtask_names", "subtask_start_frames", "subtask_end_frames")
STAGE_COLUMNS: dict[str, pa.DataType] = {
    f"{head}_{part}": pa.list_(pa.string() if part == "subtask_names" else pa.int64())
    for head in _HEADS
    for part in _PARTS
}
"""Column of the table of episodes -> its type."""


@dataclass(frozen=True, kw_only=True)
class EpisodeProgress:
    """The stages of one episode.

    Attributes:
        num_goals: Of its scene.
        dense: In order, without gaps.
    """

    num_goals: int
    dense: tuple[StageRun, ...]

    def runs(self, head: Head) -> list[StageRun]:
        """The stages as one of SARM's heads has them."""
        return list(self.dense) if head == "dense" else sparse_runs(self.dense)

    def stages(self, head: Head) -> tuple[str, ...]:
        """All stages that an episode of so many goals has."""
        if self.dense[0].stage == WHOLE_TASK:
            return (WHOLE_TASK,)
        return dense_stages(self.num_goals, self.dense) if head == "dense" else sparse_stages(self.num_goals)

    def row(self) -> dict[str, Any]:
        """Its entries in the table of episodes."""
        row: dict[str, Any] = {}
        for head in _HEADS:
            runs = self.runs(head)
            parts = ([run.stage for run in runs], [run.first for run in runs], [run.last for run in runs])
            row.update({f"{head}_{name}": values for name, values in zip(_PARTS, parts, strict=True)})
        return row

    @classmethod
    def from_row(cls, row: Mapping[str, Any], num_goals: int) -> EpisodeProgress:
        """Inverse of `row`; ValueError, TypeError or KeyError for what is none."""
        names, starts, ends = (row[f"dense_{part}"] for part in _PARTS)
        runs = tuple(
            StageRun(stage=str(name), first=int(first), last=int(last))
            for name, first, last in zip(names, starts, ends, strict=True)
        )
        if not runs or runs[0].first != 0 or any(b.first != a.last + 1 for a, b in pairwise(runs)):
            raise ValueError("stages that leave gaps")
        return cls(num_goals=num_goals, dense=runs)


def read_progress(root: Path) -> list[EpisodeProgress]:
    """The stages of every episode of a dataset that has them, in order.

    Raises:
        ExportError: They cannot be read.
    """
    found = []
    try:
        for path in sorted((root / "meta" / "episodes").glob("*/*.parquet")):
            for row in read_table(path, [*STAGE_COLUMNS, "num_goals"]).to_pylist():
                found.append(EpisodeProgress.from_row(row, int(row["num_goals"])))
    except (ValueError, TypeError, KeyError) as error:
        raise ExportError(f"The stages of the dataset's episodes cannot be used ({in_words(error)}): {root}") from error
    return found


def progress_table(episodes: Sequence[EpisodeProgress]) -> pa.Table:
    """`index`, `episode_index`, `frame_index`, `progress_sparse`, `progress_dense` (0..1) of every row."""
    lengths = [episode.dense[-1].last + 1 for episode in episodes]
    columns: dict[str, Any] = {
        "index": np.arange(sum(lengths)),
        "episode_index": np.repeat(np.arange(len(lengths)), lengths),
        "frame_index": np.concatenate([np.arange(length) for length in lengths]),
    }
    for head in _HEADS:
        share = proportions([episode.runs(head) for episode in episodes], _all_stages(episodes, head))
        parts = [progress(episode.runs(head), episode.stages(head), share) for episode in episodes]
        columns[f"progress_{head}"] = np.concatenate(parts).astype(np.float32)
    return pa.table(columns)


def write_progress(root: Path, episodes: Sequence[EpisodeProgress]) -> None:
    """Write the files of the whole dataset, durably."""
    path = root / PROGRESS_PATH
    pq.write_table(progress_table(episodes), path, use_dictionary=["episode_index"])
    sync_file(path)
    for head in _HEADS:
        stages = _all_stages(episodes, head)
        share = proportions([episode.runs(head) for episode in episodes], stages)
        file = root / PROPORTIONS_PATH.format(head=head)
        file.write_text(json.dumps(share, indent=2) + "\n")
        sync_file(file)


def _all_stages(episodes: Sequence[EpisodeProgress], head: Head) -> tuple[str, ...]:
    """The stages of the episode that has most, and of those whose phases nobody knows."""
    return tuple(dict.fromkeys(stage for episode in episodes for stage in episode.stages(head)))
