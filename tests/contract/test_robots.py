"""Every robot in the table: a URDF that fits its specification, and an arm that completes a task."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.present import present
from support.sim import episode

from demorec.core.tables import ROBOTS
from demorec.episode.episode import Action
from demorec.robots.assets import asset_path, mesh_path
from demorec.robots.model_check import for_simulator
from demorec.robots.robot import RobotSpec
from demorec.sim.arm import arm_kinematics
from demorec.sim.world import World
from demorec.tasks import grasping
from demorec.tasks.grasping import hand_down
from demorec.testing import RobotContract


@pytest.mark.parametrize("robot", ROBOTS.names(), scope="class")
class TestEveryRobot(RobotContract):
    @pytest.fixture(autouse=True, scope="class")
    @classmethod
    def _row(cls, robot: str) -> None:
        cls.robot = robot


@pytest.fixture(params=ROBOTS.names())
def spec(request: pytest.FixtureRequest) -> RobotSpec:
    return ROBOTS.load(request.param)


def test_it_starts_within_its_limits(spec: RobotSpec) -> None:
    """This includes homes that are closer to a limit than `joint_spread`."""
    starts = [
        episode(i, robot=spec.name, variation="full").info.simulated.scene.robot.joint_position for i in range(20)
    ]
    assert (np.array(starts) >= spec.position_lower).all()
    assert (np.array(starts) <= spec.position_upper).all()


def test_the_wrench_balances_the_weight_of_the_hand(
    spec: RobotSpec, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """At rest in a tilted pose, against statics; for any orientation of the hand's inertial axes.

    The fingers' motion stays horizontal: docs/recording.md describes PyBullet's losses otherwise.
    """
    scene = episode(0, robot=spec.name, variation="none").info.simulated.scene
    q = np.array(spec.home_q)
    q[-2] += 0.6 if q[-2] + 0.6 < spec.position_upper[-2] else -0.6
    command = Action(joint_target=q, gripper_target=0.04, base_from_tcp_target=arm_kinematics(spec).forward(q))
    fingers = spec.gripper.joint_position(0.04)
    urdf = asset_path(spec.urdf)
    turned = tmp_path / "turned.urdf"
    root = ET.parse(urdf).getroot()
    for mesh in root.iter("mesh"):
        mesh.attrib["filename"] = str(mesh_path(urdf.parent, mesh.attrib["filename"]))
    present(root.find(f"link[@name='{spec.hand_link}']/inertial/origin")).attrib["rpy"] = "0.4 -0.7 1.9"
    turned.write_text(for_simulator(ET.tostring(root, encoding="unicode")))
    found = {}
    for name, model in (("as it is", None), ("turned", turned)):
        if model is not None:
            monkeypatch.setattr("demorec.sim.bodies.urdf_file", lambda _, model=model, **_more: nullcontext(str(model)))
        with World(spec) as world:
            world.reset(scene)
            world.set_state(joint_position=np.array([*q, *fingers]))
            wrenches = []
            for _ in range(150):
                world.apply(command)
                wrenches.append(world.observe().sensed["wrench"])
            found[name] = np.mean(wrenches[-90:], axis=0), _weight(world)
            axis = np.abs(world.client.getJointInfo(world.arm.body, world.arm.links[spec.hand_link])[13])
    for wrench, expected in found.values():
        weight = np.linalg.norm(expected[:3])
        assert sorted(np.abs(expected[:3]))[1] > 0.4 * weight, "the hand is tilted"
        assert np.abs(expected[3:]).max() > 0.01 * weight
        assert np.abs(wrench[:3] - expected[:3]).max() < 0.02 * weight
        # A torque about the axis of the hand's joint acts on the motor.
        assert ((1 - axis) * np.abs(wrench[3:] - expected[3:])).max() < 1e-3 * weight
    assert np.allclose(found["as it is"][1], found["turned"][1], atol=0.01)


def _weight(world: World) -> np.ndarray[Any, Any]:
    """(6,) force and torque that balance gravity on hand and fingers, about the hand's origin and along its axes."""
    client, arm = world.client, world.arm
    hand = arm.links[arm.spec.hand_link]
    place = client.getLinkState(arm.body, hand, computeForwardKinematics=1)
    axes = np.reshape(client.getMatrixFromQuaternion(place[5]), (3, 3))
    force, torque = np.zeros(3), np.zeros(3)
    for link in {hand, *arm.finger_links}:
        held = np.array([0.0, 0.0, 9.81 * client.getDynamicsInfo(arm.body, link)[0]])
        centre = client.getLinkState(arm.body, link, computeForwardKinematics=1)[0]
        force += held
        torque += np.cross(np.subtract(centre, place[4]), held)
    return np.concatenate((axes.T @ force, axes.T @ torque))


def test_the_open_hand_is_no_larger_than_a_deliberate_miss_assumes(spec: RobotSpec) -> None:
    """Bullet's bounding boxes (margin included), the hand pointing down along the world's axes."""
    with World(spec) as world:
        world.reset(episode(robot=spec.name).info.simulated.scene)
        goal = world.arm.world_from_base.inverse() @ hand_down(spec.task_scale * np.array([0.5, 0.0, 0.2]), 0.0)
        found = world.arm.kinematics.inverse(goal, start=np.array(spec.home_q))
        world.arm.place(present(found), spec.gripper.open_width)
        world.client.performCollisionDetection()
        tcp = world.arm.world_from_tcp().position
        boxes = {
            link: np.array(world.client.getAABB(world.arm.body, link)) - tcp
            for link in (*world.arm.finger_links, world.arm.links[spec.hand_link])
        }
    assert min(box[0, 2] for box in boxes.values()) > -spec.gripper.finger_depth - grasping._GAP
    hand = boxes.pop(world.arm.links[spec.hand_link])
    is_finger = spec.hand_link in spec.gripper.finger_links  # its box, and that of a jaw, are as wide as the palm
    for half_size, parts in (
        (grasping._PALM if is_finger else grasping._FINGERS, list(boxes.values())),
        (grasping._PALM, [hand]),
    ):
        for box in parts:
            assert (np.abs(box[:, :2]).max(axis=0) < np.array(half_size) + grasping._GAP).all()
    assert is_finger or hand[0, 2] > spec.gripper.palm_clearance - 2e-3
