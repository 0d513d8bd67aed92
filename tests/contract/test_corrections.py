"""The expert takes over from a policy, which is here a function of what it sees."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from support.export import data_table, export, info
from support.recording import write_episode

from demorec.check.report import CheckOptions, Subject, check_subject
from demorec.config import EpisodePlan, GenerateConfig
from demorec.evaluate import rollouts
from demorec.evaluate.correction import Watch, read_takeover
from demorec.evaluate.moments import TakeOver
from demorec.evaluate.rollouts import Evaluation, Settings, make_rollout
from demorec.geometry import Array, Pose
from demorec.gym_env import Situation
from demorec.loop import prepare
from demorec.plain import to_plain
from demorec.recording import Recording
from demorec.replay import ReplayOptions, open_file, replay_all
from demorec.runs.find import EVALUATION_NAME
from demorec.runs.run_file import Attempt
from demorec.scene.episode import POLICY_PHASE, Observation

FPS = 30


class Lazy:
    """Reaches down for half a second with a closed hand, and then stays there."""

    def __init__(self, *_: Any, **__: Any) -> None:
        self.calls = 0

    def reset(self, seed: int) -> None:
        self.calls = 0

    def act(self, observation: dict[str, Any], instruction: str) -> Any:
        self.calls += 1
        target = np.array(observation["agent_pos"], dtype=np.float64)
        target[3] -= 0.03 if self.calls < FPS // 2 else 0.0
        target[-1] = 0.0
        return target


@pytest.fixture(scope="module")
def rollout(tmp_path_factory: pytest.TempPathFactory) -> tuple[Attempt, Path]:
    """One rollout of the lazy policy, which is stuck after half a second, and its recording."""
    folder = tmp_path_factory.mktemp("corrections")
    settings = Settings(
        policy="p",
        policy_type="lazy",
        policy_digest="0",
        config=GenerateConfig(cameras=(), split="train"),
        action="joint",
        takeover=TakeOver(stuck_seconds=1.0),
    )
    (folder / EVALUATION_NAME).write_text(json.dumps(to_plain(Evaluation(settings=settings))))
    for place in ("episodes", "failed"):
        (folder / place).mkdir()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rollouts, "Policy", Lazy)
        patch.setattr(rollouts, "find_checkpoint", lambda path: path)
        patch.setattr(rollouts, "_stage", rollouts._Stage())
        attempt = make_rollout(EpisodePlan(config=settings.config, episode_index=3), folder)
    return attempt, folder / attempt.file


def test_a_stuck_policy_is_corrected_and_the_episode_replays(rollout: tuple[Attempt, Path]) -> None:
    attempt, path = rollout
    assert attempt.success
    with Recording(path) as recording:
        phases = recording.columns().phase
        assert recording.info.origin == "correction of lazy 0"
        assert recording.info.behaviour["action_noise"] == 0.0
        assert recording.outcome is not None
        assert recording.outcome.success
        (event,) = [event for _, event in recording.events() if event.name == "take_over"]
    handover = phases.index("take_over")
    assert FPS < handover < 3 * FPS
    assert set(phases[:handover]) == {POLICY_PHASE}
    assert POLICY_PHASE not in phases[handover:]
    assert event.message == "the expert takes over: the policy is stuck"
    taken = read_takeover(path)
    assert taken is not None
    assert (taken.reason, taken.num_frames) == ("the policy is stuck", len(phases) - handover)
    options = ReplayOptions()
    report, _ = next(iter(replay_all([open_file(path, options)], options)))
    assert report.is_identical, report


def test_no_check_fails_on_a_correction(rollout: tuple[Attempt, Path]) -> None:
    report = check_subject(Subject(path=rollout[1], kind="recording"), CheckOptions())
    assert [result.check for result in report.results if result.level == "fail"] == []
    skipped = {result.check: result.detail for result in report.results if result.level == "skip"}
    for name in ("story", "phases_match_motion", "deliberate_misses", "noise_as_said"):
        assert "a policy acted" in skipped[name]


def test_the_dataset_tells_who_acted(rollout: tuple[Attempt, Path], tmp_path: Path) -> None:
    """As LeRobot's own DAgger writes it: a column of booleans, true where the expert acted."""
    export(rollout[1], tmp_path / "plain")
    assert "intervention" not in info(tmp_path / "plain")["features"]
    export(rollout[1], tmp_path / "dataset", intervention=True)
    assert info(tmp_path / "dataset")["features"]["intervention"] == {"dtype": "bool", "shape": [1], "names": None}
    with Recording(rollout[1]) as recording:
        acted = [frame.phase != "policy" for frame in recording]
    column = data_table(tmp_path / "dataset").column("intervention").to_pylist()
    assert column == acted
    assert set(column) == {False, True}
    export(rollout[1], tmp_path / "slow", intervention=True, fps=15)
    assert data_table(tmp_path / "slow").column("intervention").to_pylist() == acted[::2]


def test_a_demonstration_has_no_interventions(tmp_path: Path) -> None:
    export(write_episode(tmp_path / "plain.mcap", num_frames=5, cameras=()), tmp_path / "dataset", intervention=True)
    assert data_table(tmp_path / "dataset").column("intervention").to_pylist() == [False] * 5


@dataclass
class Hand:
    """As much of an observation as a watch looks at: a hand that is open and somewhere."""

    position: Array
    gripper_width: float = 0.08

    @property
    def base_from_tcp(self) -> Pose:
        return Pose(position=self.position)


def situations(speed: float) -> list[Situation]:
    """Ten seconds and a frame, in which the hand moves with so many m/s."""
    hands = [Hand(np.array([speed * frame / FPS, 0.0, 0.2])) for frame in range(301)]
    return [
        Situation(
            frame_index=frame,
            observation=cast(Observation, hand),
            images={},
            last_frame=None,
            checks=(),
            is_success=False,
        )
        for frame, hand in enumerate(hands)
    ]


@pytest.mark.parametrize(
    ("takeover", "speed", "expected"),
    [
        (TakeOver(stuck_seconds=1.0), 0.0, (FPS - 1, "the policy is stuck")),
        (TakeOver(stuck_seconds=1.0), 0.02, (300, "the policy has had its time")),  # m/s: 2 cm in a second is no rest
        (TakeOver(stuck_seconds=0.0), 0.0, (300, "the policy has had its time")),
        (TakeOver(stuck_seconds=0.0, after_seconds=4.0), 0.0, (120, "the policy has had its time")),
    ],
)
def test_the_moment(takeover: TakeOver, speed: float, expected: tuple[int, str]) -> None:
    episode = prepare(EpisodePlan(config=GenerateConfig(cameras=()), episode_index=0))
    watch = Watch(takeover, episode, max_frames=300)
    told = enumerate(map(watch.reason, situations(speed)))
    assert next((frame, reason) for frame, reason in told if reason) == expected


def test_random_moments_are_those_of_the_episode_and_as_many_as_asked_for() -> None:
    rules = TakeOver(stuck_seconds=0.0, random_share=0.5)
    moments, seen = [], situations(0.0)
    for index in range(200):
        episode = prepare(EpisodePlan(config=GenerateConfig(cameras=()), episode_index=index))
        for _ in range(2):
            watch = Watch(rules, episode, max_frames=300)
            moments.append(next((frame, why) for frame, why in enumerate(map(watch.reason, seen)) if why))
    assert moments[::2] == moments[1::2]
    random = [frame for frame, why in moments[::2] if why == "a random moment"]
    assert 75 < len(random) < 125  # 100 +- 3.5 standard deviations of the binomial distribution
    assert min(random) < 30
    assert max(random) > 270
