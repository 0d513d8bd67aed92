"""The expert takes over from any state: a task that a policy or a person has begun, spoilt or nearly finished."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pytest
from support.sim import episode
from support.tasks import tasks_with_slow_ones

from demorec.core.geometry import Pose, quat_multiply
from demorec.episode.episode import HALT_PHASE
from demorec.loop import PreparedEpisode, ScriptAgent, Session, make_world
from demorec.sim.world import World
from demorec.tasks.grasping import hand_down, raised
from demorec.tasks.recovery import TAKE_OVER, is_served
from demorec.tasks.script import Behaviour, Step
from demorec.tasks.skills import Expert

Spoil = Callable[[World, Expert], Iterator[Step]]


def apply(world: World, steps: Iterator[Step]) -> list[Step]:
    """Send the commands of a script; return all of its steps."""
    done = []
    for step in steps:
        world.apply(step.action)
        done.append(step)
    return done


def begin(world: World, prepared: PreparedEpisode, until: str = "", frames: int = 10_000) -> None:
    """Run the script until a phase, or for a number of frames."""
    session = Session.of_episode(world, prepared)
    for frame in session.run(ScriptAgent(prepared)):
        if frame.phase == until or frame.frame_index == frames:
            return


def taken_over(world: World, prepared: PreparedEpisode) -> list[Step]:
    """Return the expert's frames from here on, after checking that the joints never jump."""
    before = world.arm.target.copy()
    steps = apply(world, prepared.task.resume(Expert(world, Behaviour(action_noise=0.0))))
    targets = np.array([before, *(step.action.joint_target for step in steps)])
    speeds = np.abs(np.diff(targets, axis=0)) * world.fps
    assert (speeds <= np.array(world.robot.velocity_limit)).all()
    return steps


def failed_conditions(world: World, prepared: PreparedEpisode) -> list[str]:
    return [check.name for check in prepared.task.evaluate(world) if not check.passed]


def close_beside(world: World, expert: Expert) -> Iterator[Step]:
    """Lower the closed hand next to the cube, where opening alone would push it."""
    pose = world.pose(world.scene.goals[0].object)
    beside = hand_down(pose.position + np.array([0.0, 0.075, 0.0]), 0.3)
    yield from expert.move(raised(beside, 0.1), speed=0.5)
    yield from expert.set_gripper(0.0, max_seconds=0.8, done=lambda: False)
    yield from expert.move(beside, speed=0.3)


def push_away(world: World, expert: Expert) -> Iterator[Step]:
    """Push the cube over the table with the closed hand, away from its observed place."""
    yield from close_beside(world, expert)
    yield from expert.move(raised(expert.tcp_target() @ Pose(position=np.array([0.02, 0.1, 0.0])), 0.0), speed=0.2)


def carry_tilted(world: World, expert: Expert) -> Iterator[Step]:
    """Grasp the cube, then tilt the hand by 25 degrees while carrying."""
    yield from expert.pick(world.scene.goals[0].object)
    tilt = np.array([np.sin(0.22), 0.0, 0.0, np.cos(0.22)])
    here = expert.tcp_target()
    tilted = Pose(position=here.position, quat_xyzw=quat_multiply(tilt, here.quat_xyzw))
    yield from expert.move(tilted, speed=0.3)


@pytest.mark.parametrize("spoil", [close_beside, push_away, carry_tilted], ids=lambda spoil: spoil.__name__)
def test_the_expert_finishes_from_any_state(spoil: Spoil) -> None:
    prepared = episode(2, variation="none")
    with make_world(prepared.info) as world:
        begin(world, prepared, frames=0)
        goal = world.scene.goals[0]
        start = world.pose(goal.object).position
        apply(world, spoil(world, Expert(world)))
        moved = float(np.abs(world.pose(goal.object).position - start).max())
        assert (moved > 0.03) == (spoil in (push_away, carry_tilted)), "it is not the state that the test is about"
        steps = taken_over(world, prepared)
        assert steps[0].phase == HALT_PHASE
        assert failed_conditions(world, prepared) == []
        phases = {step.phase for step in steps}
        assert ("approach" in phases) == (spoil is not carry_tilted), "the held object is not released first"


@pytest.mark.parametrize(("phase", "after"), [("descend", "close"), ("lower", "release")])
def test_a_policy_stopped_above_the_place_continues_downwards(phase: str, after: str) -> None:
    """Rising and returning would contradict every demonstration, which moves down from there."""
    prepared = episode(2, variation="none")
    with make_world(prepared.info) as world:
        seen = 0
        for frame in Session.of_episode(world, prepared).run(ScriptAgent(prepared)):
            seen += frame.phase == phase
            if seen == 7:
                break
        expert = Expert(world)
        apply(world, (expert.step() for _ in range(20)))  # it holds the arm in place
        height = float(expert.tcp().position[2])
        heights, phases = [], []
        for step in prepared.task.resume(Expert(world, Behaviour(action_noise=0.0))):
            world.apply(step.action)
            heights.append(float(expert.tcp().position[2]))
            phases.append(step.phase)
        assert failed_conditions(world, prepared) == []
        until = phases.index(after)
        assert set(phases[:until]) <= {HALT_PHASE, "perceive", phase}
        assert max(heights[:until]) < height + 0.003
        assert min(heights[:until]) < height - 0.03, "it is not the state that the test is about"


def test_finished_goals_are_left_alone() -> None:
    prepared = episode(0, variation="none")
    with make_world(prepared.info) as world:
        begin(world, prepared)
        goal = world.scene.goals[0]
        assert is_served(world, goal)
        before = world.pose(goal.object).vector()
        steps = taken_over(world, prepared)
        assert {step.phase for step in steps} <= {HALT_PHASE, TAKE_OVER}
        np.testing.assert_allclose(world.pose(goal.object).vector(), before, atol=1e-4)


@pytest.mark.slow
def test_a_wrong_object_in_the_hand_is_put_back() -> None:
    """An object grasped by mistake is put back in its place before the goal is pursued."""
    prepared = episode(0, task="pick_from_clutter", variation="none")
    with make_world(prepared.info) as world:
        begin(world, prepared, frames=0)
        wanted = {goal.object for goal in world.scene.goals}
        name = next(body.name for body in world.scene.movable if body.name not in wanted)
        start = world.pose(name).position
        expert = Expert(world)
        apply(world, expert.pick(name))
        assert expert.holds(name)
        taken_over(world, prepared)
        assert failed_conditions(world, prepared) == []
        assert np.hypot(*(world.pose(name).position - start)[:2]) < 0.02


@pytest.mark.slow  # every task is simulated twice; pick_place above is quick
@pytest.mark.parametrize("share", [0.5, *(pytest.param(share, marks=pytest.mark.long) for share in (0.25, 0.75))])
@pytest.mark.parametrize("task", tasks_with_slow_ones())
def test_every_task_continues_from_the_middle_of_its_script(task: str, share: float) -> None:
    prepared = episode(1, task=task, variation="mild")
    with make_world(prepared.info) as world:
        session = Session.of_episode(world, prepared)
        length = sum(1 for _ in session.run(ScriptAgent(prepared)))
        begin(world, prepared, frames=round(share * length))
        taken_over(world, prepared)
        assert failed_conditions(world, prepared) == []
