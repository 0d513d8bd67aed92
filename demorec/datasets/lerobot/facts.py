"""Facts about each episode in LeRobot's places: columns to filter by, and progress.

Facts are columns of the table that LeRobot filters episodes by (`episode_filter`). The first episode decides which
columns exist, because all files of the table must share them; an episode without a value has null. Progress is the
column `progress_dense` of `sarm_progress.parquet` for every row of the dataset, by which
`lerobot-train --sample_weighting.type=rabc --sample_weighting.head_mode=dense` weights samples.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from demorec.annotate.timeline import StageRun, dense_runs, dense_stages, episode_timeline, progress, proportions
from demorec.datasets.lerobot.files import open_table

if TYPE_CHECKING:
    from demorec.mcap import Recording

PROGRESS_PATH = "sarm_progress.parquet"


class EpisodeStages(NamedTuple):
    """Stages of an episode of the dataset: those of its rows, and all stages of its task in order."""

    runs: Sequence[StageRun]
    possible: Sequence[str]


def episode_stages(recording: Recording, rows: NDArray[np.intp]) -> EpisodeStages:
    """Return the stages of a simulated episode, whose (T,) recorded frames `rows` are in the dataset."""
    runs = dense_runs(episode_timeline(recording), rows)
    return EpisodeStages(runs, dense_stages(len(recording.info.simulated.scene.goals), runs))


def write_progress(root: Path, episodes: Sequence[EpisodeStages]) -> None:
    """Write the file of progress for all episodes of a new dataset."""
    stages = dict.fromkeys(chain.from_iterable(episode.possible for episode in episodes))
    shares = proportions([episode.runs for episode in episodes], tuple(stages))
    parts = [progress(episode.runs, episode.possible, shares) for episode in episodes]
    lengths = [len(part) for part in parts]
    columns = {
        "index": np.arange(sum(lengths)),
        "episode_index": np.repeat(np.arange(len(lengths)), lengths),
        "frame_index": np.concatenate([np.arange(length) for length in lengths]),
        "progress_dense": np.concatenate(parts).astype(np.float32),
    }
    pq.write_table(pa.table(columns), root / PROGRESS_PATH, use_dictionary=["episode_index"])


FACTS: Mapping[str, pa.DataType] = {
    "success": pa.bool_(),
    "failure_phase": pa.string(),
    "failure_reason": pa.string(),
    "num_retries": pa.int64(),
    "has_deliberate_miss": pa.bool_(),
    "duration_s": pa.float64(),
    "task_name": pa.string(),
    "split": pa.string(),
    "variation": pa.string(),
    "seed": pa.uint64(),
    "run_episode_index": pa.int64(),
    "attempt": pa.int64(),
    "num_goals": pa.int64(),
}
"""Column of a simulated episode in the table of episodes -> its type."""
_LEROBOT_COLUMN = re.compile(
    r"(episode_index|tasks|length|dataset_from_index|dataset_to_index)$|(stats|videos|data|meta)/"
)


def fact_columns(tables: Sequence[Path]) -> dict[str, pa.DataType]:
    """Return column -> type for columns of the table of episodes beyond LeRobot's own. Raises ExportError if the table
    is damaged.
    """
    schema = open_table(tables[0]).schema_arrow if tables else ()
    return {item.name: item.type for item in schema if not _LEROBOT_COLUMN.match(item.name)}


def episode_facts(recording: Recording) -> dict[str, Any]:
    """Return the value of each of `FACTS` for an episode with a scene."""
    info, outcome, simulation = recording.info, recording.outcome, recording.info.simulated
    return {
        "success": outcome is not None and outcome.success,
        "failure_phase": "" if outcome is None else outcome.failure_phase,
        "failure_reason": "interrupted" if outcome is None else outcome.failure_reason,
        "num_retries": 0 if outcome is None else outcome.num_retries,
        "has_deliberate_miss": bool(recording.trajectory().is_deliberate_miss.any()),
        "duration_s": recording.num_frames / info.fps,
        "task_name": simulation.task,
        "split": str(simulation.config.get("split", "")),
        "variation": str(simulation.config.get("variation", "")),
        "seed": simulation.root_seed,
        "run_episode_index": info.episode_index,
        "attempt": info.attempt,
        "num_goals": len(simulation.scene.goals),
    }
