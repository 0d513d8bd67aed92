"""Every task on every robot: identical bits again, alone or after others, and from the recorded commands."""

from __future__ import annotations

import pytest
from support.sim import episode, run
from support.tasks import PAIRS

from demorec.core.plain import from_json, to_json
from demorec.core.tables import ROBOTS
from demorec.episode.info import EpisodeInfo
from demorec.episode.variation import PRESET_NAMES
from demorec.loop import make_world

CASES = [(*pair, "full") for pair in PAIRS] + [
    ("pick_place", "panda", preset) for preset in PRESET_NAMES if preset != "full"
]
SAMPLED = [
    ("pick_anything", "panda", "full"),
    ("tutorial", "panda", "full"),
    *(("pick_place", robot, "full") for robot in ROBOTS.names()),
]
FAST = [("pick_place", "panda", "full")]


def check(task: str, robot: str, variation: str) -> None:
    prepared = episode(3, task=task, robot=robot, variation=variation)
    frames, outcome = run(prepared)
    info = from_json(to_json(prepared.info), EpisodeInfo)
    with make_world(info) as world:
        run(episode(4, task=task, robot=robot, variation=variation, max_episode_seconds=2.0), world)
        assert run(prepared, world)[1].final_state_digest == outcome.final_state_digest
        world.reset(info.simulated.scene)
        for frame in frames:
            assert world.observe().object_poses == frame.observation.object_poses
            world.apply(frame.command)
        assert world.state_digest() == outcome.final_state_digest


@pytest.mark.parametrize(("task", "robot", "variation"), FAST)
def test_repeats_and_replays_to_the_bit(task: str, robot: str, variation: str) -> None:
    check(task, robot, variation)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("task", "robot", "variation"),
    [pytest.param(*case, marks=() if case in SAMPLED else pytest.mark.long) for case in CASES if case not in FAST],
)
def test_every_row_repeats_and_replays_to_the_bit(task: str, robot: str, variation: str) -> None:
    check(task, robot, variation)
