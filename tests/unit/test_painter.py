"""The painter: what reaches the renderer, and the poses at which cameras are believed to be."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from demorec.core.geometry import Array, Pose
from demorec.episode.episode import CameraImages
from demorec.episode.scene import Light, RobotPlacement, Scene, SceneCamera
from demorec.render import Mount, RenderSetup, Visual, VisualBody, first_rows, world_from_camera
from demorec.render.painter import Painter

HALF_TURN = Pose(position=np.array([0.0, 0.0, 0.5]), quat_xyzw=np.array([0.0, 0.0, 1.0, 0.0]))


def ball(color: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 1.0), *, num_links: int = 0) -> VisualBody:
    visual = Visual(link=-1, kind="sphere", size=(0.1,), link_from_shape=Pose(), rgba=color)
    return VisualBody(name="ball", num_links=num_links, is_fixed=False, visuals=(visual,))


def camera(mount: str = "world") -> SceneCamera:
    pose = Pose(position=np.array([0.1, 0.0, 0.0]))
    return SceneCamera(name="eye", width=4, height=2, fov_y=1.0, mount=mount, mount_from_camera=pose)


class Noted:
    """A renderer that notes what it is told."""

    def __init__(self) -> None:
        self.setups: list[RenderSetup] = []
        self.poses: list[Array] = []

    def __enter__(self) -> Noted:
        return self

    def __exit__(self, *exc: object) -> None: ...

    def close(self) -> None: ...

    def setup(self, setup: RenderSetup) -> None:
        self.setups.append(setup)

    def render(self, poses: Array) -> dict[str, CameraImages]:
        self.poses.append(poses)
        setup = self.setups[-1]
        color = np.zeros((2, 4, 3), dtype=np.uint8)
        return {
            c.name: CameraImages(color=color, world_from_camera=world_from_camera(setup, c, poses))
            for c in setup.cameras
        }


class Balls:
    """A world of balls."""

    def __init__(self, *bodies: VisualBody) -> None:
        home = RobotPlacement(name="none", world_from_base=Pose(), joint_position=(), gripper_width=0.0)
        self.scene = Scene(robot=home, bodies=(), light=Light(ambient=0.25))
        self.bodies = bodies

    def visuals(self) -> tuple[VisualBody, ...]:
        return self.bodies

    def mounts(self) -> dict[str, Mount]:
        base = Mount(body=1, link=-1, link_from_mount=Pose(position=np.array([0.0, 0.0, -0.5])))
        return {"base": base, "hand": Mount(body=1, link=1)}

    def poses(self) -> Array:
        rows = [Pose(position=np.array([float(row), 0.0, 0.0])).vector() for row in range(5)]
        rows[1], rows[3] = HALF_TURN.vector(), HALF_TURN.vector()
        return np.array(rows)


def painted(world: Any, *cameras: SceneCamera, **options: Any) -> tuple[Noted, Painter]:
    renderer = Noted()
    painter = Painter(renderer, cameras, **options)
    painter.setup(world)
    return renderer, painter


def test_the_renderer_is_told_what_the_world_shows() -> None:
    world = Balls(ball(), ball(num_links=2))
    renderer, painter = painted(world, camera(), depth=True, antialias=False)
    painter.images()
    painter.images()
    (setup,) = renderer.setups
    assert setup.bodies == world.bodies
    assert setup.light == world.scene.light
    assert (setup.depth, setup.segmentation, setup.antialias) == (True, False, False)
    assert np.array_equal(renderer.poses[0], world.poses())


def test_changed_looks_reach_the_renderer_with_the_next_picture() -> None:
    world = Balls(ball())
    renderer, painter = painted(world, camera(), segmentation=True)
    painter.images()
    world.bodies = (ball((0.0, 0.0, 1.0, 1.0)),)
    painter.images()
    first, second = renderer.setups
    assert second == replace(first, bodies=world.bodies)


def test_calibration_errors_move_the_believed_pose_alone() -> None:
    error = Pose(position=np.array([0.0, 0.02, 0.0]))
    _, painter = painted(Balls(ball()), camera(), true_from_recorded={"eye": error})
    assert painter.images()["eye"].world_from_camera == camera().mount_from_camera @ error


@pytest.mark.parametrize(
    ("mount", "place"),
    # Row 3 is link 1 of the second body; its base is row 1, and half a metre above the mount.
    [("world", (0.1, 0.0, 0.0)), ("hand", (-0.1, 0.0, 0.5)), ("base", (-0.1, 0.0, 0.0))],
)
def test_cameras_are_carried_by_their_mounts(mount: str, place: tuple[float, float, float]) -> None:
    _, painter = painted(Balls(ball(), ball(num_links=2)), camera(mount))
    assert painter.images()["eye"].world_from_camera.position == pytest.approx(place)


def test_each_body_begins_after_the_links_of_the_one_before() -> None:
    assert first_rows([ball(num_links=2), ball(), ball(num_links=1), ball()]) == [0, 3, 4, 6]


def test_a_painter_without_a_world_says_so() -> None:
    with pytest.raises(RuntimeError, match="setup"):
        Painter(Noted(), ()).images()
