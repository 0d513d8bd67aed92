"""The world: built from a scene alone, read and placed correctly, deterministic."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np
import pytest
from support.sim import body_index, episode, run

from demorec.core.errors import ConfigError, SceneError
from demorec.core.geometry import Pose
from demorec.episode.episode import Action
from demorec.episode.scene import Body, Scene, Shape
from demorec.robots.panda import PANDA
from demorec.sim.client import connect
from demorec.sim.world import World


@pytest.fixture(scope="module")
def world() -> Iterator[World]:
    with World(PANDA) as made:
        yield made


@pytest.fixture(scope="module")
def scene() -> Scene:
    return episode(0).info.simulated.scene


def hold(world: World, frames: int) -> None:
    q = world.arm.target
    for _ in range(frames):
        world.apply(Action(joint_target=q, gripper_target=0.08, base_from_tcp_target=world.arm.kinematics.forward(q)))


def with_bodies(scene: Scene, *bodies: Body) -> Scene:
    return dataclasses.replace(scene, bodies=(*scene.bodies, *bodies), goals=())


def test_observation_agrees_with_the_simulator(world: World, scene: Scene) -> None:
    world.reset(scene)
    hold(world, 3)
    seen = world.observe()
    position, quat = world.client.getBasePositionAndOrientation(body_index(world, "red_cube"))
    assert seen.object_poses["red_cube"] == Pose(position=np.array(position), quat_xyzw=np.array(quat))
    assert set(seen.object_poses) == {"red_cube"}
    state = world.client.getLinkState(
        world.arm.body, world.mounts()["panda_grasptarget"].link, computeForwardKinematics=1
    )
    assert np.abs(seen.base_from_tcp.position - state[4]).max() < 1e-6
    assert abs(seen.gripper_width - 0.08) < 1e-3
    assert seen.joint_position.shape == seen.joint_velocity.shape == seen.joint_effort.shape == (9,)
    # At rest the motors hold the arm's weight, in agreement with inverse dynamics.
    at_rest = world.client.calculateInverseDynamics(world.arm.body, seen.joint_position.tolist(), [0.0] * 9, [0.0] * 9)
    assert np.abs(seen.joint_effort[:7] - at_rest[:7]).max() < 0.01
    assert np.abs(at_rest[:7]).max() > 10


def test_a_body_with_an_offset_centre_of_mass_has_the_scenes_pose(world: World, scene: Scene) -> None:
    pose = Pose.from_yaw([0.5, 0.3, 0.4], 0.8)
    duck = Body(
        name="duck",
        role="object",
        shape=Shape(kind="urdf", file="duck_vhacd.urdf", size=(0.1, 0.1, 0.1)),
        world_from_body=pose,
        mass=0.1,
    )
    world.reset(with_bodies(scene, duck))
    # It falls while the world settles, and does not move sideways.
    assert np.abs(world.pose("duck").position - pose.position)[:2].max() < 1e-6
    assert world.client.getDynamicsInfo(body_index(world, "duck"), -1)[0] == 0.1
    world.set_state(object_poses={"duck": pose})
    assert np.allclose(world.pose("duck").vector(), pose.vector(), atol=1e-9)


def test_the_quaternion_of_a_turning_body_keeps_its_sign(world: World, scene: Scene) -> None:
    world.reset(scene)
    cube = body_index(world, "red_cube")
    quats = []
    for angle in np.arange(0.0, 4 * np.pi, 0.3):
        world.client.resetBasePositionAndOrientation(
            cube, [0.5, 0.0, 0.3], world.client.getQuaternionFromEuler([0.0, 0.0, angle])
        )
        quats.append(world.pose("red_cube").quat_xyzw)
        assert abs(abs(quats[-1] @ [0, 0, np.sin(angle / 2), np.cos(angle / 2)]) - 1) < 1e-9
    assert min(np.sum(np.array(quats[1:]) * quats[:-1], axis=1)) > 0.98
    assert np.sum(np.array(quats[0]) * quats[21]) < 0  # a full turn changes the sign


@pytest.mark.slow
def test_parameters_of_another_client_do_not_leak() -> None:
    prepared = episode(1)
    _, expected = run(prepared)
    vandal = connect()
    vandal.setPhysicsEngineParameter(
        contactBreakingThreshold=0.2, enableFileCaching=0, contactERP=0.9, erp=0.9, numSolverIterations=3
    )
    _, found = run(prepared)
    vandal.disconnect()
    assert found.final_state_digest == expected.final_state_digest


def test_wrong_scenes_are_refused_in_one_sentence(world: World, scene: Scene) -> None:
    with pytest.raises(SceneError, match="no_such"):
        world.reset(
            with_bodies(
                scene,
                Body(
                    name="b",
                    role="object",
                    shape=Shape(kind="urdf", file="no_such.urdf", size=(1.0, 1.0, 1.0)),
                    world_from_body=Pose(),
                ),
            )
        )
    with pytest.raises(SceneError, match="share a name"):
        world.reset(with_bodies(scene, scene.body("red_cube")))
    with pytest.raises(SceneError, match="other_arm"):
        world.reset(dataclasses.replace(scene, robot=dataclasses.replace(scene.robot, name="other_arm")))
    with World(PANDA, fps=70) as odd, pytest.raises(ConfigError, match="70"):
        odd.reset(scene)
