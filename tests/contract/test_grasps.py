"""Held objects are held at their faces: no finger sinks in, whatever the object's mass, friction and size."""

from __future__ import annotations

from dataclasses import replace

import pytest
from support.sim import episode, run

from demorec.core.tables import ROBOTS
from demorec.episode.scene import Shape
from demorec.episode.simulated import with_simulation
from demorec.loop import PreparedEpisode, ScriptAgent, Session, make_world

pytestmark = pytest.mark.slow

SINKING = 1e-3
"""Maximum depth of each finger in an object, metres."""


def smallest_opening(made: PreparedEpisode) -> float:
    """Return the gripper's smallest opening, metres, while it lifts and carries an object."""
    with make_world(made.info) as world:
        frames = Session.of_episode(world, made).run(ScriptAgent(made))
        return min(frame.observation.gripper_width for frame in frames if frame.phase in ("lift", "transport"))


def with_cube(made: PreparedEpisode, *, side: float, mass: float, friction: float) -> PreparedEpisode:
    """The same episode with another cube."""
    scene = made.info.simulated.scene
    cube = scene.body("red_cube")
    pose = replace(cube.world_from_body, position=cube.world_from_body.position * [1, 1, side / cube.shape.size[2]])
    cube = replace(
        cube,
        shape=Shape(kind="box", size=(side, side, side)),
        world_from_body=pose,
        mass=mass,
        lateral_friction=friction,
    )
    bodies = tuple(cube if body.name == cube.name else body for body in scene.bodies)
    return replace(made, info=with_simulation(made.info, scene=replace(scene, bodies=bodies)))


@pytest.mark.parametrize("robot", ROBOTS.names())
@pytest.mark.parametrize(
    ("side", "mass", "friction"), [(0.0328, 0.030, 0.42), (0.0318, 0.038, 0.42), (0.0328, 0.102, 0.456)]
)
def test_the_gap_between_fingers_equals_the_cubes_width(robot: str, side: float, mass: float, friction: float) -> None:
    """Small, light, slippery cubes: fingers with one contact each would rock and sink in by up to 13 mm."""
    scale = ROBOTS.load(robot).task_scale
    made = episode(957, robot=robot, seed=2718, split="train")
    side, mass = scale * side, scale * mass
    assert smallest_opening(with_cube(made, side=side, mass=mass, friction=friction)) > side - 2 * SINKING


def test_an_episode_that_crushes_an_object_is_a_failure() -> None:
    frames, outcome = run(episode(0, task="support.odd_tasks:HeavyHanded"))
    assert max(frame.observation.contact_force for frame in frames) > 50  # N; a frame later it would be above 100
    assert (outcome.success, outcome.failure_phase, outcome.failure_reason) == (False, "press", "crush")
    assert frames[-1].events[-1].message == "pressed on red_cube harder than a hand can"


def test_an_opening_hand_lets_go_at_any_frame_rate() -> None:
    """At 60 frames a second the fingers still touch the cube one frame after they begin to open."""
    frames, outcome = run(episode(0, task="tutorial", robot="iiwa", variation="full", fps=60, seed=72008))
    assert outcome.success
    assert frames[-1].observation.object_poses["red_cube"].position[2] < 0.3  # on the table, not in the hand at 0.8 m
