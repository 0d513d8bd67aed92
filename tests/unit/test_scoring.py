"""Scores of episodes in third-party datasets in which single episodes are spoilt."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.commands import exit_code
from support.doctor_bases import BASES, DemoDataset, record
from support.doctor_damage import RowFault, idle, on, put, shifted, spoilt
from support.doctor_writer import VideoStore, write_dataset

pytestmark = pytest.mark.slow

BAD, COUNT = 5, 24


def recorded(base: str = "openpi") -> DemoDataset:
    return record(BASES[base], seed=4, episodes=COUNT, cameras=False)


def write(dataset: DemoDataset, folder: Path) -> Path:
    return write_dataset(dataset, folder / "d", VideoStore(folder))


def scores(root: Path, capsys: pytest.CaptureFixture[str]) -> list[dict[str, Any]]:
    """Verdicts on the episodes, in their order."""
    exit_code("check", root, "--json")
    return sorted(json.loads(capsys.readouterr().out)["episodes"], key=lambda episode: episode["episode"])


@pytest.mark.parametrize(
    ("base", "spoil", "words"),
    [
        ("openpi", idle(0.5, 4), "pauses for"),
        ("two arms", idle(0.5, 4), "pauses for"),
        ("openpi", spoilt("detour"), "takes a detour of"),
        ("openpi", spoilt("jerky"), "the action shakes"),
        ("openpi", on("action", shifted(0.3)), "the state follows the action"),
        ("openpi", spoilt("cut off"), "the gripper is switched"),
        ("openpi", on("state", put(np.nan, slice(7, 8))), "NaN or infinite numbers"),
    ],
)
def test_the_damaged_episode_is_the_worst_with_the_reason(
    base: str, spoil: RowFault, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Next to a resting arm, too."""
    dataset = recorded(base)
    spoil(dataset, BAD)
    found = scores(write(dataset, tmp_path), capsys)
    assert min(found, key=lambda episode: episode["score"])["episode"] == BAD
    assert found[BAD]["score"] < 0.5
    assert any(words in reason for reason in found[BAD]["reasons"])
    assert all(episode["score"] > 0.6 for episode in found if episode["episode"] != BAD)


def test_grippers_held_at_any_opening_switch_as_usual(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Objects have all sizes, and the largest of them leave the gripper nearer to open than to closed."""
    dataset = recorded()
    for number, episode in enumerate(dataset.episodes):
        for values in episode.columns.values():
            values[:, -1] = np.maximum(values[:, -1], (0, 6, 12, 18, 12, 24)[number % 6])
    assert [each["reasons"] for each in scores(write(dataset, tmp_path), capsys) if each["score"] < 0.6] == []


@pytest.fixture
def late(tmp_path: Path) -> Path:
    """A dataset in which the actions of one episode are late."""
    dataset = recorded()
    on("action", shifted(0.3))(dataset, BAD)
    return write(dataset, tmp_path)


def test_good_episodes_are_selected(late: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    good, same = tmp_path / "good", tmp_path / "same"
    assert exit_code("dataset", "select", late, "--where", 'verdict != "broken"', "--out", good) == 0
    assert f"{COUNT - 1} of {COUNT} episodes" in capsys.readouterr().out
    assert exit_code("dataset", "drop", late, "--where", "score < 0.1", "--out", same) == 0
    assert exit_code("dataset", "diff", good, same) == 0


def test_the_worst_is_shown_first(late: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flags = ("--episodes", "3:7", "--save", tmp_path / "v.rrd")
    assert exit_code("view", late, "--rank", "score", *flags) == 0
    worst = next(line for line in capsys.readouterr().err.splitlines() if line.startswith("broken"))
    assert f"episode {BAD}: " in worst
    assert "its action is" in worst
    assert exit_code("report", late, "--out", tmp_path / "page.html") == 0
    page = (tmp_path / "page.html").read_text()
    first = page.partition('<section id="episodes">')[2].partition("<article")[2].partition("</article>")[0]
    assert f"episode {BAD}<" in first
    assert "the state follows it by" in first
