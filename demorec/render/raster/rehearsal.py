"""A scene made of numbers alone that runs every kernel once, with the types that real scenes have."""

from __future__ import annotations

from typing import Any

import numpy as np

from demorec.geometry import look_at
from demorec.render.raster.batch import make_batch
from demorec.render.raster.canvas import Canvas
from demorec.render.raster.mesh import RasterMesh
from demorec.render.raster.primitives import box, sphere
from demorec.render.raster.shapes import Instance, Model
from demorec.render.raster.stage import Stage
from demorec.render.raster.view import CameraView
from demorec.scene.scene import Camera, Light


def _instance(body: int, mesh: RasterMesh, *, stands: bool, texture: Any = None) -> Instance:
    return Instance(
        body=body,
        link=-1,
        row=body,
        model=Model(key=str(body), mesh=mesh),
        scale=np.ones(3),
        link_from_shape=np.eye(4)[:3].copy(),
        color=np.ones(3),
        texture=texture,
        stands=stands,
        has_links=False,
        centre=np.zeros(3),
        radius=0.2,
    )


def rehearse() -> None:
    """Draw a box and a sphere in every mode."""
    picture = np.full((4, 4, 3), 128, dtype=np.uint8)
    instances = [
        _instance(0, box((0.3, 0.3, 0.1)), stands=True, texture=picture),
        _instance(1, sphere(0.1), stands=False),
    ]
    light = Light()
    camera = Camera(
        name="rehearsal",
        width=32,
        height=24,
        fov_y=1.0,
        mount="world",
        mount_from_camera=look_at((0.8, 0, 0.5), (0, 0, 0)),
    )
    stage = Stage(instances, light, shadow_size=64, caster_faces=[None, None])
    poses = np.array([[0.0, 0.0, 0.15 * body, 0.0, 0.0, 0.0, 1.0] for body in range(2)])
    batch = make_batch(instances, [None, None], specular=light.specular)
    for antialias in (True, False):
        for keep_still in (True, False):
            canvas = Canvas(camera, batch, stage, light, antialias=antialias, depth=True, segmentation=True)
            view = CameraView(canvas, stage, keep_still=keep_still)
            stage.update(poses)
            view.draw(camera.mount_from_camera)
