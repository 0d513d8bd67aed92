"""A policy's rollout as a recording, without LeRobot: the policy is a function of what it sees."""

from __future__ import annotations

import functools
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from demorec.core.config import EpisodePlan, GenerateConfig
from demorec.core.plain import to_plain
from demorec.learn.evaluate import rollouts
from demorec.learn.evaluate.rollouts import Evaluation, Settings, make_rollout
from demorec.mcap import SimulatedRecording
from demorec.replay import ReplayOptions, open_file, replay_all
from demorec.runs.find import EVALUATION_NAME

LENGTH = 8


class Waving:
    """Turns the first joint on from where it is seen, and notes what it saw and said."""

    def __init__(self, *_: Any, **__: Any) -> None:
        self.seen: list[Any] = []
        self.said: list[Any] = []

    def reset(self, seed: int) -> None:
        assert seed == 3

    def act(self, observation: dict[str, Any], instruction: str) -> Any:
        assert "cube" in instruction
        self.seen.append(observation["agent_pos"])
        self.said.append(observation["agent_pos"] + np.array([0.01] + [0.0] * 7, dtype=np.float32))
        return self.said[-1]


def test_a_rollout_is_recorded_as_it_was_and_replays_to_the_bit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy = Waving()
    monkeypatch.setattr(rollouts, "Policy", lambda *_, **__: policy)
    monkeypatch.setattr(rollouts, "find_checkpoint", lambda path: path)
    monkeypatch.setattr(rollouts, "_stage", functools.lru_cache(rollouts._stage.__wrapped__))
    settings = Settings(
        policy="p",
        policy_type="waving",
        policy_digest="0",
        config=GenerateConfig(cameras=()),
        action="joint",
        episode_length=LENGTH,
    )
    (tmp_path / EVALUATION_NAME).write_text(json.dumps(to_plain(Evaluation(settings=settings))))
    for place in ("episodes", "failed"):
        (tmp_path / place).mkdir()
    attempt = make_rollout(EpisodePlan(config=settings.config, episode_index=3), tmp_path)
    assert (attempt.success, attempt.phase, attempt.num_frames) == (False, "reach", LENGTH)
    path = tmp_path / attempt.file
    with SimulatedRecording(path) as recording:
        columns = recording.columns()
        assert columns.num_frames == len(policy.said) == LENGTH
        assert {frame.phase for frame in recording} == {"policy"}
    for t in range(LENGTH):
        assert np.array_equal(columns.joint_position[t, :7].astype(np.float32), policy.seen[t][:7])
        np.testing.assert_allclose(columns.command_joint_target[t], policy.said[t][:7], atol=1e-7)
    options = ReplayOptions()
    report, _ = next(iter(replay_all([open_file(path, options)], options)))
    assert report.is_identical, report
