"""Camera presets see their subjects, for every robot: by projection, without drawing."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np
import pytest
from support.sim import episode

from demorec.core.geometry import Pose
from demorec.core.tables import CAMERAS, ROBOTS
from demorec.episode.scene import SceneCamera
from demorec.loop import make_world
from demorec.sim.world import World
from demorec.tasks.sampling import WORKSPACE


def pixel(camera: SceneCamera, world_from_camera: Pose, point: tuple[float, float, float]) -> tuple[float, float]:
    """Pinhole projection in OpenCV axes, pixels; fails for a point behind the camera."""
    x, y, z = world_from_camera.inverse().apply(np.array(point))
    assert z > camera.near
    k = camera.intrinsics
    return float(k[0, 0] * x / z + k[0, 2]), float(k[1, 1] * y / z + k[1, 2])


def inside(camera: SceneCamera, place: tuple[float, float], margin: float = 0.0) -> bool:
    u, v = place[0] / camera.width, place[1] / camera.height
    return margin <= u <= 1 - margin and margin <= v <= 1 - margin


def scaled(world: World, x: float, y: float, z: float) -> tuple[float, float, float]:
    scale = world.robot.task_scale
    return scale * x, scale * y, scale * z


@pytest.fixture(scope="module", params=ROBOTS.names())
def world(request: pytest.FixtureRequest) -> Iterator[World]:
    prepared = episode(0, robot=request.param, cameras=CAMERAS.names(), variation="none")
    with make_world(prepared.info) as made:
        made.reset(prepared.info.simulated.scene)
        yield made


def cameras_of(world: World) -> dict[str, SceneCamera]:
    return {camera.name: camera for camera in world.scene.cameras}


@pytest.mark.parametrize("name", ["front", "top"])
def test_a_fixed_camera_sees_every_place_where_objects_go(world: World, name: str) -> None:
    camera = cameras_of(world)[name]
    for place in itertools.product((0.33, 0.67), (-0.30, 0.30), (0.0, 0.06)):
        assert inside(camera, pixel(camera, camera.mount_from_camera, scaled(world, *place)), margin=0.02), place


def test_front_sees_the_hand_and_top_has_the_base_below(world: World) -> None:
    front, top = cameras_of(world)["front"], cameras_of(world)["top"]
    assert inside(front, pixel(front, front.mount_from_camera, tuple(world.arm.world_from_tcp().position)))
    near, far = (pixel(top, top.mount_from_camera, scaled(world, x, 0.0, 0.0)) for x in (0.35, 0.65))
    assert near[1] > far[1]
    right, left = (pixel(top, top.mount_from_camera, scaled(world, 0.5, y, 0.0)) for y in (-0.2, 0.2))
    assert right[0] > left[0]  # not mirrored: y is to the left


@pytest.mark.parametrize("size", [(56, 40), (224, 224), (640, 480), (640, 360)])
def test_workspace_sees_every_place_where_objects_go_in_images_of_any_shape(
    world: World, size: tuple[int, int]
) -> None:
    camera = CAMERAS.load("workspace").camera("workspace", world.robot, width=size[0], height=size[1])
    pixels = [
        pixel(camera, camera.mount_from_camera, scaled(world, *place, z))
        for place in itertools.product(WORKSPACE.x, WORKSPACE.y)
        for z in (0.0, 0.06)
    ]
    assert all(inside(camera, place) for place in pixels)
    assert (np.ptp(pixels, axis=0) / size).max() > 0.65  # with a small margin


def test_wrist_sees_the_space_between_the_fingers(world: World) -> None:
    camera = cameras_of(world)["wrist"]
    mount = world.mounts()[camera.mount]
    state = world.client.getLinkState(mount.body, mount.link, computeForwardKinematics=True)
    pose = Pose(position=np.array(state[4]), quat_xyzw=np.array(state[5])) @ camera.mount_from_camera
    tcp = world.arm.world_from_tcp()
    gripper, turned = world.robot.gripper, -1 if world.robot.wrist_camera else 1
    half, middle = gripper.open_width / 2, gripper.object_offset(gripper.open_width)
    for point in ([0, middle, 0], [0, middle + 0.7 * half, 0], [0, middle - 0.7 * half, 0], [0, middle, 0.1]):
        assert inside(camera, pixel(camera, pose, tuple(tcp.apply(np.array(point))))), point
    # The hand's x axis runs down in the image: objects ahead of the fingers enter from below. SO-101's mount
    # has the same direction.
    ahead, behind = (pixel(camera, pose, tuple(tcp.apply(np.array([x, 0, 0.05]))))[1] for x in (0.02, -0.02))
    assert turned * (ahead - behind) > 0
