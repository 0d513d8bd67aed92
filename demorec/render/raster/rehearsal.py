"""A scene made of numbers alone that runs every kernel once, with the types that real scenes have."""

from __future__ import annotations

import numpy as np

from demorec.core.geometry import Pose, look_at
from demorec.episode.scene import Light, SceneCamera, Texture
from demorec.render import Visual, VisualBody, VisualKind
from demorec.render.raster.batch import make_batch
from demorec.render.raster.canvas import Canvas
from demorec.render.raster.shapes import ModelStore, make_instances
from demorec.render.raster.stage import Stage
from demorec.render.raster.view import CameraView


def _body(kind: VisualKind, *size: float, is_fixed: bool, texture: Texture | None = None) -> VisualBody:
    visual = Visual(link=-1, kind=kind, size=size, link_from_shape=Pose(), rgba=(1.0, 1.0, 1.0, 1.0))
    return VisualBody(name=kind, num_links=0, is_fixed=is_fixed, visuals=(visual,), texture=texture)


def rehearse() -> None:
    """Draw a box and a sphere in every mode."""
    texture = Texture(pattern="plain", colors=((0.5, 0.5, 0.5), (0.5, 0.5, 0.5)))
    bodies = [_body("box", 0.3, 0.3, 0.1, is_fixed=True, texture=texture), _body("sphere", 0.1, is_fixed=False)]
    instances = make_instances(bodies, ModelStore())
    light = Light()
    camera = SceneCamera(
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
