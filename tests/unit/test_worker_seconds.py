"""CPU seconds of an attempt by stage, with a clock that advances by one at each look."""

from __future__ import annotations

import time
from itertools import count
from pathlib import Path

import pytest

from demorec.core.config import EpisodePlan, GenerateConfig
from demorec.generate.worker import make_episode


def test_every_second_counts_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("episodes", "failed", "unfinished"):
        (tmp_path / name).mkdir()
    config = GenerateConfig(task="tutorial", cameras=("front",), width=32, height=32)
    for index in range(2):
        looks = count()
        monkeypatch.setattr(time, "process_time", lambda looks=looks: float(next(looks)))
        seconds = make_episode(EpisodePlan(config=config, episode_index=index), tmp_path).seconds
        assert sum(seconds.values()) == next(looks) - 1
        assert all(value > 0 for value in seconds.values())
