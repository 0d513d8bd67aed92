"""The dataset card: README.md, shown by the Hugging Face Hub.

It is written from the finished dataset, so it also covers appended episodes.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from pathlib import Path

from demorec.core.text import markdown
from demorec.datasets.lerobot.files import read_table, tables_in, write_text
from demorec.datasets.lerobot.layout import TASKS_PATH, DatasetInfo
from demorec.datasets.lerobot.options import ExportOptions
from demorec.datasets.lerobot.paths import CARD_PATH, SIDECAR_DIR
from demorec.episode.features import ACTION, ActionKind

_MARK = "<!-- written by demorec, which renews it at every export unless it was edited ({digest}) -->\n"
"""Last line of a card; its digest reveals whether the card was edited."""
_MAX_TASKS = 20
_DEPTH_MEANING = "distance along the optical axis, 12-bit logarithmic codes of 0.01 to 10 m; 0.01 m: nothing was hit"
_ACTION_MEANING: Mapping[ActionKind, str] = {
    "joint": "absolute joint targets (rad), gripper opening (m)",
    "joint_increment": "joint target minus that of the frame before (rad), the first minus the initial positions, plus "
    "the recovery from exploration noise (demorec.episode.features); gripper opening (m), absolute",
    "ee": "absolute pose of the tool centre point in the base frame: position (m), quaternion xyzw with x >= 0; "
    "gripper opening (m)",
    "ee_delta": "change of the tool centre point's pose since the frame before, the first since the observed one: "
    "translation (m) and rotation vector (rad) in base axes, applied from the left; gripper opening (m), absolute",
}
_SIMULATED_ROWS = (
    "Row t holds the observation at time t, taken before the action of row t is applied; the action is the expert's "
    "target for the next frame. Where exploration noise was added to the motor commands, the action is derived from "
    "the clean target. Frame times are multiples of the simulation's frame period, not of a wall clock. Poses are in "
    "the arm's base frame, with quaternions xyzw."
)
_RECORDED_ROWS = (
    "Row t holds the data of frame t in the recordings; the table above has the origin of each feature. LeRobot's "
    "timestamps are multiples of the nominal period; the recordings have the exact timestamps of the frames and the "
    "age of each sample."
)
_CARD = """---
{license}task_categories:
- robotics
tags:
- LeRobot
- demorec
{simulation}configs:
- config_name: default
  data_files: data/*/*.parquet
---

# {repo_id}

{summary}

## Task

{tasks}

## Use

```python
from lerobot.datasets import LeRobotDataset

# or with root="path/of/this/folder"; LeRobot's default backend, torchcodec, needs FFmpeg installed
dataset = LeRobotDataset("{repo_id}", video_backend="pyav")
```

## Features

| feature | type | shape | unit or origin |
|---|---|---|---|
{features}

{rows}

`meta/info.json` names all elements. `demorec/` holds data without a column in LeRobot's format.
"""


def write_card(root: Path, info: DatasetInfo, options: ExportOptions, meanings: Mapping[str, str]) -> None:
    """Write the card of a finished dataset folder, unless it has one of the user; `meanings` has the features'
    origin or units in the recordings.
    """
    path = root / CARD_PATH
    if not has_own_card(root):
        path.unlink(missing_ok=True)  # a copy of the existing one may be read-only
        write_text(path, _marked(_card(root, info, options, meanings)))


def has_own_card(root: Path) -> bool:
    """Whether a dataset's card belongs to the user: `write_card` did not write it, or it was edited since."""
    path = root / CARD_PATH
    if not os.path.lexists(path):
        return False
    if not path.is_file():
        return True
    text = path.read_bytes().decode(errors="replace")
    return text != _marked(text.rpartition("<!--")[0])


def _marked(text: str) -> str:
    return text + _MARK.format(digest=hashlib.sha256(text.encode()).hexdigest()[:16])


def _card(root: Path, info: DatasetInfo, options: ExportOptions, meanings: Mapping[str, str]) -> str:
    tables = [read_table(path, ["root_seed"]) for path in tables_in(root, f"{SIDECAR_DIR}/episodes")]
    seeds = [seed for table in tables for seed in table.column("root_seed").to_pylist()]
    # recordings of other robots have no seed, episodes of other writers no row
    has_seeds = None not in seeds and len(seeds) == info.total_episodes
    meaning = {name: markdown(text) for name, text in meanings.items()}
    meaning |= dict.fromkeys((name for name, item in info.features.items() if item.is_depth), _DEPTH_MEANING)
    if has_seeds:
        meaning[ACTION] = _ACTION_MEANING[options.action]
    features = []
    for key, item in info.features.items():
        name = f"`{key}`" if markdown(key) == key else markdown(key)
        features.append(f"| {name} | {markdown(item.dtype)} | {list(item.shape)} | {meaning.get(key, '')} |")
    tasks = read_table(root / TASKS_PATH, ["task"]).column("task").to_pylist()
    listed = [f"- {markdown(task)}" for task in tasks[:_MAX_TASKS]]
    if len(tasks) > _MAX_TASKS:
        listed.append(f"- and {len(tasks) - _MAX_TASKS} more")
    licence = options.license or ("apache-2.0" if has_seeds else "")
    return _CARD.format(
        license=f"license: {licence}\n" if licence else "",
        simulation="- simulation\n" if has_seeds else "",
        repo_id=options.repo_id,
        summary=_summary(info, has_seeds=has_seeds),
        tasks="\n".join(listed),
        features="\n".join(features),
        rows=_SIMULATED_ROWS if has_seeds else _RECORDED_ROWS,
    )


def _summary(info: DatasetInfo, *, has_seeds: bool) -> str:
    demonstrations = "demonstration" if info.total_episodes == 1 else "demonstrations"
    robot, minutes = markdown(str(info.robot_type)), info.total_frames / info.fps / 60
    scripted = f"scripted {demonstrations} by a simulated {robot} arm in PyBullet"
    content = scripted if has_seeds else f"{demonstrations} of {robot}"
    return (
        f"{info.total_episodes} {content}, {info.total_frames} frames at {info.fps} Hz ({minutes:.1f} minutes), "
        "in the LeRobot v3.0 format. Exported by demorec."
    )
