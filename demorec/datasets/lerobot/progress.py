"""Progress of each frame: the column `progress_dense` of `sarm_progress.parquet`, for every row of the dataset.

`lerobot-train --sample_weighting.type=rabc --sample_weighting.head_mode=dense` weights samples by it.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from demorec.annotate.timeline import StageRun, dense_runs, dense_stages, episode_timeline, progress, proportions

if TYPE_CHECKING:
    from demorec.mcap import Recording

PROGRESS_PATH = "sarm_progress.parquet"


class EpisodeStages(NamedTuple):
    """Stages of an episode of the dataset: those of its rows, and all stages of its task in order."""

    runs: Sequence[StageRun]
    possible: Sequence[str]


def episode_stages(recording: Recording) -> EpisodeStages:
    """Return the stages of a simulated episode."""
    runs = dense_runs(episode_timeline(recording))
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
