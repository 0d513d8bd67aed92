"""What is known of each episode, as columns of the table that LeRobot filters episodes by (`episode_filter`).

Which columns there are is decided by the first episode, since all files of the table must have the same ones; an
episode that lacks a value has null there. The sidecar (`demorec/episodes`) has everything, whatever the columns are.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import pyarrow as pa

from demorec.datasets.lerobot.files import open_table
from demorec.datasets.lerobot.progress import STAGE_COLUMNS
from demorec.episode.episode import SimulatedColumns, SuccessCheck
from demorec.episode.scene import Scene
from demorec.mcap import SimulatedRecording

_TYPES: dict[str, pa.DataType] = {
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
    "object": pa.string(),
    "object_x": pa.float64(),
    "object_y": pa.float64(),
    "goal_x": pa.float64(),
    "goal_y": pa.float64(),
    **STAGE_COLUMNS,
}
DRAWN, CHECKED = "drawn/", "success_checks/"
"""Beginnings of the columns of numbers whose names follow from the recording."""


def fact_type(name: str) -> pa.DataType | None:
    """Type of a column of facts; None for every other column."""
    return pa.float64() if name.startswith((DRAWN, CHECKED)) else _TYPES.get(name)


def facts_of(root: Path) -> tuple[str, ...]:
    """Names of the columns of facts in the table of episodes of a dataset; ExportError when it is damaged."""
    tables = sorted((root / "meta" / "episodes").glob("*/*.parquet"))
    if not tables:
        return ()
    schema = open_table(tables[0]).schema_arrow
    return tuple(item.name for item in schema if (kind := fact_type(item.name)) is not None and kind == item.type)


def episode_facts(recording: SimulatedRecording, columns: SimulatedColumns) -> dict[str, Any]:
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
        "task_name": info.task,
        "split": str(info.config.get("split", "")),
        "variation": str(info.config.get("variation", "")),
        "seed": info.root_seed,
        "run_episode_index": info.episode_index,
        "attempt": info.attempt,
        "num_goals": len(info.scene.goals),
        **first_goal(info.scene),
    }
    facts |= {DRAWN + name: value for name, value in sorted(_drawn(recording).items())}
    return facts | {CHECKED + name: value for name, value in _nearest_to_limit(checks).items()}


def first_goal(scene: Scene | None) -> dict[str, Any]:
    """The first object to be moved, where it is and where it shall be at the start (m, world frame)."""
    found: dict[str, Any] = {"object": "", "object_x": None, "object_y": None, "goal_x": None, "goal_y": None}
    if scene is not None and scene.goals:
        goal = scene.goals[0]
        here, there = scene.body(goal.object).world_from_body.position, scene.world_from_goal(goal).position
        found |= {"object": goal.object, "object_x": float(here[0]), "object_y": float(here[1])}
        found |= {"goal_x": float(there[0]), "goal_y": float(there[1])}
    return found


def _drawn(recording: SimulatedRecording) -> Mapping[str, float]:
    """What was drawn for the episode: behaviour, the first object's size, mass and friction, gravity, light."""
    info, scene = recording.info, recording.info.scene
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
