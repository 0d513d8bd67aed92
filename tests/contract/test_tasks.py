"""Every task of the table: layouts, words, strict success, and failures that are noticed."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from demorec.config import EpisodePlan, GenerateConfig
from demorec.errors import ConfigError
from demorec.loop import Episode, ScriptAgent, Session, make_world, prepare
from demorec.tables import TASKS


def plan(task: str, index: int = 0, **options: object) -> EpisodePlan:
    config = replace(GenerateConfig(task=task, cameras=(), seed=11), **options)  # type: ignore[arg-type]
    return EpisodePlan(config=config, episode_index=index)


@pytest.mark.parametrize("task", TASKS.names())
def test_an_episode_succeeds(task: str) -> None:
    """That it repeats to the bit is shown in test_determinism.py for every row, and by replays in test_replay.py."""
    episode = prepare(plan(task))
    with make_world(episode.info) as world:
        session = Session.of_episode(world, episode)
        frames = list(session.run(ScriptAgent(episode)))
    assert session.outcome.success, (session.outcome, episode.info.instruction)
    assert session.outcome.num_frames == len(frames)


@pytest.mark.parametrize("task", TASKS.names())
def test_doing_nothing_is_a_failure(task: str) -> None:
    """The conditions of success do not hold at the start, so they cannot hold by chance."""
    episode = prepare(plan(task, 1))
    with make_world(episode.info) as world:
        world.reset(episode.info.scene)
        assert not all(check.passed for check in episode.task.evaluate(world))


@pytest.mark.parametrize("task", TASKS.names())
def test_layouts_are_apart_reachable_and_named(task: str) -> None:
    for index in range(30):
        scene = prepare(plan(task, index)).info.scene
        names = [body.name for body in scene.bodies]
        assert len(set(names)) == len(names)
        assert scene.goals
        for goal in scene.goals:
            assert scene.body(goal.object).movable
            assert not goal.onto or goal.onto in names
        standing = [body for body in scene.movable if body.world_from_body.position[2] < 0.05]
        for a, b in itertools.combinations(standing, 2):
            gap = float(np.hypot(*(a.world_from_body.position[:2] - b.world_from_body.position[:2])))
            reach = 0.5 * (max(a.shape.extents[:2]) + max(b.shape.extents[:2]))
            assert gap > reach, (index, a.name, b.name)


@pytest.mark.parametrize("task", TASKS.names())
def test_episodes_differ_and_are_pure_functions_of_the_plan(task: str) -> None:
    def episode(index: int, attempt: int = 0) -> Episode:
        return prepare(replace(plan(task, index), attempt=attempt))

    scenes = [episode(index).info.scene for index in range(4)]
    assert all(a != b for a, b in itertools.combinations(scenes, 2))
    assert episode(2).info == episode(2).info
    assert episode(2).info.scene != episode(2, attempt=1).info.scene


def test_instructions_come_in_several_wordings() -> None:
    for task in TASKS.names():
        words = {prepare(plan(task, index)).info.instruction for index in range(40)}
        assert len(words) >= 2, task


def test_a_fixed_layout_is_exact_and_refused_elsewhere() -> None:
    scenes = [prepare(plan("tutorial", index, fixed=True, variation="none")).info.scene for index in range(3)]
    assert scenes[0] == scenes[1] == scenes[2]
    cube = scenes[0].body("red_cube").world_from_body
    np.testing.assert_allclose(cube.position, [1.0, 1.0, 0.1], atol=1e-12)
    assert scenes[0].robot.scale == 1.3
    with pytest.raises(ConfigError, match="no fixed layout"):
        prepare(plan("stack", fixed=True))
