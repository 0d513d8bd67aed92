"""What a dataset keeps beside its rows, against the rows: arms, columns that episodes are chosen by, progress."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import Any

import numpy as np

from demorec.check.base import Measurement, dataset_check, sidecar_check
from demorec.check.dataset import Dataset, DescribedEpisode
from demorec.core.errors import ExportError, without_path
from demorec.datasets.lerobot.facts import (
    PROGRESS_PATH,
    STAGE_COLUMNS,
    facts_after,
    facts_before,
    facts_of,
    first_goal,
    progress_table,
    read_progress,
)
from demorec.datasets.lerobot.files import open_table, read_table
from demorec.datasets.lerobot.paths import SIDECAR_DIR
from demorec.datasets.lerobot.robots import read_robot
from demorec.episode.episode import SuccessCheck

_KEPT = ("success", "failure_phase", "failure_reason", "num_retries")
_ATTEMPT = ("source", "run_episode_index", "attempt", "success", "failure_reason")
_START = ("object", "object_x", "object_y", "goal_x", "goal_y")


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
    """Every column by which episodes are chosen is what the sidecar's scene and conditions give, and each episode is
    one of the attempts."""
    names = [name for name in facts_of(dataset.path) if name not in STAGE_COLUMNS]
    if not dataset.sidecar or not names:
        return None
    rows: dict[int, dict[str, Any]] = {}
    for path in sorted((dataset.path / "meta" / "episodes").glob("*/*.parquet")):
        if set(names) <= set(open_table(path).schema_arrow.names):  # LeRobot's own recordings have none of them
            rows.update({row["episode_index"]: row for row in read_table(path, ["episode_index", *names]).to_pylist()})
    wrong = list(_strange_attempts(dataset))
    for each in dataset.described():
        if (row := rows.get(each.number)) is None:
            wrong.append(f"episode {each.number} has none")
            continue
        expected = _expected_facts(dataset, each)
        differing = [name for name in names if name in expected and row[name] != expected[name]]
        wrong += [f"episode {each.number}: {name} is {row[name]}" for name in differing]
    return Measurement(value=len(wrong), detail="; ".join(wrong[:3]) or f"{len(rows)} episodes")


def _expected_facts(dataset: Dataset, each: DescribedEpisode) -> dict[str, Any]:
    """Those that the sidecar gives; of a recording whose frames were not all taken the duration is not known."""
    kept = each.kept | dataset.details.get(each.number, {})
    facts = {name: kept[name] for name in _KEPT if name in kept} | facts_before(each.info)
    if kept["frame_stride"] == 1:
        facts["duration_s"] = len(each.rows["index"]) / dataset.info.fps
        facts["has_deliberate_miss"] = bool(kept["deliberate_miss_frames"])
    return facts | facts_after(SuccessCheck(**check) for check in kept.get("checks", ()))


def _strange_attempts(dataset: Dataset) -> Iterator[str]:
    """Attempts that are said to be in the dataset, against its episodes; starts and goals of these."""
    paths = sorted((dataset.path / SIDECAR_DIR / "attempts").glob("*/*.parquet"))
    if not paths or not set(_ATTEMPT) <= set(next(iter(dataset.details.values()), {})):
        return
    rows = [row for path in paths for row in read_table(path).to_pylist() if row["in_dataset"]]
    told = Counter(tuple(row[name] for name in _ATTEMPT) for row in rows)
    there = Counter(tuple(row[name] for name in _ATTEMPT) for row in dataset.details.values())
    if len(dataset.details) >= len(rows):  # the sidecar may lack an episode, as after LeRobot's resume
        yield from (f"of the attempts, {key[0]} is no episode" for key in told - there)
    yield from (f"{key[0]} is none of the attempts" for key in there - told)
    starts = Counter(tuple(row[name] for name in _START) for row in rows)
    for each in dataset.described():
        goal = first_goal(each.info.scene)
        if not told - there and starts[tuple(goal[name] for name in _START)] < 1:
            yield f"the attempt of episode {each.number} has another start"


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
