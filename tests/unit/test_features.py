"""Feature vectors against SciPy, signs of quaternions, and increments of noisy commands."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.recording import HOME

from demorec.core.geometry import Pose
from demorec.episode.episode import Observations, Trajectory, frame_time_ns
from demorec.episode.features import (
    EE_POSE,
    ENVIRONMENT_STATE,
    action_vectors,
    observation_names,
    observation_vectors,
)
from demorec.episode.scene import Body, Goal, RobotPlacement, Scene, Shape
from demorec.robots.panda import PANDA


def random_pose(rng: np.random.Generator) -> Pose:
    return Pose(position=rng.normal(size=3), quat_xyzw=Rotation.random(random_state=rng).as_quat())


def make_body(
    rng: np.random.Generator, name: str, size: tuple[float, ...], *, symmetry: int, mass: float = 0.1
) -> Body:
    return Body(
        name=name,
        role="object",
        shape=Shape(kind="box" if len(size) == 3 else "sphere", size=size),
        world_from_body=random_pose(rng),
        mass=mass,
        yaw_symmetry=symmetry,
    )


def make_scene(rng: np.random.Generator) -> Scene:
    return Scene(
        robot=RobotPlacement(name="panda", world_from_base=random_pose(rng), joint_position=HOME, gripper_width=0.08),
        bodies=(
            make_body(rng, "tray", (0.2, 0.1, 0.02), symmetry=2, mass=0.0),
            make_body(rng, "block", (0.06, 0.04, 0.03), symmetry=2),
            make_body(rng, "cube", (0.04, 0.04, 0.04), symmetry=4),
            make_body(rng, "ball", (0.03,), symmetry=0),
        ),
        goals=(
            Goal(object="block", onto="tray", onto_from_goal=random_pose(rng), yaw_symmetry=2),
            Goal(object="cube", onto="block", onto_from_goal=random_pose(rng), yaw_symmetry=4),
            Goal(object="ball", onto="", onto_from_goal=random_pose(rng), yaw_symmetry=0),
        ),
    )


def make_rows(rng: np.random.Generator, scene: Scene, count: int) -> Observations:
    poses = {body.name: np.array([random_pose(rng).vector() for _ in range(count)]) for body in scene.movable}
    return Observations(
        joint_position=rng.normal(size=(count, 9)),
        joint_velocity=rng.normal(size=(count, 9)),
        joint_effort=np.zeros((count, 9)),
        gripper_width=rng.uniform(0, 0.08, size=count),
        base_from_tcp=np.array([random_pose(rng).vector() for _ in range(count)]),
        object_poses=poses,
        contact_force=np.zeros(count),
        sensed={},
    )


def test_environment_state_against_scipy() -> None:
    rng = np.random.default_rng(2)
    scene = make_scene(rng)
    rows = make_rows(rng, scene, 8)
    values = observation_vectors(rows, PANDA, scene, privileged=True)[ENVIRONMENT_STATE]
    names = observation_names(PANDA, scene, privileged=True)[ENVIRONMENT_STATE]
    assert len(names) == values.shape[1] == len(set(names))

    def matrix(vector: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        result = np.eye(4)
        result[:3, :3] = Rotation.from_quat(vector[3:]).as_matrix()
        result[:3, 3] = vector[:3]
        return result

    def yaw(pose: np.ndarray[Any, Any]) -> float:
        vertical = int(np.argmax(np.abs(pose[2, :3])))
        axis = pose[:3, (vertical + 1) % 3]
        return math.atan2(axis[1], axis[0])

    for t in range(8):
        found = dict(zip(names, values[t].tolist(), strict=True))
        base = matrix(scene.robot.world_from_base.vector())
        tcp = matrix(rows.base_from_tcp[t])
        poses = {name: np.linalg.inv(base) @ matrix(vectors[t]) for name, vectors in rows.object_poses.items()}
        poses["tray"] = np.linalg.inv(base) @ matrix(scene.body("tray").world_from_body.vector())
        for goal in scene.goals:
            thing, n = poses[goal.object], scene.body(goal.object).yaw_symmetry
            onto = poses[goal.onto] if goal.onto else np.linalg.inv(base)
            wanted = onto @ matrix(goal.onto_from_goal.vector())
            for prefix, pose in ((goal.object, thing), (f"{goal.object}.goal", wanted)):
                in_hand = np.linalg.inv(tcp) @ pose
                for k, axis in enumerate("xyz"):
                    assert found[f"{prefix}.{axis}"] == pytest.approx(pose[k, 3], abs=1e-5)
                    assert found[f"{prefix}.from_tcp.{axis}"] == pytest.approx(pose[k, 3] - tcp[k, 3], abs=1e-5)
                    assert found[f"{prefix}.from_tcp.hand_{axis}"] == pytest.approx(in_hand[k, 3], abs=1e-5)
            for key, offset in (
                ("from_tcp", thing - tcp),
                ("goal.from_tcp", wanted - tcp),
                (f"goal.from_{goal.object}", wanted - thing),
            ):
                for k, axis in enumerate("xyz"):
                    near = offset[k, 3] / (abs(offset[k, 3]) + 0.02)
                    assert found[f"{goal.object}.{key}.near_{axis}"] == pytest.approx(near, abs=1e-5)
            if n:
                assert found[f"{goal.object}.yaw.sin{n}"] == pytest.approx(math.sin(n * yaw(thing)), abs=1e-5)
                relative = n * (yaw(thing) - yaw(tcp))
                assert found[f"{goal.object}.from_tcp.yaw.cos{n}"] == pytest.approx(math.cos(relative), abs=1e-5)
                assert found[f"{goal.object}.from_tcp.yaw.sin{n}"] == pytest.approx(math.sin(relative), abs=1e-5)
                relative = n * (yaw(wanted) - yaw(thing))
                key = f"{goal.object}.goal.from_{goal.object}.yaw"
                assert found[f"{key}.cos{n}"] == pytest.approx(math.cos(relative), abs=1e-5)
                assert found[f"{key}.sin{n}"] == pytest.approx(math.sin(relative), abs=1e-5)
            else:
                assert f"{goal.object}.yaw.sin" not in found
        raw = matrix(values[t][-7:].astype(np.float64))
        assert np.allclose(raw, poses["ball"], atol=1e-5)  # the last movable body


def test_the_tcp_quaternion_keeps_its_sign_through_a_turn_of_the_hand() -> None:
    rng = np.random.default_rng(4)
    scene = make_scene(rng)
    down = Rotation.from_euler("x", 180, degrees=True)
    quats = []
    for degrees in range(-170, 171, 5):
        quat = (Rotation.from_euler("z", degrees, degrees=True) * down).as_quat()
        quats.append(quat * rng.choice([-1, 1]))  # either sign may be recorded
    rows = make_rows(rng, scene, len(quats))
    rows = replace(rows, base_from_tcp=np.concatenate([rows.base_from_tcp[:, :3], np.array(quats)], axis=1))
    found = observation_vectors(rows, PANDA, scene)[EE_POSE][:, 3:]
    assert np.abs(np.diff(found, axis=0)).max() < 0.05


def columns_of(rng: np.random.Generator, count: int) -> Trajectory:
    def poses() -> np.ndarray[Any, Any]:
        return np.array([random_pose(rng).vector() for _ in range(count)])

    return Trajectory(
        time_ns=np.arange(count), joint_position=rng.normal(size=(count, 9)),
        joint_velocity=np.zeros((count, 9)), joint_effort=np.zeros((count, 9)), gripper_width=np.zeros(count),
        base_from_tcp=poses(), object_poses={}, contact_force=np.zeros(count), sensed={},
        action_joint_target=rng.normal(size=(count, 7)), action_gripper=rng.uniform(0, 0.08, count),
        action_base_from_tcp=poses(), command_joint_target=np.zeros((count, 7)), command_gripper=np.zeros(count),
        command_base_from_tcp=poses(), phase=("x",) * count, is_deliberate_miss=np.zeros(count, dtype=bool),
        world_from_camera={},
    )  # fmt: skip


@pytest.mark.parametrize("fps", [30, 10])
def test_increments_follow_the_decay_of_the_noise(fps: int) -> None:
    """Where the executed command returns to the clean one, increments are those of the executed one."""
    rng = np.random.default_rng(11)
    time = np.arange(12)
    columns = columns_of(rng, len(time))
    decay = 0.7 ** (time * 30 / fps)
    noise = decay[:, None] * rng.normal(0, 0.02, 7)
    shift = decay[:, None] * rng.normal(0, 0.01, 3)
    poses = columns.action_base_from_tcp
    # Turned about the vertical by a decaying angle, from the left.
    turn = Rotation.from_rotvec(np.outer(decay * 0.05, [0.0, 0.0, 1.0]))
    still = Rotation.from_quat(np.broadcast_to(poses[0, 3:], (len(time), 4)))
    clean = np.concatenate([poses[:, :3], still.as_quat()], axis=1)
    executed = np.concatenate([poses[:, :3] + shift, (turn * still).as_quat()], axis=1)
    columns = replace(
        columns,
        time_ns=frame_times(time, fps),
        command_joint_target=columns.action_joint_target + noise,
        action_base_from_tcp=clean,
        command_base_from_tcp=executed,
    )
    scene = make_scene(rng)
    joints = action_vectors(columns, scene, "joint_increment")[1:, :7]
    assert np.allclose(joints, np.diff(columns.command_joint_target, axis=0), atol=1e-6)
    deltas = action_vectors(columns, scene, "ee_delta")[1:]
    assert np.allclose(deltas[:, :3], np.diff(executed[:, :3], axis=0), atol=1e-6)
    turns = (turn[1:] * turn[:-1].inv()).as_rotvec()
    assert np.allclose(deltas[:, 3:6], turns, atol=1e-6)


def frame_times(frames: np.ndarray[Any, Any], fps: int) -> np.ndarray[Any, Any]:
    return np.array([frame_time_ns(int(frame), fps) for frame in frames])
