"""`demorec dataset score` on a small dataset of somebody else's in which single episodes are spoilt on purpose."""

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
COLORS = {"red": (220, 20, 20), "blue": (20, 20, 220)}
Rows = dict[str, NDArray[Any]]


def demonstration(number: int) -> Rows:
    """An arm goes from a place to another one and back, smoothly, with something in its hand from frame 20 to 42."""
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
    color = list(COLORS)[number % 2]
    images = np.full((LENGTH, SIZE[1], SIZE[0], 3), 90, np.uint8)
    for t in range(LENGTH):
        left = int(10 + 6 * state[t, 0])
        images[t, 6:16, left : left + 8] = COLORS[color]
    return {"state": state, "action": action, "images": images, "task": np.array(f"take the {color} block")}


def write(root: Path, episodes: list[Rows]) -> Path:
    """As the dataset of `support.foreign_dataset`, with other rows."""
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
        numbers = pa.array(np.concatenate([rows[name] for rows in episodes]).astype(np.float32).ravel())
        columns["observation.state" if name == "state" else name] = pa.FixedSizeListArray.from_arrays(numbers, 3)
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
        info["features"][name]["names"] = ["shoulder.pos", "elbow.pos", "gripper.pos"]
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


def loses_it(rows: Rows) -> Rows:
    rows["state"][32:OPENS, 2] = 0.0
    return rows


def shakes(rows: Rows) -> Rows:
    rows["action"][:, :2] += np.random.default_rng(0).normal(0, 0.02, (LENGTH, 2))
    return rows


def is_late(rows: Rows) -> Rows:
    return {**rows, "action": np.concatenate([rows["action"][:1]] * 3 + [rows["action"][:-3]])}


def takes_the_other(rows: Rows) -> Rows:
    other = {"take the red block": "take the blue block", "take the blue block": "take the red block"}
    return {**rows, "task": np.array(other[str(rows["task"])])}


def freezes(rows: Rows) -> Rows:
    rows["images"][24:40] = rows["images"][24]
    return rows


def ends_early(rows: Rows) -> Rows:
    return _each(rows, lambda values: values[:38])


def goes_elsewhere_in_the_end(rows: Rows) -> Rows:
    return _shifted(rows, OPENS, LENGTH - 1)


def puts_it_elsewhere(rows: Rows) -> Rows:
    """And ends as far from there as always."""
    return _shifted(rows, CLOSES, OPENS)


def _shifted(rows: Rows, first: int, last: int) -> Rows:
    way = np.clip((np.arange(LENGTH) - first) / (last - first), 0, 1)
    for name in ("state", "action"):
        rows[name][:, 1] += 0.5 * (3 * way**2 - 2 * way**3)
    return rows


def sees_little(rows: Rows) -> Rows:
    """But for a shadow that moves."""
    freezes(rows)
    for t in range(24, 40):
        rows["images"][t, 22:, 2 * (t - 24) : 2 * (t - 24) + 2] -= 20
    return rows


def is_copied(rows: Rows) -> Rows:
    return demonstration(BAD - 2)


def lacks_numbers(rows: Rows) -> Rows:
    rows["state"][7, 1] = np.nan
    return rows


