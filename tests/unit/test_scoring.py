"""Scores of episodes on a small third-party dataset in which single episodes are damaged on purpose."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from numpy.typing import NDArray
from PIL import Image
from support.commands import exit_code
from support.foreign_dataset import DATA, EPISODES, TASKS, write_foreign

pytestmark = pytest.mark.slow

LENGTH, EPISODES_IN_ALL, BAD, SIZE = 60, 24, 5, (32, 24)
CLOSES, OPENS = 20, 42
Rows = dict[str, NDArray[Any]]


def demonstration(number: int) -> Rows:
    """An arm moves smoothly from one place to another and back, with an object in its hand from frame 20 to 42."""
    rng = np.random.default_rng(number)
    bounds = (0, CLOSES, OPENS, LENGTH - 1)
    places = np.array([[0, 0], [1, 0.2], [-1, 0.6], [0, 0]]) + rng.uniform(-0.1, 0.1, (4, 2))
    action = np.zeros((LENGTH, 3))
    for (a, b), start, end in zip(pairwise(bounds), places, places[1:], strict=False):
        s = np.linspace(0, 1, b - a + 1)[:, None]
        action[a : b + 1, :2] = start + (end - start) * (10 * s**3 - 15 * s**4 + 6 * s**5)
    action[:, 2] = 1.0
    action[CLOSES:OPENS, 2] = 0.0
    state = np.concatenate([action[:1], action[:-1]])
    state[:, 2] = np.maximum(state[:, 2], 0.4 + rng.uniform(-0.05, 0.05))
    images = np.full((LENGTH, SIZE[1], SIZE[0], 3), 90, np.uint8)
    return {"state": state, "action": action, "images": images, "task": np.array("take the block")}


def write(root: Path, episodes: list[Rows]) -> Path:
    """Write the dataset of `support.foreign_dataset` with other rows."""
    write_foreign(root, length=LENGTH, episodes=len(episodes), size=SIZE)
    lengths = [len(rows["state"]) for rows in episodes]
    kinds = {field.name: field.type for field in pq.read_schema(root / DATA)}
    tasks = sorted({str(rows["task"]) for rows in episodes})
    stored = []
    for image in np.concatenate([rows["images"] for rows in episodes]):
        data = io.BytesIO()
        Image.fromarray(image).save(data, "PNG")
        stored.append({"bytes": data.getvalue(), "path": None})
    columns: dict[str, Any] = {
        "observation.images.top": pa.array(stored, kinds["observation.images.top"]),
        "timestamp": np.concatenate([np.arange(n) / 10 for n in lengths]).astype(np.float32),
        "frame_index": np.concatenate([np.arange(n) for n in lengths]),
        "episode_index": np.repeat(np.arange(len(lengths)), lengths),
        "task_index": np.repeat([tasks.index(str(rows["task"])) for rows in episodes], lengths),
    }
    for name in ("state", "action"):
        values = np.concatenate([rows[name] for rows in episodes]).astype(np.float32)
        stored_rows = pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), values.shape[1])
        columns["observation.state" if name == "state" else name] = stored_rows
    columns["index"] = np.arange(sum(lengths))
    pq.write_table(pa.table({name: columns[name] for name in kinds}), root / DATA)
    ends = np.cumsum(lengths)
    places = pq.read_table(root / EPISODES).to_pydict()
    places |= {"length": lengths, "dataset_to_index": ends, "dataset_from_index": ends - lengths}
    places["tasks"] = [[str(rows["task"])] for rows in episodes]
    pq.write_table(pa.table(places), root / EPISODES)
    pq.write_table(pa.table({"task": tasks, "task_index": np.arange(len(tasks))}), root / TASKS)
    info = json.loads((root / "meta/info.json").read_text())
    for name in ("observation.state", "action"):
        more = [f"left_joint{joint}.pos" for joint in range(values.shape[1] - 3)]
        names = ["shoulder.pos", "elbow.pos", "gripper.pos", *more]
        info["features"][name] |= {"names": names, "shape": [len(names)]}
    info |= {"total_frames": sum(lengths), "total_tasks": len(tasks)}
    (root / "meta/info.json").write_text(json.dumps(info))
    return root


def _each(rows: Rows, change: Callable[[NDArray[Any]], NDArray[Any]]) -> Rows:
    return {name: values if name == "task" else change(values) for name, values in rows.items()}


def hesitates(rows: Rows) -> Rows:
    return _each(rows, lambda values: np.insert(values, [30] * 15, values[30], axis=0))


def goes_aside(rows: Rows) -> Rows:
    longer = hesitates(rows)
    away = 0.5 * np.sin(np.pi * np.arange(16) / 15)[:, None] ** 2 * [0, 1, 0]
    for name in ("state", "action"):
        longer[name][30:46] += away
    return longer


def shakes(rows: Rows) -> Rows:
    rows["action"][:, :2] += np.random.default_rng(0).normal(0, 0.02, (LENGTH, 2))
    return rows


def is_late(rows: Rows) -> Rows:
    return {**rows, "action": np.concatenate([rows["action"][:1]] * 3 + [rows["action"][:-3]])}


def ends_early(rows: Rows) -> Rows:
    return _each(rows, lambda values: values[:38])


def beside_a_resting_arm(rows: Rows, number: int) -> Rows:
    """Add four joints at rest, of follower and leader, whose encoders flicker by a step."""
    rng = np.random.default_rng((number, 1))
    both = {name: np.hstack([rows[name], 0.001 * rng.integers(0, 2, (LENGTH, 4))]) for name in ("state", "action")}
    return {**rows, **both}


def lacks_numbers(rows: Rows) -> Rows:
    rows["state"][7, 1] = np.nan
    return rows


@pytest.fixture
def scored(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Callable[[Callable[[Rows], Rows] | None], Any]:
    """Findings for a dataset in which a function changed one episode."""

    def run(spoil: Callable[[Rows], Rows] | None) -> Any:
        episodes = [demonstration(number) for number in range(EPISODES_IN_ALL)]
        if spoil is not None:
            episodes[BAD] = spoil(episodes[BAD])
        root = write(tmp_path / "d", episodes)
        exit_code("check", str(root), "--no-images", "--json")
        found = json.loads(capsys.readouterr().out)["episodes"]
        return sorted(found, key=lambda episode: episode["episode"])

    return run


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (hesitates, "pauses for"),
        (goes_aside, "takes a detour of"),
        (shakes, "the action shakes"),
        (is_late, "the state follows the action"),
        (ends_early, "the gripper is switched"),
        (lacks_numbers, "NaN or infinite numbers"),
    ],
)
def test_the_damaged_episode_is_the_worst_with_the_reason(
    scored: Any, spoil: Callable[[Rows], Rows], words: str
) -> None:
    found = scored(spoil)
    assert min(found, key=lambda episode: episode["score"])["episode"] == BAD
    assert found[BAD]["score"] < 0.5
    assert any(words in reason for reason in found[BAD]["reasons"])
    assert all(episode["score"] > 0.8 for episode in found if episode["episode"] != BAD)


def test_sound_episodes_are_sound(scored: Any) -> None:
    found = scored(None)
    assert [episode["episode"] for episode in found] == list(range(EPISODES_IN_ALL))
    assert all(episode["score"] > 0.8 and not episode["reasons"] for episode in found)


def test_a_resting_arm_hides_no_damage(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    episodes = [demonstration(number) for number in range(EPISODES_IN_ALL)]
    episodes[BAD] = shakes(episodes[BAD])
    root = write(tmp_path / "d", [beside_a_resting_arm(rows, number) for number, rows in enumerate(episodes)])
    exit_code("check", str(root), "--no-images", "--json")
    found = {each["episode"]: each for each in json.loads(capsys.readouterr().out)["episodes"]}
    assert found[BAD]["score"] < 0.5
    assert any("the action shakes" in reason for reason in found[BAD]["reasons"])
    assert all(each["score"] > 0.8 for number, each in found.items() if number != BAD)


def test_grippers_held_at_any_opening_switch_as_usual(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Objects have all sizes, and the largest of them leave the gripper nearer to open than to closed."""
    episodes = [demonstration(number) for number in range(EPISODES_IN_ALL)]
    for number, rows in enumerate(episodes):
        held = (0.0, 0.1, 0.2, 0.3, 0.2, 0.4)[number % 6]
        rows["action"][CLOSES:OPENS, 2] = held
        rows["state"][CLOSES + 1 : OPENS + 1, 2] = max(held, 0.35)
    exit_code("check", str(write(tmp_path / "d", episodes)), "--no-images", "--json")
    found = json.loads(capsys.readouterr().out)["episodes"]
    assert [each["reasons"] for each in found if each["score"] < 0.8] == []


