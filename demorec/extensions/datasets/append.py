"""The state of an existing dataset from any writer, which a new export continues."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from demorec.core.errors import ConfigError, ExportError, describe_error
from demorec.datasets.lerobot.files import open_table, read_json, tables_in
from demorec.datasets.lerobot.layout import CODEBASE_VERSION, STATS_PATH, DatasetInfo
from demorec.datasets.lerobot.paths import PROGRESS_PATH
from demorec.datasets.lerobot.sidecar import CONFIGS_PATH
from demorec.datasets.lerobot.stats import NAMES, Statistics
from demorec.datasets.lerobot.writer import DatasetStart
from demorec.extensions.datasets.folder import LeRobotFolder
from demorec.extensions.datasets.inspect import episode_digests, statistics_from_json


def start_after(root: Path) -> DatasetStart:
    """Read the state that a writer needs to continue a dataset. Raises ExportError if it has another format, or is
    incomplete, and ConfigError if it has progress.
    """
    folder = LeRobotFolder(root)
    info = folder.info
    convert = f"demorec dataset select {shlex.quote(str(root))} --where 'num_frames > 0' --out NEW"
    if info.is_old:
        raise ExportError(
            f"The dataset has format {info.version}, and only {CODEBASE_VERSION} can be appended to. This converts it "
            f"to {CODEBASE_VERSION}: {convert}"
        )
    if (root / PROGRESS_PATH).exists():
        raise ConfigError(f"{PROGRESS_PATH} has no progress of new episodes: remove it, or export all again: {root}")
    episodes, frames = len(folder.places), sum(place.length for place in folder.places)
    rows = sum(open_table(path).metadata.num_rows for path in tables_in(root, "data"))
    if rows != frames:
        raise ExportError(
            f"The dataset is incomplete: its episodes have {frames} frames, its data files {rows}: {root}"
        )
    keys = [name for name, feature in info.features.items() if feature.is_numeric or feature.is_camera]
    needed = [f"stats/{key}/{name}" for key in keys for name in NAMES]
    for path in folder.episode_tables:
        if absent := [name for name in needed if name not in open_table(path).schema_arrow.names]:
            raise ExportError(
                f"The table of episodes lacks columns that new episodes have, such as {absent[0]}. This adds them: "
                f"{convert}"
            )
    try:
        tasks = tuple(folder.tasks) if info.total_tasks else ()
        found = folder.statistics if (root / STATS_PATH).exists() else {}
        configs = read_json(root / CONFIGS_PATH) if (root / CONFIGS_PATH).exists() else {}
        statistics = {key: part for key in info.video_keys if (part := _statistics(found, key, info)) is not None}
        if not isinstance(configs, dict) or not all(isinstance(config, dict) for config in configs.values()):
            raise ValueError(f"{CONFIGS_PATH} holds no configurations")
    except (OSError, ValueError, TypeError, AttributeError) as error:
        raise ExportError(f"The dataset cannot be read ({describe_error(error)}): {root}") from error
    info = replace(info, total_episodes=episodes, total_frames=frames)  # other writers store some as 30.0
    return DatasetStart(
        info=info,
        facts=folder.fact_types,
        tasks=tasks,
        statistics=statistics,
        configs=configs,
        digests=episode_digests(folder),
    )


def _statistics(found: Mapping[str, Any], key: str, info: DatasetInfo) -> Statistics | None:
    part = statistics_from_json(found.get(key, {}))
    if part is None:
        return None
    if any(value.shape != info.features[key].shape[-1:] for value in part.values.values()) or part.count < 0:
        raise ValueError(f"the statistics of {key} do not match its images")
    # LeRobot's streaming writer counts pixels; for merging, a frame must count as one.
    return Statistics(values=part.values, count=min(part.count, info.total_frames), is_camera=True)
