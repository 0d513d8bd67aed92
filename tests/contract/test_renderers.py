"""Every renderer in the table draws the scene: bounds are tight for raster, and documented for PyBullet's renderers.

TinyRenderer samples half a pixel off and its depth is millimetres out; a 24-bit depth buffer makes the EGL plugin's
depth coarser. docs/rendering.md has the figures.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from support import render as scenes
from support.present import present

from demorec.core.errors import RenderError
from demorec.core.geometry import Pose, quat_from_rotation
from demorec.core.tables import RENDERERS
from demorec.episode.scene import Light
from demorec.render import Renderer


@dataclass(frozen=True, kw_only=True)
class Bounds:
    """Accuracy that a renderer guarantees.

    Attributes:
        depth_median, depth_p99: Error of a plane's depth, metres.
        round_median, round_p99: The same for round shapes, which are polygons.
        mask: Intersection over union of a 20 cm shape 50 to 70 pixels wide, whose outline is 200 of its 3000 pixels.
    """

    depth_median: float
    depth_p99: float
    round_median: float
    round_p99: float
    mask: float


BOUNDS = {
    "raster": Bounds(depth_median=1e-4, depth_p99=1e-3, round_median=2e-4, round_p99=1e-3, mask=0.99),
    "tiny": Bounds(depth_median=3e-3, depth_p99=1.2e-2, round_median=1.2e-2, round_p99=6e-2, mask=0.82),
    "egl": Bounds(depth_median=1e-3, depth_p99=3e-3, round_median=1e-2, round_p99=5e-2, mask=0.85),
}


@dataclass(frozen=True)
class Stage:
    """A client that is emptied for each test (EGL allows only one in a process), and the renderer."""

    name: str
    client: Any
    renderer: Renderer

    @property
    def bounds(self) -> Bounds:
        return BOUNDS[self.name]


@pytest.fixture(scope="module", params=RENDERERS.names())
def warm_stage(request: pytest.FixtureRequest) -> Iterator[Stage]:
    client = scenes.connect()
    try:
        renderer = RENDERERS.load(request.param)()
    except RenderError as error:
        if request.param == "egl" and not os.environ.get("CI"):
            client.disconnect()
            pytest.skip(f"no OpenGL here: {error}")
        raise
    with renderer:
        yield Stage(request.param, client, renderer)
    client.disconnect()


@pytest.fixture
def stage(warm_stage: Stage) -> Stage:
    warm_stage.client.resetSimulation()
    return warm_stage


def tilted(position: tuple[float, float, float]) -> Pose:
    axis = np.array([0.3, -0.5, 0.2])
    c = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    angle = float(np.sqrt((axis * axis).sum()))
    rotation = np.eye(3) + np.sin(angle) / angle * c + (1 - np.cos(angle)) / angle**2 * (c @ c)
    return Pose(position=np.array(position), quat_xyzw=quat_from_rotation(rotation))


@pytest.mark.parametrize(("width", "height"), [(96, 96), (161, 75)])
def test_images_have_the_promised_shapes(stage: Stage, width: int, height: int) -> None:
    scenes.add(stage.client, "box", (0.2, 0.2, 0.2))
    camera = scenes.camera(width, height)
    stage.renderer.setup(scenes.setup(stage.client, camera))
    images = scenes.draw(stage.renderer, stage.client)["front"]
    assert images.color.shape == (height, width, 3)
    assert images.color.dtype == np.uint8
    assert images.color.flags.c_contiguous
    assert images.depth is not None
    assert images.depth.shape == (height, width)
    assert images.depth.dtype == np.float32
    assert images.segmentation is not None
    assert images.segmentation.shape == (height, width)
    assert images.segmentation.dtype == np.int32
    assert images.world_from_camera == camera.mount_from_camera
    stage.renderer.setup(scenes.setup(stage.client, camera, depth=False, segmentation=False))
    images = scenes.draw(stage.renderer, stage.client)["front"]
    assert images.depth is None
    assert images.segmentation is None


SHAPES: list[tuple[str, tuple[float, ...], Any]] = [
    ("box", (0.3, 0.2, 0.1), scenes.cast_box),
    ("sphere", (0.15,), scenes.cast_sphere),
    ("cylinder", (0.1, 0.3), scenes.cast_cylinder),
    ("capsule", (0.08, 0.25), scenes.cast_capsule),
]


@pytest.mark.parametrize("antialias", [True, False])
@pytest.mark.parametrize(("kind", "size", "cast"), SHAPES, ids=[row[0] for row in SHAPES])
def test_every_primitive_is_where_rays_meet_it(
    stage: Stage, kind: str, size: tuple[float, ...], cast: Any, antialias: bool
) -> None:
    pose = tilted((0.05, -0.03, 0.1))
    body = scenes.add(stage.client, kind, size, pose)
    camera = scenes.camera(320, 240)
    images = _render(stage.renderer, stage.client, camera, antialias=antialias)
    origin, direction = scenes.rays(camera, pose)
    expected = cast(size, origin, direction) if kind == "box" else cast(*size, origin, direction)
    seen, there = images.segmentation == body, np.isfinite(expected)
    assert there.sum() > 2000
    overlap = (seen & there).sum() / (seen | there).sum()
    assert overlap > (0.998 if stage.name == "raster" and not antialias else stage.bounds.mask)
    assert (images.depth[~seen] == 0).all()
    error = np.abs(images.depth - expected)[seen & there & scenes.away_from_borders(there.astype(np.int32), 2)]
    bounds = stage.bounds
    assert np.median(error) < (bounds.depth_median if kind == "box" else bounds.round_median)
    assert np.quantile(error, 0.99) < (bounds.depth_p99 if kind == "box" else bounds.round_p99)


FILES = ["duck.obj", "kuka_iiwa/meshes/link_0.stl", "duck.dae", "l_finger.stl", "textured_sphere_smooth.obj"]


@pytest.mark.parametrize("file", FILES)
def test_every_mesh_format_is_drawn_as_tiny_draws_it(stage: Stage, file: str) -> None:
    if stage.name == "tiny":
        pytest.skip("it is the reference")
    path = f"{scenes.DATA}/{file}"
    pose = tilted((0.0, 0.0, 0.1))
    # Scaled so that all are about 20 cm large.
    points = {"duck.obj": 2.0, "duck.dae": 2.0, "l_finger.stl": 0.05}.get(file, 0.3)
    scale = 0.2 / points
    body = scenes.add(stage.client, "mesh", (scale, scale, scale), pose, fileName=path)
    camera = scenes.camera(320, 240)
    mine = _render(stage.renderer, stage.client, camera)
    reference = _render(RENDERERS.load("tiny")(), stage.client, camera)
    seen, there = mine.segmentation == body, reference.segmentation == body
    assert there.sum() > 300
    assert (seen & there).sum() / (seen | there).sum() > 0.9
    middle = seen & there & scenes.away_from_borders(there.astype(np.int32), 2)
    assert np.median(np.abs(mine.depth - reference.depth)[middle]) < BOUNDS["tiny"].depth_p99


def _render(renderer: Renderer, client: Any, camera: Any, **changes: Any) -> Any:
    renderer.setup(scenes.setup(client, camera, **changes))
    return scenes.draw(renderer, client)[camera.name]


def test_nothing_is_background(stage: Stage) -> None:
    light = Light(sky_color=(0.2, 0.4, 0.6))
    scenes.add(stage.client, "box", (0.01, 0.01, 0.01), Pose(position=np.array([0.0, 0.0, -5.0])))
    images = _render(stage.renderer, stage.client, scenes.camera(64, 48), light=light)
    assert (images.segmentation == -1).all()
    assert (images.depth == 0).all()
    assert np.argsort(images.color.reshape(-1, 3).mean(0)).tolist() == [0, 1, 2]


def test_objects_beyond_the_clipping_distances_are_not_drawn(stage: Stage) -> None:
    body = scenes.add(stage.client, "box", (0.2, 0.2, 0.2))
    camera = scenes.camera(64, 64)
    assert (_render(stage.renderer, stage.client, camera).segmentation == body).any()
    distance = float(np.sqrt((camera.mount_from_camera.position**2).sum()))
    for near, far in ((distance + 0.4, 6.0), (0.02, distance - 0.4)):
        images = _render(stage.renderer, stage.client, scenes.camera(64, 64, near=near, far=far))
        assert not (images.segmentation == body).any()


def test_the_same_state_gives_the_same_bits(stage: Stage) -> None:
    bodies = scenes.panda_scene(stage.client)
    cameras = scenes.panda_cameras(96, 96)
    stage.renderer.setup(scenes.setup(stage.client, *cameras, mounts=scenes.panda_mounts(bodies)))
    scenes.pose_panda(stage.client, bodies, 0.7)
    first = scenes.draw(stage.renderer, stage.client)
    for t in (0.0, 2.0, 4.0):
        scenes.pose_panda(stage.client, bodies, t)
        scenes.draw(stage.renderer, stage.client)
    scenes.pose_panda(stage.client, bodies, 0.7)
    again = scenes.draw(stage.renderer, stage.client)
    stage.renderer.setup(scenes.setup(stage.client, *cameras, mounts=scenes.panda_mounts(bodies)))
    anew = scenes.draw(stage.renderer, stage.client)
    for name, images in first.items():
        for other in (again, anew):
            assert np.array_equal(images.color, other[name].color)
            assert np.array_equal(present(images.depth), present(other[name].depth))
            assert np.array_equal(present(images.segmentation), present(other[name].segmentation))


@pytest.mark.parametrize(
    ("changes", "words"),
    [({"width": 0}, "0x"), ({"near": 2.0, "far": 1.0}, "near"), ({"mount": "elbow"}, "elbow")],
)
def test_impossible_cameras_are_named(stage: Stage, changes: dict[str, Any], words: str) -> None:
    scenes.add(stage.client, "box", (0.2, 0.2, 0.2))
    with pytest.raises(RenderError, match=words):
        _render(stage.renderer, stage.client, scenes.camera(**changes))


@pytest.mark.slow
def test_an_arm_is_drawn_as_tiny_draws_it(stage: Stage) -> None:
    """Every link has its number, and the wrist camera moves with the hand."""
    if stage.name != "raster":
        pytest.skip("PyBullet draws both")
    bodies = scenes.panda_scene(stage.client)
    front, wrist = scenes.panda_cameras(224, 224)
    setup = scenes.setup(stage.client, front, wrist, mounts=scenes.panda_mounts(bodies))
    tiny = RENDERERS.load("tiny")()
    stage.renderer.setup(setup)
    tiny.setup(setup)
    for t in (0.0, 1.5):
        scenes.pose_panda(stage.client, bodies, t)
        images, reference = scenes.draw(stage.renderer, stage.client), scenes.draw(tiny, stage.client)
        for name in ("front", "wrist"):
            mine, theirs = present(images[name].segmentation), present(reference[name].segmentation)
            depth = present(images[name].depth)
            near = (depth > 0) & (depth < 5.9)  # PyBullet's floor ends before `far`
            inner = near & scenes.away_from_borders(mine, 2) & scenes.away_from_borders(theirs, 2)
            assert (mine == theirs)[inner].mean() > 0.998
        assert len({int(v) >> 24 for v in np.unique(present(images["front"].segmentation)) if v >= 0}) > 6
        state = stage.client.getLinkState(bodies["panda"], 8, computeForwardKinematics=1)
        hand = Pose(position=np.array(state[4]), quat_xyzw=np.array(state[5]))
        expected = (hand @ wrist.mount_from_camera).matrix()
        np.testing.assert_allclose(images["wrist"].world_from_camera.matrix(), expected, atol=1e-9)
