"""What is drawn from a recording is what the simulator showed: shapes, numbers and every bit of every pose."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.sim import episode

from demorec.core.errors import SceneError
from demorec.core.geometry import Pose
from demorec.core.tables import ROBOTS, TASKS
from demorec.episode.episode import Action
from demorec.episode.mesh import encode_mesh
from demorec.episode.scene import Body, Scene, Shape, Texture
from demorec.loop import make_world
from demorec.objects.solids import lathe
from demorec.render.recorded import RecordedWorld
from demorec.robots.robot import RobotSpec
from demorec.sim.world import World


def recorded(world: World, robot: RobotSpec) -> RecordedWorld:
    """The present state of a world, by way of what would be recorded of it."""
    seen = world.observe()
    return RecordedWorld(
        robot,
        world.scene,
        joint_position=seen.joint_position[None],
        object_poses={name: pose.vector()[None] for name, pose in seen.object_poses.items()},
    )


def assert_same(world: World, robot: RobotSpec) -> None:
    other = recorded(world, robot)
    assert other.visuals() == world.visuals()
    assert other.mounts() == world.mounts()
    assert np.array_equal(other.poses(), world.poses())


def pose(rng: np.random.Generator) -> Pose:
    quat = rng.normal(size=4)
    return Pose(position=rng.uniform(-1.0, 1.0, 3), quat_xyzw=quat / np.sqrt((quat**2).sum()))


def command(world: World) -> Action:
    target = world.arm.target + 0.01
    return Action(joint_target=target, gripper_target=0.02, base_from_tcp_target=world.arm.kinematics.forward(target))


SHAPES = {
    "box": Shape(kind="box", size=(0.1, 0.2, 0.3)),
    "sphere": Shape(kind="sphere", size=(0.1,)),
    "cylinder": Shape(kind="cylinder", size=(0.1, 0.3)),
    "capsule": Shape(kind="capsule", size=(0.1, 0.3)),
    "mesh": Shape(kind="mesh", size=(0.1, 0.1, 0.1), file="duck.obj", scale=0.07, origin=(0.1, 0.7, 0.2), y_up=True),
    "held": Shape(kind="mesh", size=(0.1, 0.1, 0.1), mesh=encode_mesh(lathe([(0.02, 0.0), (0.03, 0.05)])), scale=0.8),
} | {
    file: Shape(kind="urdf", size=(0.1, 0.1, 0.1), file=file, scale=0.9)
    for file in (
        "cube.urdf",
        "lego/lego.urdf",
        "table/table.urdf",
        "tray/traybox.urdf",
        "plane.urdf",
        "r2d2.urdf",
        "teddy_vhacd.urdf",
        "soccerball.urdf",
        "demorec:tray.urdf",
    )
}


@pytest.mark.parametrize("task", TASKS.names())
def test_every_task_is_drawn_as_it_was_simulated(task: str) -> None:
    info = episode(3, task=task, variation="full", cameras=("front",)).info
    with make_world(info) as world:
        world.reset(info.scene)
        assert_same(world, info.robot)
        world.apply(command(world))
        assert_same(world, info.robot)


@pytest.mark.parametrize("name", ROBOTS.names())
def test_every_link_is_where_pybullet_has_it(name: str) -> None:
    # Bases that stand turned, robots of another size, joints anywhere, not one bit off.
    rng = np.random.default_rng(11)
    spec = ROBOTS.load(name)
    for _ in range(4):
        placement = replace(
            episode(0, robot=name, variation="none").info.scene.robot,
            world_from_base=pose(rng),
            scale=float(rng.uniform(0.7, 1.4)),
        )
        robot = spec.scaled(placement.scale)
        positions = rng.uniform(-3.0, 3.0, (30, len(robot.joint_names)))
        fingers = len(robot.gripper.joints)
        positions[:, -fingers:] = rng.uniform(0, robot.gripper.max_width / 2, (30, fingers))
        scene = Scene(robot=placement, bodies=())
        other = RecordedWorld(robot, scene, joint_position=positions, object_poses={})
        with World(robot) as world:
            world.reset(scene)
            for frame, position in enumerate(positions):
                world.set_state(joint_position=position)
                other.frame = frame
                assert np.array_equal(other.poses(), world.poses())


@pytest.mark.parametrize("mass", [0.0, 0.2])
@pytest.mark.parametrize("name", SHAPES)
def test_every_shape_is_drawn_as_it_was_simulated(name: str, mass: float) -> None:
    if name == "r2d2.urdf" and mass:
        pytest.skip("its own joints move, which is not recorded")
    rng = np.random.default_rng(3)
    texture = Texture(pattern="checker", colors=((1.0, 1.0, 1.0), (0.0, 0.0, 0.0)))
    placement = episode(0, variation="none").info.scene.robot
    bodies = tuple(
        Body(
            name=f"b{number}",
            role="object",
            shape=SHAPES[name],
            world_from_body=pose(rng),
            mass=mass,
            rgba=rgba,
            texture=texture if number else None,
        )
        for number, rgba in enumerate([(1.0, 1.0, 1.0, 1.0), (0.3, 0.7, 0.1, 1.0)])
    )
    robot = ROBOTS.load("panda")
    with World(robot) as world:
        world.reset(Scene(robot=placement, bodies=bodies))
        other = recorded(world, robot)
        assert other.visuals() == world.visuals()
        assert other.mounts() == world.mounts()
        if mass == 0 or SHAPES[name].kind != "urdf":
            assert np.array_equal(other.poses(), world.poses())
        else:
            # What is recorded is the body's pose; that of its centre of mass and of its links follows but for rounding.
            assert np.abs(other.poses() - world.poses()).max() < 2e-6


def test_a_model_that_is_no_urdf_is_named() -> None:
    robot = replace(ROBOTS.load("panda"), urdf="duck.obj")
    placement = episode(0, variation="none").info.scene.robot
    with pytest.raises(SceneError, match=r"panda.*duck\.obj"):
        RecordedWorld(robot, Scene(robot=placement, bodies=()), joint_position=np.zeros((1, 9)), object_poses={})
