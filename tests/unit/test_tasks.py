"""Layouts, grasps and checks: each condition of success fails if, and only if, it is violated."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from numpy.typing import NDArray
from support.sim import body_index, episode, run

from demorec.core.geometry import Pose
from demorec.episode.episode import Frame
from demorec.episode.simulated import with_simulation
from demorec.loop import PreparedEpisode, make_world
from demorec.sim.world import World
from demorec.tasks.grasping import raised
from demorec.tasks.script import Behaviour


def rolled(degrees: float) -> Pose:
    """A rotation about x."""
    half = math.radians(degrees) / 2
    return Pose(quat_xyzw=np.array([math.sin(half), 0, 0, math.cos(half)]))


def shifted(pose: Pose, x: float = 0.0, z: float = 0.0) -> Pose:
    return Pose(position=pose.position + np.array([x, 0.0, z]), quat_xyzw=pose.quat_xyzw)


@pytest.fixture(scope="module")
def finished() -> Iterator[tuple[PreparedEpisode, World]]:
    """A world in which the episode has just succeeded."""
    prepared = episode(0)
    with make_world(prepared.info) as world:
        _, outcome = run(prepared, world)
        assert outcome.success
        yield prepared, world


BREAKAGES: dict[str, Callable[[Pose], Pose]] = {
    "distance_to_goal": lambda pose: shifted(pose, x=0.021),
    "height_error": lambda pose: shifted(pose, z=0.0041),
    "tilt": lambda pose: pose @ rolled(5.2),
}


def failed(prepared: PreparedEpisode, world: World) -> set[str]:
    return {check.name for check in prepared.task.evaluate(world) if not check.passed}


@pytest.mark.parametrize("name", BREAKAGES)
def test_a_misplaced_cube_fails_its_check(finished: tuple[PreparedEpisode, World], name: str) -> None:
    prepared, world = finished
    good = world.pose("red_cube")
    world.set_state(object_poses={"red_cube": good})
    world.client.performCollisionDetection()
    assert failed(prepared, world) == set()
    world.set_state(object_poses={"red_cube": BREAKAGES[name](good)})
    world.client.performCollisionDetection()
    assert name in failed(prepared, world)
    world.set_state(object_poses={"red_cube": good})


def test_a_cube_that_floats_moves_or_is_held_fails(finished: tuple[PreparedEpisode, World]) -> None:
    prepared, world = finished
    cube, good = body_index(world, "red_cube"), world.pose("red_cube")
    world.set_state(object_poses={"red_cube": raised(good, 0.003)})
    world.client.performCollisionDetection()
    assert failed(prepared, world) == {"on_support"}
    world.set_state(object_poses={"red_cube": good})
    world.client.performCollisionDetection()
    world.client.resetBaseVelocity(cube, [0.011, 0, 0], [0, 0, 0])
    assert failed(prepared, world) == {"speed"}
    world.client.resetBaseVelocity(cube, [0, 0, 0], [0, 0, 0.11])
    assert failed(prepared, world) == {"spin"}
    world.client.resetBaseVelocity(cube, [0, 0, 0], [0, 0, 0])
    joints = world.observe().joint_position
    world.set_state(joint_position=np.concatenate([joints[:7], [0.034, 0.034]]))
    assert failed(prepared, world) == {"gripper_width"}
    world.set_state(joint_position=joints, object_poses={"red_cube": raised(world.arm.world_from_tcp(), 0.03)})
    world.client.performCollisionDetection()
    assert "touched_by_robot" in failed(prepared, world)
    world.set_state(object_poses={"red_cube": good})


def test_any_position_in_a_tray_succeeds() -> None:
    """The floor of tray.urdf is 0.26 x 0.20 m; a cube on the table next to it, or on its wall, is not in it."""
    prepared = episode(0, task="place_in_tray")
    with make_world(prepared.info) as world:
        _, outcome = run(prepared, world)
        assert outcome.success
        [distance] = [check.value for check in outcome.checks if check.name == "distance_to_goal"]
        assert distance == 0.0
        cube, tray = world.pose("red_cube"), world.pose("blue_tray")
        height, half = (tray.inverse() @ cube).position[2], max(world.body("red_cube").shape.extents) / 2

        def breaks(x: float, y: float, z: float = 0.0) -> set[str]:
            world.set_state(object_poses={"red_cube": tray @ Pose.from_yaw((x, y, height + z), 0.0)})
            world.client.performCollisionDetection()
            return failed(prepared, world)

        for x in (-0.13 + half + 1e-3, 0.13 - half - 1e-3):
            assert breaks(x, 0.0) == breaks(0.0, 0.0) == breaks(0.0, 0.10 - half - 1e-3) == set()
        assert breaks(0.13, 0.0, z=0.015) == {"height_error"}
        assert {"distance_to_goal", "on_support"} <= breaks(0.14 + half + 0.01, 0.0, z=-0.004)


def behave(prepared: PreparedEpisode, **values: float) -> PreparedEpisode:
    return dataclasses.replace(prepared, behaviour=Behaviour(**values))


def test_a_deliberate_miss_is_flagged_and_corrected() -> None:
    frames, outcome = run(behave(episode(5), miss_x=0.03, miss_y=0.03))
    assert outcome.success
    assert outcome.num_retries == 1
    flagged = {frame.phase for frame in frames if frame.is_deliberate_miss}
    assert flagged == {"approach", "descend", "close"}
    unflagged = {frame.phase for frame in frames if not frame.is_deliberate_miss}
    assert {"recover", "approach", "descend", "close", "lift", "transport"} <= unflagged
    assert [event.name for frame in frames for event in frame.events] == ["grasp", "miss", "grasp", "place"]


@pytest.mark.parametrize("robot", ["panda", "iiwa"])
@pytest.mark.parametrize(
    ("index", "task", "offset"),
    [
        pytest.param(0, "pick_place", 0.0, marks=pytest.mark.slow),
        pytest.param(1, "pick_place", 0.005, marks=pytest.mark.slow),
        (2, "pick_place", -0.015),  # opposite to the miss, by the maximum
        pytest.param(3, "pick_place", -0.005, marks=pytest.mark.slow),
        (4, "pick_shapes", 0.005),
        (6, "pick_from_clutter", -0.005),
    ],
)
def test_a_deliberate_miss_touches_nothing(robot: str, task: str, index: int, offset: float) -> None:
    """At 1.5 times the speed and with bodies of all sizes, no finger lands on one or pushes one on opening."""
    prepared = episode(index, robot=robot, task=task)
    side = 1.0 if index % 2 == 0 else -1.0
    frames, outcome = run(behave(prepared, speed=1.5, miss_x=0.03 * side, miss_y=0.012, grasp_offset=offset))
    assert outcome.success
    events = [event.name for frame in frames for event in frame.events]
    assert events.count("miss") == 1
    last = max(frame.frame_index for frame in frames if frame.is_deliberate_miss)
    opened = next(f for f in frames[last:] if f.phase != "close" and f.observation.gripper_width > 0.078)
    assert max(frame.observation.contact_force for frame in frames[: opened.frame_index]) == 0.0
    for name, start in frames[5].observation.object_poses.items():  # all are at rest by then
        assert np.abs(opened.observation.object_poses[name].position - start.position).max() < 3e-4, name


@pytest.mark.slow
def test_perception_error_shifts_the_grasp() -> None:
    clean, _ = run(behave(episode(5), action_noise=0.0))
    wrong, outcome = run(behave(episode(5), action_noise=0.0, perception_x=0.005))
    assert outcome.success

    def grasp(frames: list[Frame]) -> NDArray[np.float64]:
        return next(frame for frame in frames if frame.phase == "close").action.base_from_tcp_target.position

    assert (grasp(wrong) - grasp(clean))[0] == pytest.approx(0.005, abs=5e-4)


def test_an_object_out_of_reach_gives_up_with_its_phase() -> None:
    prepared = episode(0)
    far = dataclasses.replace(
        prepared.info.simulated.scene.body("red_cube"), world_from_body=Pose(position=np.array([0.8, 0.6, 0.025]))
    )
    bodies = tuple(far if b.name == "red_cube" else b for b in prepared.info.simulated.scene.bodies)
    scene = dataclasses.replace(prepared.info.simulated.scene, bodies=bodies)
    frames, outcome = run(dataclasses.replace(prepared, info=with_simulation(prepared.info, scene=scene)))
    assert not outcome.success
    assert (outcome.failure_phase, outcome.failure_reason) == ("perceive", "unreachable")
    assert [event.name for frame in frames for event in frame.events] == ["unreachable"]


@pytest.mark.slow
def test_a_cube_that_slips_is_dropped_and_fails_after_three_tries() -> None:
    prepared = episode(0)
    slippery = dataclasses.replace(prepared.info.simulated.scene.body("red_cube"), lateral_friction=0.0, mass=2.0)
    bodies = tuple(slippery if b.name == "red_cube" else b for b in prepared.info.simulated.scene.bodies)
    scene = dataclasses.replace(prepared.info.simulated.scene, bodies=bodies)
    _, outcome = run(dataclasses.replace(prepared, info=with_simulation(prepared.info, scene=scene)))
    assert not outcome.success
    assert outcome.num_retries == 2
    assert outcome.failure_phase in ("lift", "close", "transport")
    assert outcome.failure_reason
