"""What an opening means is told by the gripper alone: to and fro, in files, and by everybody who asks."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from support.recording import PANDA, make_episode
from support.sim import episode

from demorec.check.base import Measurement
from demorec.check.physics import gripper_width
from demorec.core.geometry import Array
from demorec.core.plain import from_json, from_plain, to_json, to_plain
from demorec.core.tables import ROBOTS
from demorec.episode.episode import Action
from demorec.episode.features import VELOCITY, observation_vectors
from demorec.episode.info import EpisodeInfo
from demorec.episode.sensed import ObservationRows
from demorec.mcap.streams import FrameValues, frame_streams
from demorec.robots.robot import ParallelGripper, RobotSpec
from demorec.sim.world import World

SAMPLES = Path(__file__).parents[2] / "recordings" / "sample"
GRIPPER = PANDA.gripper
CRANK = 0.04 / (np.pi / 2)


class CurvedGripper(ParallelGripper):
    """A finger's travel q opens it by 0.08 sin(q / CRANK), metres: what a crank does, and no half of anything."""

    def joint_position(self, width: Array | float) -> Array:
        return np.stack([CRANK * np.arcsin(np.minimum(np.asarray(width) / 0.08, 1.0))] * 2, axis=-1)

    def width(self, joint_position: Array) -> Array:
        return np.asarray(0.08 * np.sin(joint_position[..., 0] / CRANK))

    def width_velocity(self, joint_position: Array, joint_velocity: Array) -> Array:
        return np.asarray(0.08 / CRANK * np.cos(joint_position[..., 0] / CRANK) * joint_velocity[..., 0])


CURVED = CurvedGripper(**vars(GRIPPER))
WIDTHS = st.lists(st.floats(0.0, 0.079), min_size=1, max_size=5).map(np.array)


@pytest.mark.parametrize("gripper", [GRIPPER, CURVED], ids=["parallel", "curved"])
@given(width=WIDTHS, speed=st.floats(-0.1, 0.1))
def test_an_opening_becomes_joints_and_comes_back(gripper: ParallelGripper, width: Array, speed: float) -> None:
    joints = gripper.joint_position(width)
    assert joints.shape == (len(width), 2)
    np.testing.assert_allclose(gripper.width(joints), width, atol=1e-12)
    np.testing.assert_array_equal(gripper.joint_position(float(width[0])), joints[0])
    velocity = np.full_like(joints, speed)
    change = gripper.width(joints + 1e-7 * velocity) - gripper.width(joints - 1e-7 * velocity)
    np.testing.assert_allclose(gripper.width_velocity(joints, velocity), change / 2e-7, atol=1e-6)


@pytest.mark.parametrize("version", [1, 2])
def test_files_of_every_version_hold_the_gripper_among_the_robots_keys(version: int) -> None:
    """What another reader finds in the file is what is written today, byte for byte."""
    with (SAMPLES / f"format_{version}.mcap").open("rb") as file:
        text = next(m.metadata["info"] for m in make_reader(file).iter_metadata() if m.name == "demorec.episode")
    recorded = json.loads(text)["robot"]
    assert recorded["gripper_joints"] == ["panda_finger_joint1", "panda_finger_joint2"]
    info = from_json(text, EpisodeInfo)
    assert info.robot.gripper.max_width == recorded["gripper_max_width"] == 0.08
    assert info.robot.gripper.palm_clearance == recorded["palm_clearance"]
    assert json.loads(to_json(info.robot)) == recorded
    assert json.loads(text)["robot"].keys() == to_plain(ROBOTS.load("iiwa")).keys()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"gripper_force": "strong"}, "'strong' is no number"),
        ({"gripper_force": None}, "is no number"),
        ({"gripper": {}}, "extra fields found"),
        ({"max_width": 0.1}, "extra fields found"),
    ],
)
def test_a_gripper_that_makes_no_sense_is_refused(change: dict[str, object], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        from_plain(to_plain(PANDA) | change, RobotSpec)
    incomplete = to_plain(PANDA)
    del incomplete["finger_links"]
    with pytest.raises(ValueError, match="required field missing"):
        from_plain(incomplete, RobotSpec)


def test_whoever_has_joints_asks_the_gripper_for_the_opening() -> None:
    info, frames, _ = make_episode(num_frames=3, cameras=())
    info = info.with_simulation(robot=replace(info.robot, gripper=CURVED))
    seen = frames[1].observation
    q, v = seen.joint_position[7], seen.joint_velocity[7]
    speed = 0.08 / CRANK * np.cos(q / CRANK) * v
    vectors = observation_vectors(ObservationRows.of_observation(seen), info.robot, info.scene)
    assert vectors[VELOCITY][0, -1] == pytest.approx(speed, rel=1e-6)
    (stream,) = (stream for stream in frame_streams(info) if stream.topic == "/gripper")
    (row,) = stream.rows([FrameValues.of(frames[1])])
    assert row.tolist() == [seen.gripper_width, pytest.approx(speed), seen.contact_force]

    positions = np.stack([frame.observation.joint_position for frame in frames])
    width = 0.08 * np.sin(positions[:, 7] / CRANK)
    columns = SimpleNamespace(
        joint_position=positions, gripper_width=width, action_gripper=width, command_gripper=width
    )
    found = gripper_width.measure(SimpleNamespace(info=info, columns=columns, num_arm=7))
    assert isinstance(found, Measurement)
    assert found.value < 1e-12


def test_the_simulator_opens_as_the_gripper_says() -> None:
    prepared = episode(variation="none")
    spec = replace(prepared.info.robot, gripper=CURVED)
    with World(spec) as world:
        world.reset(prepared.info.scene)
        assert world.observe().gripper_width == pytest.approx(0.08, abs=1e-3)
        target = 0.05
        for _ in range(20):
            q = world.arm.target.copy()
            command = Action(
                joint_target=q, gripper_target=target, base_from_tcp_target=world.arm.kinematics.forward(q)
            )
            world.apply(command)
        seen = world.observe()
    assert seen.gripper_width == pytest.approx(target, abs=1e-3)
    np.testing.assert_allclose(seen.joint_position[7:], CRANK * np.arcsin(target / 0.08), atol=1e-3)
