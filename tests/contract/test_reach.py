"""An arm reaches every reachable target from any pose; unreachable ones are not requested."""

from __future__ import annotations

import math
from typing import Any

import pytest
from support.sim import episode, run

from demorec.episode.variation import Ranges

pytestmark = pytest.mark.slow


@pytest.mark.parametrize(
    ("task", "robot", "variation", "seed", "index"),
    [
        pytest.param("line_up", "iiwa", "full", 0, 3, id="found from another start only"),
        pytest.param("line_up", "iiwa", "full", 0, 110, id="no way to lift it at the nearest yaw"),
        pytest.param("sort_by_color", "panda", "full", 0, 252, id="no straight line leads there"),
        pytest.param("pick_shapes", "iiwa", "mild", 0, 126, id="a duck that slips when held at beak and tail"),
        pytest.param("line_up", "iiwa", "full", 77, 177, id="no line leads down, since the elbow gets straight"),
        pytest.param("tutorial", "iiwa", "none", 82000, 117, id="the cube falls to where no grasp is in reach"),
        pytest.param("tutorial", "iiwa", "full", 82000, 241, id="the cube is lower than its size implies"),
        pytest.param("sort_by_color", "panda", "full", 82000, 135, id="it cannot rise to the intended height"),
    ],
)
def test_episodes_that_once_failed(task: str, robot: str, variation: Any, seed: int, index: int) -> None:
    frames, outcome = run(episode(index, task=task, robot=robot, variation=variation, seed=seed))
    assert outcome.success
    on_purpose = [event for frame in frames for event in frame.events if "on purpose" in event.message]
    assert outcome.num_retries == len(on_purpose)
    assert frames[-1].observation.contact_force == 0


def test_a_cube_turned_into_a_finger_is_not_a_success() -> None:
    """It lands on an edge: a finger is 1.36 mm inside it, although there was no overlap when contacts were computed."""
    _, outcome = run(episode(235, task="pick_place", robot="iiwa", variation="none", seed=82000))
    assert (outcome.success, outcome.failure_reason) == (False, "crush")


def farthest(index: int, **config: Any) -> float:
    """Largest horizontal distance of a cube's centre from the base at the start, metres."""
    scene = episode(index, task="support.odd_tasks:Wide", variation="none", **config).info.simulated.scene
    return max(math.hypot(*body.world_from_body.position[:2].tolist()) for body in scene.movable)


@pytest.mark.parametrize("robot", ["panda", "iiwa"])
def test_layouts_are_redrawn_until_the_arm_reaches_everything(robot: str) -> None:
    """The Panda reaches 0.855 m from a shoulder 0.33 m up, with a hand of 0.21 m; the iiwa reaches no further."""
    assert max(farthest(index, robot=robot) for index in range(20)) < 0.83


def test_a_redrawn_layout_is_in_the_held_out_rectangle_too() -> None:
    ranges = Ranges(held_out_x=(0.4, 1.1), held_out_y=(0.0, 0.1))
    for index in range(10):
        made = episode(index, task="support.odd_tasks:Wide", variation="none", split="eval", ranges=ranges)
        (cube,) = made.info.simulated.scene.movable
        x, y, _ = cube.world_from_body.position.tolist()
        assert 0.4 <= x < 0.83
        assert 0.0 <= y <= 0.1
