"""What a dataset keeps beside its rows, against the rows: arms, columns that episodes are chosen by, progress."""

from __future__ import annotations

from typing import Any

import numpy as np

from demorec.check.base import Measurement, dataset_check, sidecar_check
from demorec.check.dataset import Dataset
from demorec.core.errors import ExportError, without_path
from demorec.datasets.lerobot.facts import PROGRESS_PATH, STAGE_COLUMNS, facts_of, progress_table, read_progress
from demorec.datasets.lerobot.files import open_table, read_table
from demorec.datasets.lerobot.robots import read_robot


@sidecar_check(
    measures="descriptions of robots that are missing, changed or of another robot",
)
def dataset_robots(dataset: Dataset) -> Measurement | None:
    """The URDF beside each episode is there, unchanged, and of the robot, joints and TCP that the episode has.

    That it is the arm that moved shows in the kinematics: the EE pose follows from it (`dataset_forward_kinematics`).
    """
    used = {name: number for number, name in reversed(dataset.robot_digests.items()) if name is not None}
    if not used:
        return None
    wrong, specs = [], {each.number: each.info.robot for each in dataset.described()}
    for name, number in used.items():
        try:
            robot = read_robot(dataset.path, name)
        except ExportError as error:
            wrong.append(without_path(error, dataset.path))
            continue
        if robot.record.name != dataset.info.robot_type:
            wrong.append(f"{name} is of a {robot.record.name}, the dataset of a {dataset.info.robot_type}")
        for feature, joints in robot.record.joints.items():
            there = dataset.info.features.get(feature)
            if there is not None and there.shape != (len(joints),):
                wrong.append(f"{name} has joints for {len(joints)} elements of {feature}, it has {there.shape}")
        spec = specs.get(number)
        if spec is not None and robot.record.spec != spec:  # an episode that was cut has a robot and no scene
            wrong.append(f"{name} is not the robot of episode {number}")
        elif spec is not None and spec.tcp_link not in robot.model.link_poses({}):
            wrong.append(f"the URDF of {name} has no link {spec.tcp_link}")
    return Measurement(value=len(wrong), detail="; ".join(wrong[:3]) or f"{len(used)} robot{'s' * (len(used) > 1)}")


@sidecar_check(
    measures="columns of the table of episodes that the sidecar contradicts",
)
def dataset_facts(dataset: Dataset) -> Measurement | None:
    """Outcome, retries, task, seed and length of each episode are those that the sidecar keeps."""
    known = set(facts_of(dataset.path))
    if not dataset.sidecar or not known:
        return None
    names = [name for name in ("success", "num_retries", "task_name", "seed", "attempt", "num_goals") if name in known]
    rows: dict[int, dict[str, Any]] = {}
    for path in sorted((dataset.path / "meta" / "episodes").glob("*/*.parquet")):
        if set(names) <= set(open_table(path).schema_arrow.names):  # LeRobot's own recordings have none of them
            rows.update({row["episode_index"]: row for row in read_table(path, ["episode_index", *names]).to_pylist()})
    wrong = []
    for each in dataset.described():
        number, kept, info = each.number, each.kept, each.info
        if (row := rows.get(number)) is None:
            wrong.append(f"episode {number} has none")
            continue
        expected = {
            "success": kept["success"],
            "num_retries": kept["num_retries"],
            "task_name": info.task,
            "seed": info.root_seed,
            "attempt": info.attempt,
            "num_goals": len(info.scene.goals),
        }
        wrong += [f"episode {number}: {name} is {row[name]}" for name in names if row[name] != expected[name]]
    return Measurement(value=len(wrong), detail="; ".join(wrong[:3]) or f"{len(rows)} episodes")


@dataset_check(
    measures="rows of sarm_progress.parquet that the episodes' stages contradict",
)
def dataset_progress(dataset: Dataset) -> Measurement | None:
    """Every row of the dataset has a progress in 0 to 1, which is that of its stage; stages leave no gap."""
    path = dataset.path / PROGRESS_PATH
    if not set(STAGE_COLUMNS) <= set(facts_of(dataset.path)) and not path.exists():
        return None
    episodes = read_progress(dataset.path)
    lengths = [
        (episode.dense[-1].last + 1, place.length) for episode, place in zip(episodes, dataset.places, strict=True)
    ]
    if wrong := [number for number, (found, length) in enumerate(lengths) if found != length]:
        return Measurement(value=len(wrong), detail=f"the stages of episode {wrong[0]} do not cover it")
    expected = progress_table(episodes)
    found = read_table(path, expected.column_names)
    if found.num_rows != expected.num_rows:
        return Measurement(value=abs(found.num_rows - expected.num_rows), detail=f"{found.num_rows} rows")
    off = np.zeros(found.num_rows, dtype=np.bool_)
    for name in expected.column_names:
        difference = found.column(name).to_numpy() - expected.column(name).to_numpy()
        off |= ~(np.abs(difference) < 1e-5)
    first = f"row {int(np.argmax(off))}" if off.any() else f"{found.num_rows} rows"
    return Measurement(value=int(off.sum()), detail=first)
