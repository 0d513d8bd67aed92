"""Variation: presets, ranges, stratified layouts, held-out split; drawn values are recorded and change nothing else."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from support.sim import episode, first_frame, run

from demorec.core.config import GenerateConfig
from demorec.core.errors import ConfigError, SceneError
from demorec.core.geometry import Pose
from demorec.episode.variation import PRESETS, Ranges, resolve, stated_error
from demorec.tasks.sampling import stratified_point


def cube_starts(count: int, **config: Any) -> NDArray[np.float64]:
    starts = [
        episode(index, **config).info.simulated.scene.body("red_cube").world_from_body.position
        for index in range(count)
    ]
    return np.array(starts)[:, :2]


def test_the_users_range_overrides_the_preset() -> None:
    merged = resolve("full", Ranges(speed=(0.9, 0.95)))
    assert merged.speed == (0.9, 0.95)
    assert merged.action_noise == PRESETS["full"].action_noise
    speeds = [episode(i, variation="full", ranges=Ranges(speed=(0.9, 0.95))).behaviour.speed for i in range(20)]
    assert 0.9 <= min(speeds) < max(speeds) <= 0.95
    sides = [
        episode(i, ranges=Ranges(cube_side=(0.04, 0.041))).info.simulated.scene.body("red_cube").shape.size[0]
        for i in range(9)
    ]
    assert 0.04 <= min(sides) <= max(sides) <= 0.041


def test_none_varies_nothing_but_the_layout() -> None:
    first, second = episode(0, variation="none"), episode(1, variation="none")
    assert first.behaviour == second.behaviour
    a, b = first.info.simulated.scene, second.info.simulated.scene
    assert (a.light, a.robot, a.physics, a.body("table")) == (b.light, b.robot, b.physics, b.body("table"))
    assert a.robot.joint_position == first.info.simulated.robot.home_q
    assert a.body("red_cube").world_from_body != b.body("red_cube").world_from_body
    frames, outcome = run(first)
    assert outcome.success
    assert all(np.array_equal(f.action.joint_target, f.command.joint_target) for f in frames)


def test_full_varies_everything_within_its_ranges_and_records_it() -> None:
    episodes = [episode(i, variation="full", cameras=("front", "wrist")) for i in range(60)]
    scenes = [prepared.info.simulated.scene for prepared in episodes]
    ranges = PRESETS["full"]

    def spans(name: str, values: Sequence[float], share: float = 0.7) -> None:
        low, high = ranges.range(name)
        assert low - 1e-9 <= min(values)
        assert max(values) <= high + 1e-9
        assert max(values) - min(values) > share * (high - low), name

    spans("speed", [p.info.simulated.behaviour["speed"] for p in episodes])
    spans("approach_height", [p.info.simulated.behaviour["approach_height"] for p in episodes])
    spans("action_noise", [p.info.simulated.behaviour["action_noise"] for p in episodes])
    spans("gravity_offset", [scene.physics.gravity[2] + 9.81 for scene in scenes])
    spans("table_height", [-scene.robot.world_from_base.position[2] for scene in scenes])
    spans("light_ambient", [scene.light.ambient for scene in scenes])
    spans("light_elevation", [math.asin(scene.light.direction[2]) for scene in scenes])
    spans("damping", [scene.body("red_cube").linear_damping for scene in scenes])
    counts = {sum(body.role == "distractor" for body in scene.bodies) for scene in scenes}
    assert counts == {0, 1, 2, 3}
    misses = sum(p.behaviour.misses for p in episodes)
    assert 1 <= misses <= 15
    assert 20 < sum(scene.body("table").texture is not None for scene in scenes) < 50
    assert all(p.info.simulated.behaviour["perception_x"] == 0 for p in episodes)
    # Red stays the strongest channel of objects that an instruction calls red.
    assert all(np.argmax(scene.body("red_cube").rgba[:3]) == 0 for scene in scenes)


@pytest.mark.slow
def test_the_appearance_does_not_affect_the_physics() -> None:
    """A preset that changes only the appearance gives the same bits of state."""
    plain = run(episode(3))[1].final_state_digest
    looks = Ranges(
        light_turn=(1.0, 1.0), light_ambient=(0.4, 0.4), surface_color=1.0, texture_probability=1.0, object_shade=0.3
    )
    varied = episode(3, ranges=looks)
    assert varied.info.simulated.scene.body("table").texture is not None
    assert run(varied)[1].final_state_digest == plain


def test_calibration_error_is_between_truth_and_record() -> None:
    ranges = Ranges(calibration_position=0.01, calibration_rotation=0.05)
    drawn: dict[str, Any] = {"cameras": ("front", "wrist"), "width": 32, "height": 32, "renderer": "tiny"}
    prepared, exact = episode(0, ranges=ranges, **drawn), episode(0, **drawn)
    frame, reference = first_frame(prepared), first_frame(exact)
    for name in ("front", "wrist"):
        believed = frame.images[name].world_from_camera
        true = reference.images[name].world_from_camera
        error = true.inverse() @ believed
        assert 0 < np.abs(error.position).max() <= 0.01
        assert error != Pose()
        shift = [prepared.info.simulated.behaviour[f"calibration_{name}_{axis}"] for axis in "xyz"]
        assert np.allclose(error.position, shift, atol=1e-9)
        # The image is drawn from the camera's true pose.
        assert np.array_equal(frame.images[name].color, reference.images[name].color)
    behaviour = prepared.info.simulated.behaviour
    assert stated_error("front", behaviour) is not None
    for word, value in (("angle", math.nan), ("qy", 1.5), ("x", math.inf)):
        assert stated_error("front", {**behaviour, f"calibration_front_{word}": value}) is None


def test_stratified_points_are_the_known_sequences() -> None:
    points = np.array([stratified_point("lhs", root_seed=1, episode_index=i, block=10) for i in range(20)])
    for cube in (points[:10], points[10:]):
        # The ten values of each number are in ten different tenths of its range.
        assert (np.sort(np.floor(cube * 10), axis=0) == np.arange(10)[:, None]).all()
    assert not np.array_equal(points[:10], points[10:])
    sobol = np.array([stratified_point("sobol", root_seed=1, episode_index=i, block=10) for i in range(16)])
    assert (np.sort(np.floor(sobol * 16), axis=0) == np.arange(16)[:, None]).all()
    assert stratified_point("random", root_seed=1, episode_index=0, block=10) == ()


HELD_OUT = (PRESETS["none"].range("held_out_x"), PRESETS["none"].range("held_out_y"))


def held_out(point: Sequence[float]) -> bool:
    return all(low <= value <= high for value, (low, high) in zip(point, HELD_OUT, strict=True))


@pytest.mark.slow
@pytest.mark.parametrize("sampling", ["random", "sobol"])
def test_train_and_eval_layouts_never_overlap(sampling: str) -> None:
    train = cube_starts(300, split="train", sampling=sampling)
    evaluation = cube_starts(60, split="eval", sampling=sampling)
    assert not any(held_out(point) for point in train)
    assert all(held_out(point) for point in evaluation)
    assert any(held_out(point) for point in cube_starts(300))


def test_train_and_eval_seeds_never_overlap() -> None:
    config: dict[str, Any] = {"ranges": Ranges(held_out_x=(0.35, 0.65), held_out_y=(-0.25, 0.25))}
    everywhere = {episode(i, split="eval", **config).info.simulated.scene.body("red_cube").mass for i in range(50)}
    same_seed = {episode(i, split="all", **config).info.simulated.scene.body("red_cube").mass for i in range(50)}
    assert len(everywhere) == 50
    assert not everywhere & same_seed
    with pytest.raises(ConfigError, match="seed"):
        GenerateConfig(seed=2**63).validate()


def test_a_held_out_region_off_the_table_is_a_clear_error() -> None:
    ranges = Ranges(held_out_x=(0.0, 0.1), held_out_y=(0.8, 0.9))
    with pytest.raises(SceneError, match="held_out_x"):
        episode(0, split="eval", ranges=ranges)
