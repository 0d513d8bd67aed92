"""What is known of each episode, where LeRobot looks for it: facts to filter by, progress and stages.

Facts are columns of the table that LeRobot filters episodes by (`episode_filter`). Which columns there are is decided
by the first episode, since all files of the table must have the same ones; an episode that lacks a value has null
there. The sidecar (`demorec/episodes`) has everything, whatever the columns are. Progress and stages are:

- `sarm_progress.parquet`: `progress_dense` of every row of the dataset, which
  `lerobot-train --sample_weighting.type=rabc --sample_weighting.head_mode=dense` weighs samples by;
- columns `dense_subtask_names`, `..._start_frames`, `..._end_frames` in the table of episodes, which SARM is trained
  with (annotation_mode dense_only);
- `meta/temporal_proportions_dense.json`: the stages' mean shares of the time.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from demorec.annotate.progress import (
    WHOLE_TASK,
    StageRun,
    dense_stages,
    progress,
    proportions,
)
from demorec.core.errors import ExportError, describe_error
from demorec.core.files import sync_path
from demorec.datasets.lerobot.files import open_table, rows_in, tables_in

if TYPE_CHECKING:
    from demorec.episode.episode import Columns, SuccessCheck
    from demorec.episode.info import EpisodeInfo
    from demorec.episode.scene import Scene
    from demorec.mcap import Recording

PROGRESS_PATH = "sarm_progress.parquet"
PROPORTIONS_PATH = "meta/temporal_proportions_dense.json"
STAGE_COLUMNS: dict[str, pa.DataType] = {
    "dense_subtask_names": pa.list_(pa.string()),
    "dense_subtask_start_frames": pa.list_(pa.int64()),
    "dense_subtask_end_frames": pa.list_(pa.int64()),
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
    runs: tuple[StageRun, ...]

    @property
    def stages(self) -> tuple[str, ...]:
        """All stages of an episode with this number of goals."""
        if self.runs[0].stage == WHOLE_TASK:
            return (WHOLE_TASK,)
        return dense_stages(self.num_goals, self.runs)

    def row(self) -> dict[str, Any]:
        """Return its entries in the table of episodes."""
        parts = ([run.stage for run in self.runs], [run.first for run in self.runs], [run.last for run in self.runs])
        return dict(zip(STAGE_COLUMNS, parts, strict=True))

    @classmethod
    def from_row(cls, row: Mapping[str, Any], num_goals: int) -> EpisodeProgress:
        """Inverse of `row`; ValueError, TypeError or KeyError for what is none."""
        names, starts, ends = (row[name] for name in STAGE_COLUMNS)
        runs = tuple(
            StageRun(stage=str(name), first=int(first), last=int(last))
            for name, first, last in zip(names, starts, ends, strict=True)
        )
        if not runs or runs[0].first != 0 or any(b.first != a.last + 1 for a, b in pairwise(runs)):
            raise ValueError("stages that leave gaps")
        return cls(num_goals=num_goals, runs=runs)


def read_progress(root: Path) -> list[EpisodeProgress]:
    """The stages of every episode of a dataset that has them, in order.

    Raises:
        ExportError: They cannot be read.
    """
    try:
        rows = rows_in(root, "meta/episodes", [*STAGE_COLUMNS, "num_goals"])
        return [EpisodeProgress.from_row(row, int(row["num_goals"])) for row in rows]
    except (ValueError, TypeError, KeyError) as error:
        raise ExportError(
            f"The stages of the dataset's episodes cannot be used ({describe_error(error)}): {root}"
        ) from error


def progress_table(episodes: Sequence[EpisodeProgress]) -> pa.Table:
    """`index`, `episode_index`, `frame_index` and `progress_dense` (0..1) of every row."""
    lengths = [episode.runs[-1].last + 1 for episode in episodes]
    share = _proportions(episodes)
    parts = [progress(episode.runs, episode.stages, share) for episode in episodes]
    return pa.table(
        {
            "index": np.arange(sum(lengths)),
            "episode_index": np.repeat(np.arange(len(lengths)), lengths),
            "frame_index": np.concatenate([np.arange(length) for length in lengths]),
            "progress_dense": np.concatenate(parts).astype(np.float32),
        }
    )


def write_progress(root: Path) -> None:
    """Write both files of a whole dataset, durably, from the stages in its table of episodes."""
    episodes, path = read_progress(root), root / PROGRESS_PATH
    pq.write_table(progress_table(episodes), path, use_dictionary=["episode_index"])
    sync_path(path)
    file = root / PROPORTIONS_PATH
    file.write_text(json.dumps(_proportions(episodes), indent=2) + "\n")
    sync_path(file)


def _proportions(episodes: Sequence[EpisodeProgress]) -> dict[str, float]:
    """Return the mean share of every stage that an episode has."""
    stages = tuple(dict.fromkeys(stage for episode in episodes for stage in episode.stages))
    return proportions([episode.runs for episode in episodes], stages)


_TYPES: dict[str, pa.DataType] = {
    **dict.fromkeys(("success", "has_deliberate_miss"), pa.bool_()),
    **dict.fromkeys(("failure_phase", "failure_reason", "task_name", "split", "variation", "object"), pa.string()),
    **dict.fromkeys(("num_retries", "run_episode_index", "attempt", "num_goals"), pa.int64()),
    **dict.fromkeys(("duration_s", "object_x", "object_y", "goal_x", "goal_y"), pa.float64()),
    "seed": pa.uint64(),
    **STAGE_COLUMNS,
}
DRAWN, CHECKED = "drawn/", "success_checks/"
"""Beginnings of the columns of numbers whose names follow from the recording."""


def fact_types(names: Iterable[str]) -> dict[str, pa.DataType]:
    """Of some columns those of facts -> type."""
    known = {name: pa.float64() if name.startswith((DRAWN, CHECKED)) else _TYPES.get(name) for name in names}
    return {name: kind for name, kind in known.items() if kind is not None}


def facts_of(root: Path) -> dict[str, pa.DataType]:
    """Columns of facts in the table of episodes of a dataset -> type; ExportError when it is damaged."""
    tables = tables_in(root, "meta/episodes")
    if not tables:
        return {}
    schema = open_table(tables[0]).schema_arrow
    known = fact_types(schema.names)
    return {item.name: known[item.name] for item in schema if item.name in known and known[item.name] == item.type}


def episode_facts(recording: Recording, columns: Columns) -> dict[str, Any]:
    """Name -> value; positions in the world frame at the start, metres."""
    info, outcome = recording.info, recording.outcome
    checks = () if outcome is None else outcome.checks
    facts: dict[str, Any] = {
        "success": outcome is not None and outcome.success,
        "failure_phase": "" if outcome is None else outcome.failure_phase,
        "failure_reason": "interrupted" if outcome is None else outcome.failure_reason,
        "num_retries": 0 if outcome is None else outcome.num_retries,
        "has_deliberate_miss": bool(columns.is_deliberate_miss.any()),
        "duration_s": columns.num_frames / info.fps,
    }
    return facts | facts_before(info) | facts_after(checks)


def facts_before(info: EpisodeInfo) -> dict[str, Any]:
    """Those of a simulated episode that are known before its first frame."""
    facts = {
        "task_name": info.task,
        "split": str(info.config.get("split", "")),
        "variation": str(info.config.get("variation", "")),
        "seed": info.root_seed,
        "run_episode_index": info.episode_index,
        "attempt": info.attempt,
        "num_goals": len(info.scene.goals),
        **first_goal(info.scene),
    }
    return facts | {DRAWN + name: value for name, value in sorted(_drawn(info).items())}


def facts_after(checks: Iterable[SuccessCheck]) -> dict[str, float]:
    """Those of its conditions."""
    return {CHECKED + name: value for name, value in _nearest_to_limit(checks).items()}


def first_goal(scene: Scene | None) -> dict[str, Any]:
    """The first object to be moved, where it is and where it shall be at the start (m, world frame)."""
    found: dict[str, Any] = {"object": "", "object_x": None, "object_y": None, "goal_x": None, "goal_y": None}
    if scene is not None and scene.goals:
        goal = scene.goals[0]
        here, there = scene.body(goal.object).world_from_body.position, scene.world_from_goal(goal).position
        found |= {"object": goal.object, "object_x": float(here[0]), "object_y": float(here[1])}
        found |= {"goal_x": float(there[0]), "goal_y": float(there[1])}
    return found


def _drawn(info: EpisodeInfo) -> Mapping[str, float]:
    """What was drawn for the episode: behaviour, the first object's size, mass and friction, gravity, light."""
    scene = info.scene
    drawn = dict(info.behaviour)
    light = scene.light
    drawn |= {"light_ambient": light.ambient, "light_diffuse": light.diffuse, "light_shadow": light.shadow}
    drawn["light_turn"] = math.atan2(light.direction[1], light.direction[0])
    drawn["light_elevation"] = math.atan2(light.direction[2], math.hypot(light.direction[0], light.direction[1]))
    drawn["gravity"] = scene.physics.gravity[2]
    drawn["distractors"] = float(sum(body.role == "distractor" for body in scene.bodies))
    if scene.goals:
        body = scene.body(scene.goals[0].object)
        drawn |= {"object_size": max(body.shape.extents), "object_mass": body.mass}
        drawn["object_friction"] = body.lateral_friction
    return {name: float(value) for name, value in drawn.items()}


def _nearest_to_limit(checks: Iterable[SuccessCheck]) -> dict[str, float]:
    """Condition -> value found; of several objects, the one that failed, or is nearest to failing."""
    worst: dict[str, SuccessCheck] = {}
    for check in checks:
        name = check.name.partition(":")[0]
        if name not in worst or (check.passed, _slack(check)) < (worst[name].passed, _slack(worst[name])):
            worst[name] = check
    return {name: check.value for name, check in worst.items()}


def _slack(check: SuccessCheck) -> float:
    return abs(check.limit - check.value)
