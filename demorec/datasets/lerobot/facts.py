"""Facts about each episode in LeRobot's places: columns to filter by, progress and stages.

Facts are columns of the table that LeRobot filters episodes by (`episode_filter`). The first episode decides which
columns exist, because all files of the table must share them; an episode without a value has null. Progress and stages
are:

- `sarm_progress.parquet`: `progress_dense` for every row of the dataset, by which
  `lerobot-train --sample_weighting.type=rabc --sample_weighting.head_mode=dense` weights samples;
- columns `dense_subtask_names`, `dense_subtask_start_frames` and `dense_subtask_end_frames` in the table of episodes,
  for training SARM;
- `meta/temporal_proportions_dense.json`: the stages' mean shares of the time.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from itertools import chain, pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from demorec.annotate.timeline import StageRun, dense_stages, progress, proportions
from demorec.core.errors import ExportError, describe_error
from demorec.datasets.lerobot.files import open_table, rows_in

if TYPE_CHECKING:
    from demorec.episode.scene import Scene
    from demorec.mcap import Recording

PROGRESS_PATH = "sarm_progress.parquet"
PROPORTIONS_PATH = "meta/temporal_proportions_dense.json"
STAGE_NAMES = "dense_subtask_names"
STAGE_STARTS = "dense_subtask_start_frames"
STAGE_ENDS = "dense_subtask_end_frames"
STAGE_COLUMNS: dict[str, pa.DataType] = {
    STAGE_NAMES: pa.list_(pa.string()),
    STAGE_STARTS: pa.list_(pa.int64()),
    STAGE_ENDS: pa.list_(pa.int64()),
}
"""Column of the table of episodes -> its type."""


def stage_columns(runs: Sequence[StageRun]) -> dict[str, Any]:
    """Return the entries of an episode's stages in the table of episodes."""
    return {
        STAGE_NAMES: [run.stage for run in runs],
        STAGE_STARTS: [run.first for run in runs],
        STAGE_ENDS: [run.last for run in runs],
    }


def _stage_runs(row: Mapping[str, Any]) -> list[StageRun]:
    """Inverse of `stage_columns`; ValueError, TypeError or KeyError for an invalid row."""
    runs = [
        StageRun(stage=str(name), first=int(first), last=int(last))
        for name, first, last in zip(row[STAGE_NAMES], row[STAGE_STARTS], row[STAGE_ENDS], strict=True)
    ]
    if not runs or runs[0].first != 0 or any(b.first != a.last + 1 for a, b in pairwise(runs)):
        raise ValueError("stages that leave gaps")
    return runs


def write_progress(root: Path) -> None:
    """Write the files of progress from the stages in the dataset's table of episodes. Raises ExportError if they cannot
    be read.
    """
    try:
        rows = list(rows_in(root, "meta/episodes", [*STAGE_COLUMNS, "num_goals"]))
        episodes = [_stage_runs(row) for row in rows]
        stages = [dense_stages(int(row["num_goals"]), runs) for row, runs in zip(rows, episodes, strict=True)]
    except (ValueError, TypeError, KeyError) as error:
        raise ExportError(
            f"The stages of the dataset's episodes cannot be used ({describe_error(error)}): {root}"
        ) from error
    shares = proportions(episodes, tuple(dict.fromkeys(chain.from_iterable(stages))))
    parts = [progress(runs, possible, shares) for runs, possible in zip(episodes, stages, strict=True)]
    lengths = [len(part) for part in parts]
    columns = {
        "index": np.arange(sum(lengths)),
        "episode_index": np.repeat(np.arange(len(lengths)), lengths),
        "frame_index": np.concatenate([np.arange(length) for length in lengths]),
        "progress_dense": np.concatenate(parts).astype(np.float32),
    }
    pq.write_table(pa.table(columns), root / PROGRESS_PATH, use_dictionary=["episode_index"])
    (root / PROPORTIONS_PATH).write_text(json.dumps(shares, indent=2) + "\n")


_TYPES: dict[str, pa.DataType] = {
    **dict.fromkeys(("success", "has_deliberate_miss"), pa.bool_()),
    **dict.fromkeys(("failure_phase", "failure_reason", "task_name", "split", "variation", "object"), pa.string()),
    **dict.fromkeys(("num_retries", "run_episode_index", "attempt", "num_goals"), pa.int64()),
    "seed": pa.uint64(),
    **STAGE_COLUMNS,
}
_LEROBOT_COLUMN = re.compile(
    r"(episode_index|tasks|length|dataset_from_index|dataset_to_index)$|(stats|videos|data|meta)/"
)


def fact_types(names: Iterable[str]) -> dict[str, pa.DataType]:
    """Return fact column -> type; facts that are not listed are numbers."""
    return {name: _TYPES.get(name, pa.float64()) for name in names}


def fact_columns(tables: Sequence[Path]) -> dict[str, pa.DataType]:
    """Return column -> type for columns of the table of episodes beyond LeRobot's own. Raises ExportError if the table
    is damaged.
    """
    schema = open_table(tables[0]).schema_arrow if tables else ()
    return {item.name: item.type for item in schema if not _LEROBOT_COLUMN.match(item.name)}


def episode_facts(recording: Recording) -> dict[str, Any]:
    """Return fact -> value for an episode with a scene; positions in the world frame at the start, metres."""
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
        **_first_goal(simulation.scene),
    }


def _first_goal(scene: Scene) -> dict[str, Any]:
    if not scene.goals:
        return {"object": "", "object_x": None, "object_y": None, "goal_x": None, "goal_y": None}
    goal = scene.goals[0]
    here, there = scene.body(goal.object).world_from_body.position, scene.world_from_goal(goal).position
    return {
        "object": goal.object,
        "object_x": float(here[0]),
        "object_y": float(here[1]),
        "goal_x": float(there[0]),
        "goal_y": float(there[1]),
    }
