"""Recordings of an evaluation in which every rollout failed are read like any others."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.commands import exit_code
from support.recording import write_episode


@pytest.fixture
def evaluation(tmp_path: Path) -> Path:
    """Write two failed rollouts; readers of recordings only check that evaluation.json exists."""
    folder = tmp_path / "evaluation"
    (folder / "failed").mkdir(parents=True)
    (folder / "episodes").mkdir()
    (folder / "evaluation.json").write_text("{}")
    for index in range(2):
        write_episode(
            folder / "failed" / f"episode_{index:06d}.mcap", num_frames=12, success=False, episode_index=index
        )
    return folder


@pytest.mark.parametrize(
    ("command", "told"),
    [
        ("info", "failure"),
        ("check --no-images", "2 episodes, 24 frames"),
        ("view --save NEW.rrd", "kB"),
        ("report --no-checks --out NEW.html", "2 episodes"),
    ],
)
def test_its_failures_are_read(
    command: str, told: str, evaluation: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    name, *flags = command.replace("NEW", str(tmp_path / "new")).split()
    assert exit_code(name, evaluation, *flags) in ((0, 1) if name == "check" else (0,))
    assert told in capsys.readouterr().out