@pytest.fixture
def late(tmp_path: Path) -> Path:
    """A dataset in which the actions of one episode are late."""
    episodes = [demonstration(number) for number in range(EPISODES_IN_ALL)]
    episodes[BAD] = is_late(episodes[BAD])
    return write(tmp_path / "d", episodes)


def test_good_episodes_are_selected(late: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    good, same = str(tmp_path / "good"), str(tmp_path / "same")
    assert exit_code("dataset", "select", str(late), "--where", 'verdict != "broken"', "--out", good) == 0
    assert f"{EPISODES_IN_ALL - 1} episodes" in capsys.readouterr().out
    assert exit_code("dataset", "drop", str(late), "--where", "score < 0.5", "--out", same) == 0
    assert exit_code("dataset", "diff", good, same) == 0


def test_the_worst_is_shown_first(late: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flags = ("--episodes", "3:7", "--save", str(tmp_path / "v.rrd"))
    assert exit_code("view", str(late), "--rank", "score", *flags) == 0
    assert f"episode {BAD}: its action is" in capsys.readouterr().err
    assert exit_code("report", str(late), "--out", str(tmp_path / "page.html")) == 0
    page = (tmp_path / "page.html").read_text()
    first = page.partition('<section id="episodes">')[2].partition("<article")[2].partition("</article>")[0]
    assert f"episode {BAD}<" in first
    assert "the state follows it by" in first
