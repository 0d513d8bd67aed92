"""Per-episode values in a dataset's tables: for selecting and sorting episodes, and statistics."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from demorec.datasets.lerobot.episode_table import has_episode_table
from demorec.datasets.lerobot.files import open_table, read_json_lines, table_batches
from demorec.datasets.lerobot.folder import LeRobotFolder
from demorec.datasets.lerobot.layout import OLD_EPISODES_PATH
from demorec.datasets.lerobot.stats import NAMES

OLD_STATS = "meta/episodes_stats.jsonl"
"""Statistics of each episode before v3.0."""
_SIDECAR = ("source", "success", "failure_phase", "failure_reason", "num_retries", "attempt", "run_episode_index")
"""Columns of the sidecar for selecting episodes."""


def episode_columns(folder: LeRobotFolder) -> list[dict[str, Any]]:
    """Read the values for selecting and sorting: name -> value, for each episode in order."""
    found = [
        {
            "episode_index": place.episode_index,
            "num_frames": place.length,
            "length": place.length,
            "duration_s": place.length / folder.info.fps,
            "task": "; ".join(place.tasks),
            "tasks": list(place.tasks),
        }
        for place in folder.places
    ]
    more = episode_facts(folder)
    if folder.info.is_old and has_episode_table(folder.root, folder.info):
        more = read_json_lines(folder.root / OLD_EPISODES_PATH)
    sidecar = {row["episode_index"]: row for row in folder.sidecar(_SIDECAR)}
    for row, facts in zip(found, more, strict=True):
        known = {**sidecar.get(row["episode_index"], {}), **facts}
        row |= {name: value for name, value in known.items() if name not in row}
    return found


def episode_facts(folder: LeRobotFolder) -> list[dict[str, Any]]:
    """Read the columns of the episodes' table beyond LeRobot's own, for each episode in order."""
    if folder.info.is_old or not has_episode_table(folder.root, folder.info):
        return [{} for _ in folder.places]
    found: list[dict[str, Any]] = []
    for path in folder.episode_tables:
        there = open_table(path).schema_arrow.names
        for batch in table_batches(path, ["episode_index", *(name for name in folder.fact_types if name in there)]):
            found += batch.to_pylist()
    return found


def episode_statistics(folder: LeRobotFolder, features: Sequence[str]) -> Iterator[tuple[int, str, Mapping[str, Any]]]:
    """Yield (episode_index, feature, its available statistics in LeRobot's form)."""
    if folder.info.is_old:
        path = folder.root / OLD_STATS
        for line in read_json_lines(path) if path.exists() else ():
            stats, number = line.get("stats"), line.get("episode_index")
            if isinstance(stats, dict) and isinstance(number, int):
                yield from ((number, name, stats[name]) for name in features if isinstance(stats.get(name), dict))
        return
    for path in folder.episode_tables:
        there = open_table(path).schema_arrow.names
        quantities = {name: [key for key in NAMES if f"stats/{name}/{key}" in there] for name in features}
        columns = [f"stats/{name}/{key}" for name, keys in quantities.items() for key in keys]
        for batch in table_batches(path, ["episode_index", *columns]):
            for row in batch.to_pylist():
                for name, keys in quantities.items():
                    if keys:
                        yield row["episode_index"], name, {key: row[f"stats/{name}/{key}"] for key in keys}
