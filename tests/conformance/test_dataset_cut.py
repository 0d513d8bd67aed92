"""`demorec dataset cut`: as LeRobot reads them, the parts have exactly the frames of their episode."""

from __future__ import annotations

from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from support.commands import exit_code
from support.datasets import items, same, write_with_lerobot
from support.export import data_table, export, make_run
from support.foreign_dataset import write_foreign

pytestmark = [
    pytest.mark.usefixtures("hf_datasets_cache"),
    pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning"),
]
cut = partial(exit_code, "dataset", "cut")


def parts_of(frames: list[dict[str, Any]], *edges: int) -> list[list[dict[str, Any]]]:
    """Slice the frames at the edges; each part's timestamps start at 0."""
    spans = pairwise(edges)
    return [
        [frame | {"timestamp": np.asarray(number / 10, np.float32)} for number, frame in enumerate(frames[first:last])]
        for first, last in spans
    ]


@pytest.mark.slow
@pytest.mark.parametrize("video", [True, False])
def test_parts_at_given_frames(video: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = write_with_lerobot(tmp_path / "d", video=video, episodes=3)
    assert cut(root, "--at", "0=5,9", "2=6", "--out", tmp_path / "new") == 0
    told = capsys.readouterr().out
    assert "episode 0: 3 parts of 12 frames, 0:5, 5:9, 9:12" in told
    assert "6 parts of 3 episodes, 39 of 39 frames" in told
    # A group of pictures has two images, so a part that begins inside one keeps the keyframe before it.
    assert ("2 images next to cuts stay in the videos" in told) == video
    whole, found = items(root), items(tmp_path / "new")
    expected = [*parts_of(whole[0], 0, 5, 9, 12), whole[1], *parts_of(whole[2], 0, 6, 14)]
    assert [same(a, b) for a, b in zip(found, expected, strict=True)] == [True] * 6
    assert exit_code("check", tmp_path / "new", "--lerobot", "--only", "contradicting_counts", "lerobot_opens") == 0


def collapsed(root: Path, lengths: tuple[int, ...], *, slow: int = 1) -> Path:
    """Several rollouts of a smooth motion stored as one episode (strands-labs/robots#708).

    A sensor may repeat each value.
    """
    rng = np.random.default_rng(0)
    values = [np.cos(np.linspace(0, 3, n))[:, None] * 3 + rng.normal(0, 0.5, 3) for n in lengths]
    motion = np.concatenate([np.repeat(each[::slow], slow, axis=0)[: len(each)] for each in values])
    write_foreign(root, episodes=1, length=sum(lengths), state=dict(zip("abc", motion.T, strict=True)))
    return root


@pytest.mark.parametrize("slow", [1, 3])
def test_collapsed_rollouts_come_apart_where_the_state_jumps(slow: int, tmp_path: Path) -> None:
    lengths = (60, 45, 75)
    root = collapsed(tmp_path / "d", lengths, slow=slow)
    assert cut(root, "--jumps", "--out", tmp_path / "new") == 0
    table = data_table(tmp_path / "new")
    assert np.bincount(table.column("episode_index").to_numpy()).tolist() == list(lengths)
    for name in ("observation.state", "action"):
        assert table.column(name).to_pylist() == data_table(root).column(name).to_pylist()
    assert table.column("frame_index").to_pylist() == [frame for length in lengths for frame in range(length)]
    assert cut(tmp_path / "new", "--jumps", "--out", tmp_path / "again") == 0
    assert pq.read_table(tmp_path / "again/meta/episodes").num_rows == len(lengths)


def test_a_closing_gripper_is_not_a_jump(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arm = np.linspace(0, 1, 40)
    state = {"shoulder": arm, "gripper": (arm > 0.5).astype(float)}
    root = write_foreign(tmp_path / "d", episodes=1, length=40, state={name: list(v) for name, v in state.items()})
    assert cut(root, "--jumps", "--dry-run") == 0
    assert "1 of 1 episode, 40 of 40 frames" in capsys.readouterr().out
    assert cut(root, "--jumps", "--feature", "observation.state", "--dry-run") == 0
    assert "2 parts of 40 frames, 0:20, 20:40" in capsys.readouterr().out


def test_pauses_are_removed_and_moving_frames_stay(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    moving = [np.linspace(begin, begin + 1, 20) for begin in range(3)]
    motion = [*moving[0], *np.full(30, 1.0), *moving[1], *np.full(5, 2.0), *moving[2]]
    root = write_foreign(tmp_path / "d", episodes=1, length=95, state={"shoulder": motion})
    assert cut(root, "--pauses", "1", "--margin", "2", "--out", tmp_path / "new") == 0
    told = capsys.readouterr().out
    assert "2 parts of 95 frames, 0:21, 49:95" in told  # 5 still frames are shorter than a second
    kept = [*motion[:21], *motion[49:]]
    found = data_table(tmp_path / "new").column("observation.state").to_pylist()
    assert np.array_equal(np.array(kept, np.float32), np.array(found, np.float32))
    assert cut(tmp_path / "new", "--pauses", "1", "--dry-run") == 0
    assert "2 of 2 episodes, 67 of 67 frames" in capsys.readouterr().out


def test_only_the_last_part_ends_as_the_episode_did(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", (12, 9), cameras=())
    export(run, tmp_path / "d")
    assert cut(tmp_path / "d", "--at", "0=5", "--out", tmp_path / "new") == 0
    table = data_table(tmp_path / "new")
    for name in ("next.success", "next.done"):
        assert table.column(name).to_pylist() == data_table(tmp_path / "d").column(name).to_pylist()
    sidecar = pq.read_table(tmp_path / "new/demorec/episodes").to_pylist()
    assert [row["success"] for row in sidecar] == [None, True, True]
    assert exit_code("check", tmp_path / "new", "--only", "contradicting_counts", "dataset_sidecar") == 0
    assert exit_code("dataset", "repair", tmp_path / "new", "--out", tmp_path / "again") == 0
    assert not (tmp_path / "again").exists()


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ((), "Name the cuts"),
        (("--jumps", "--pauses", "1"), "Name the cuts"),
        (("--at", "7=3"), "Episode 7 does not exist"),
        (("--at", "0=8"), "give 1 to 7"),
        (("--at", "0=a"), "are numbers"),
        (("--pauses", "0.1"), "two frames"),
        (("--jumps", "--feature", "forces"), "forces"),
    ],
)
def test_impossible_cuts_are_refused(
    words: tuple[str, ...], told: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = write_foreign(tmp_path / "d")
    assert cut(root, *words, "--out", tmp_path / "new") == 2
    assert told in capsys.readouterr().err
    assert not (tmp_path / "new").exists()
