"""The rasteriser: cached images, shadows, textures, light, levels of detail, detection of changes."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from support import render as scenes
from support.present import present

from demorec.core.geometry import Pose, look_at
from demorec.episode.mesh import SolidMesh
from demorec.episode.scene import Light, Texture
from demorec.render.raster import RasterRenderer


@pytest.fixture
def client() -> Any:
    connection = scenes.connect()
    yield connection
    connection.disconnect()


def image(client: Any, camera: Any, **changes: Any) -> Any:
    with RasterRenderer() as raster:
        raster.setup(scenes.setup(client, camera, **changes))
        return scenes.draw(raster, client)[camera.name]


def same(one: Any, two: Any) -> bool:
    return all(np.array_equal(getattr(one, n), getattr(two, n)) for n in ("color", "depth", "segmentation"))


@pytest.mark.slow
@pytest.mark.parametrize("antialias", [True, False])
def test_reusing_static_pixels_changes_no_bit(client: Any, antialias: bool) -> None:
    bodies = scenes.panda_scene(client)
    front, _ = scenes.panda_cameras(160, 120)
    kept, redrawn = RasterRenderer(), RasterRenderer(keep_still=False)
    setup = scenes.setup(client, front, mounts=scenes.panda_mounts(bodies), antialias=antialias)
    kept.setup(setup)
    redrawn.setup(setup)
    random = np.random.default_rng(7)
    distinct = set()
    for _ in range(25):
        scenes.pose_panda(client, bodies, random.uniform(0, 60))
        # Cubes that fly, so that shadows wander over table, floor and robot.
        for cube in ("cube1", "cube2"):
            quat = random.normal(size=4)
            client.resetBasePositionAndOrientation(
                bodies[cube], random.uniform((0.1, -0.4, 0.0), (0.8, 0.4, 0.7)), quat / np.sqrt((quat**2).sum())
            )
        one, two = scenes.draw(kept, client)["front"], scenes.draw(redrawn, client)["front"]
        assert same(one, two)
        distinct.add(one.color.tobytes())
    assert len(distinct) == 25


def test_each_face_of_a_solid_has_the_texture_projected_along_its_axis(client: Any, tmp_path: Path) -> None:
    size = np.array([0.4, 0.3, 0.2])
    box = trimesh.creation.box(extents=size)
    solid = SolidMesh(points=np.array(box.vertices), faces=np.array(box.faces), parts=())
    (tmp_path / "solid.obj").write_text(solid.surface_obj())
    body = scenes.add(client, "mesh", (1.0, 1.0, 1.0), fileName=str(tmp_path / "solid.obj"), rgbaColor=[1, 1, 1, 1])
    camera = scenes.camera(256, 256)
    texture = Texture(pattern="checker", colors=((1.0, 1.0, 1.0), (0.0, 0.0, 0.0)), scale=8.0)
    seen = image(client, camera, textures={body: texture}, antialias=False)
    origin, direction = scenes.rays(camera, Pose())
    depth = scenes.cast_box(size, origin, direction)
    point = origin + np.where(np.isfinite(depth), depth, 0.0)[..., None] * direction
    cells = (point + size / 2) / 0.4 * 8.0  # the texture is as wide as the longest side
    faced = np.argmax(np.abs(point) / size, axis=-1)
    for axis in range(3):
        sides = [other for other in range(3) if other != axis]
        inside = np.abs(cells - np.round(cells))[..., sides].min(axis=-1) > 0.15
        shown = (faced == axis) & inside & (seen.segmentation == body)
        assert shown.sum() > 300
        dark = np.floor(cells)[..., sides].sum(axis=-1) % 2 == 0  # the first row of its pixels is at the top
        assert np.array_equal(seen.color[shown].max(axis=-1) < 20, dark[shown])


def test_distant_textures_turn_to_their_mean(client: Any) -> None:
    # Without mipmaps a distant checkerboard flickers between its colours.
    texture = Texture(pattern="checker", colors=((1.0, 1.0, 1.0), (0.0, 0.0, 0.0)), scale=128.0)
    body = scenes.add(client, "box", (1.0, 1.0, 0.02), rgbaColor=[1, 1, 1, 1])
    camera = scenes.camera(192, 192, mount_from_camera=look_at((2.7, -1.35, 2.25), (0.0, 0.0, 0.0)))
    origin, direction = scenes.rays(camera, Pose())
    for smooth in (True, False):
        seen = image(client, camera, textures={body: texture}, antialias=smooth)
        flat = image(client, camera, antialias=smooth)
        on_top = np.abs(seen.depth - (0.01 - origin[2]) / direction[..., 2]) < 1e-3
        inner = on_top & scenes.away_from_borders(on_top.astype(np.int32), 3)
        assert inner.sum() > 500
        assert seen.color[inner].std() < 6
        assert 0.4 < seen.color[inner].mean() / flat.color[inner].mean() < 0.65


def test_a_shadow_is_where_the_light_casts_it(client: Any) -> None:
    floor = scenes.add(
        client, "box", (1.0, 1.0, 0.1), Pose(position=np.array([0.0, 0.0, -0.05])), rgbaColor=[0.7, 0.7, 0.7, 1]
    )
    height, radius = 0.3, 0.06
    scenes.add(client, "sphere", (radius,), Pose(position=np.array([0.0, 0.0, height])))
    light = Light(direction=(0.5, -0.4, 1.0))
    camera = scenes.camera(320, 240)
    images = image(client, camera, light=light)
    unshadowed = image(client, camera, light=Light(direction=light.direction, shadow=0.0))
    origin, direction = scenes.rays(camera, Pose())
    place = origin + (-origin[2] / direction[..., 2])[..., None] * direction
    towards = np.array(light.direction) / math.sqrt(0.25 + 0.16 + 1)
    # Distance of the line from a floor point towards the light to the sphere's centre.
    offset = np.array([0.0, 0.0, height]) - place
    distance = np.sqrt(((offset - (offset @ towards)[..., None] * towards) ** 2).sum(-1))
    on_floor = (images.segmentation == floor) & (np.abs(place[..., :2]) < 0.48).all(-1)
    on_floor &= scenes.away_from_borders(images.segmentation, 2)
    ratio = images.color.astype(float).mean(-1) / unshadowed.color.astype(float).mean(-1)
    core, free = on_floor & (distance < radius - 0.02), on_floor & (distance > radius + 0.02)
    assert core.sum() > 50
    assert ratio[core].max() < 0.8
    # No other pixel is darker: no shadow acne.
    assert ratio[free].min() > 0.995
    assert images.color[free].std(0).max() < 2


def test_a_camera_inside_a_mesh_clips_more_than_the_buffers_hold(client: Any) -> None:
    # Thousands of triangles cross the guard planes at once: the buffers must grow, not overflow.
    body = scenes.add(
        client, "mesh", (30.0, 30.0, 30.0), fileName=f"{scenes.DATA}/textured_sphere_smooth.obj", mass=1.0
    )
    camera = scenes.camera(64, 64, near=0.001, far=100.0)
    for smooth in (True, False):
        with RasterRenderer() as raster:
            raster.setup(scenes.setup(client, camera, antialias=smooth))
            for height in (0.0, 29.99, 30.0005):
                client.resetBasePositionAndOrientation(body, [0, 0, -height], [0, 0, 0, 1])
                images = scenes.draw(raster, client)["front"]
                assert np.isfinite(present(images.depth)).all()