@pytest.fixture
def scored(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Callable[[Callable[[Rows], Rows] | None], Any]:
    """What is found of a dataset in which one episode is changed by a function."""

    def run(spoil: Callable[[Rows], Rows] | None) -> Any:
        episodes = [demonstration(number) for number in range(EPISODES_IN_ALL)]
        if spoil is not None:
            episodes[BAD] = spoil(episodes[BAD])
        root = write(tmp_path / "d", episodes)
        assert exit_code("dataset", "score", str(root), "--workers", "1", "--json") == 0
        return json.loads(capsys.readouterr().out)["episodes"]

    return run


@pytest.mark.parametrize(
    ("spoil", "kinds", "frame"),
    [
        (hesitates, {"pause", "time", "idle"}, 35),
        (goes_aside, {"path", "course", "strokes"}, 38),
        (loses_it, {"slip"}, 31),
        (shakes, {"action noise"}, 30),
        (is_late, {"lag"}, 30),
        (takes_the_other, {"instruction"}, 30),
        (freezes, {"frozen"}, 32),
        (ends_early, {"switches", "end"}, 37),
        (goes_elsewhere_in_the_end, {"end"}, LENGTH - 1),
        (is_copied, {"copy"}, 30),
        (lacks_numbers, {"missing"}, 7),
    ],
)
def test_the_spoilt_episode_is_the_worst_and_says_why(
    scored: Any, spoil: Callable[[Rows], Rows], kinds: set[str], frame: int
) -> None:
    found = scored(spoil)
    assert min(found, key=lambda episode: episode["score"])["episode_index"] == BAD
    assert found[BAD]["score"] < 0.5
    assert {reason["kind"] for reason in found[BAD]["reasons"]} & kinds
    reason = next(reason for reason in found[BAD]["reasons"] if reason["kind"] in kinds)
    assert reason["first"] <= frame <= reason["last"]
    assert all(episode["score"] > 0.8 for episode in found if episode["episode_index"] != BAD)


@pytest.mark.parametrize(("vary", "kind"), [(puts_it_elsewhere, "end"), (sees_little, "frozen")])
def test_what_varies_honestly_is_not_blamed(scored: Any, vary: Callable[[Rows], Rows], kind: str) -> None:
    assert kind not in {reason["kind"] for reason in scored(vary)[BAD]["reasons"]}


def test_sound_episodes_are_sound(scored: Any) -> None:
    found = scored(None)
    assert [episode["episode_index"] for episode in found] == list(range(EPISODES_IN_ALL))
    assert all(episode["score"] > 0.8 and not episode["reasons"] for episode in found)


def from_the_hand(number: int, color: tuple[int, int, int], task: str = "take the block") -> Rows:
    """A demonstration as a camera on the hand sees it: the ground goes by, and what is held stands still."""
    rng = np.random.default_rng(100 + number)
    rows = demonstration(number)
    ground = rng.integers(90, 160, (SIZE[1], 4 * LENGTH + SIZE[0], 1)).repeat(3, axis=2)
    rows["images"] = np.stack([ground[:, 4 * t : 4 * t + SIZE[0]] for t in range(LENGTH)]).astype(np.uint8)
    half = int(rng.integers(3, 6))
    rows["images"][CLOSES:OPENS, 12 - half : 12 + half, 16 - half : 16 + half] = np.array(color) * rng.uniform(0.7, 1.1)
    return {**rows, "task": np.array(task)}


@pytest.fixture
def held(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Callable[[list[Rows]], dict[int, Any]]:
    """What is held in which episodes that is not what others hold: number -> the reason."""

    def run(episodes: list[Rows]) -> dict[int, Any]:
        root = write(tmp_path / "d", episodes)
        assert exit_code("dataset", "score", str(root), "--workers", "1", "--json") == 0
        found = json.loads(capsys.readouterr().out)["episodes"]
        return {
            episode["episode_index"]: reason
            for episode in found
            for reason in episode["reasons"]
            if reason["kind"] == "held"
        }

    return run


RED, BLUE, BLACK = (200, 30, 30), (30, 30, 200), (20, 20, 20)


@pytest.mark.parametrize("other", [BLUE, BLACK])
def test_what_holds_something_else_is_found(held: Any, other: tuple[int, int, int]) -> None:
    found = held([from_the_hand(number, other if number == BAD else RED) for number in range(EPISODES_IN_ALL)])
    assert list(found) == [BAD]
    assert found[BAD]["factor"] < 0.5
    assert (found[BAD]["first"], found[BAD]["last"]) == (CLOSES, OPENS - 1)


def test_instructions_by_which_most_hold_the_same_are_compared(held: Any) -> None:
    """A fifth of one that few have is wrong, which by itself would be as good as any other fifth."""
    texts = ["grab the block" if number < BAD else "take the block" for number in range(EPISODES_IN_ALL)]
    found = held([from_the_hand(n, BLACK if n == 1 else RED, text) for n, text in enumerate(texts)])
    assert list(found) == [1]


def test_things_that_differ_honestly_are_not_judged(held: Any) -> None:
    colors = [RED, BLUE, BLACK, (30, 180, 30), (220, 200, 30), (220, 220, 220)]
    assert not held([from_the_hand(number, colors[number % 6]) for number in range(EPISODES_IN_ALL)])


def test_what_the_instruction_names_is_no_outlier(held: Any) -> None:
    told = [(BLUE, "take the blue block") if number % 8 == 5 else (RED, "take the red block") for number in range(24)]
    assert not held([from_the_hand(number, color, task) for number, (color, task) in enumerate(told)])


@pytest.fixture
def late(tmp_path: Path) -> Path:
    """A dataset in which the actions of one episode are late."""
    episodes = [demonstration(number) for number in range(EPISODES_IN_ALL)]
    episodes[BAD] = is_late(episodes[BAD])
    return write(tmp_path / "d", episodes)


def test_what_is_good_is_selected(late: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = str(tmp_path / "scores.json")
    assert exit_code("dataset", "score", str(late), "--workers", "1", "--out", file) == 0
    assert f"episode {BAD}: the state follows the action by -2.0 frames" in capsys.readouterr().out.splitlines()[0]
    good, same = str(tmp_path / "good"), str(tmp_path / "same")
    assert exit_code("dataset", "select", str(late), "--where", "score > 0.8", "--scores", file, "--out", good) == 0
    assert f"{EPISODES_IN_ALL - 1} episodes" in capsys.readouterr().out
    assert exit_code("dataset", "drop", str(late), "--where", "score < 0.5", "--out", same) == 0
    assert exit_code("dataset", "diff", good, same) == 0
    capsys.readouterr()
    assert exit_code("dataset", "reorder", good, "--by", "score", "--scores", file, "--out", str(tmp_path / "x")) == 2
    assert "other episodes" in capsys.readouterr().err


def test_the_worst_is_shown_first(late: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flags = ("--episodes", "3:7", "--save", str(tmp_path / "v.rrd"))
    assert exit_code("view", str(late), "--rank", "score", *flags) == 0
    assert f"episode {BAD}: the state follows" in capsys.readouterr().err
    assert exit_code("report", str(late), "--out", str(tmp_path / "page.html")) == 0
    page = (tmp_path / "page.html").read_text()
    first = page.partition('<section id="episodes">')[2].partition("<article")[2].partition("</article>")[0]
    assert f"episode {BAD}<" in first
    assert "the state follows the action by -2.0 frames" in first
