"""The renderer: loads a scene, then draws all cameras of a step; and the warm-up that compiles its kernels."""

from __future__ import annotations

import functools
import logging
import math
from dataclasses import replace

import numpy as np

from demorec.core.files import Closing, folder_lock
from demorec.core.geometry import Array, Pose, look_at
from demorec.episode.episode import CameraImages
from demorec.episode.scene import SceneCamera, Texture
from demorec.render import RenderSetup, Visual, VisualBody, VisualKind, check_setup, world_from_camera
from demorec.render.raster.batch import Batch, make_batch
from demorec.render.raster.kernels.jit import compiled_folder
from demorec.render.raster.shapes import Instance, ModelStore, make_instances
from demorec.render.raster.stage import Stage
from demorec.render.raster.view import CameraView

log = logging.getLogger(__name__)

FACES_PER_PIXEL = 9.0
"""Triangles of a mesh per pixel of its diameter; below about 5, outlines look chipped."""
WORKING_DISTANCE = {"world": 0.8, "link": 0.3}
"""Expected distance of moving objects from a camera in the world, or on a link, metres. Levels of detail depend on it
instead of actual distances, so that nothing pops and images depend on the present state alone."""
CASTER_FACES_PER_METRE = 900.0
"""Triangles of a mesh in the shadow map per metre of its diameter."""


class RasterRenderer(Closing):
    """The default renderer, on the CPU, compiled with numba: no system package, no GPU. See docs/rendering.md.

    Args:
        keep_still: Whether fixed cameras reuse static pixels; the images are bit-exact either way.
    """

    def __init__(self, *, keep_still: bool = True) -> None:
        self._keep_still = keep_still
        self._store = ModelStore()
        self._setup: RenderSetup | None = None
        self._views: list[CameraView] = []
        self._stage: Stage | None = None
        warm_up()

    def close(self) -> None:
        """Free buffers, meshes and textures; safe to call twice."""
        self._setup, self._stage, self._views = None, None, []
        self._store = ModelStore()

    def setup(self, setup: RenderSetup) -> None:
        """Load a scene.

        Raises:
            RenderError: A shape, mesh, texture or camera, named in the message, cannot be drawn.
        """
        check_setup(setup)
        self._setup = setup
        instances = make_instances(setup.bodies, self._store)
        largest = max((camera.height for camera in setup.cameras), default=0)
        self._stage = Stage(
            instances,
            setup.light,
            shadow_size=shadow_size(largest),
            caster_faces=[caster_faces(instance) for instance in instances],
        )
        batches: dict[tuple[int, ...], Batch] = {}
        self._views = []
        for camera in setup.cameras:
            levels = tuple(self._level(instance, camera) for instance in instances)
            if levels not in batches:
                batches[levels] = make_batch(instances, levels, specular=setup.light.specular)
            view = CameraView(camera, batches[levels], self._stage, setup, keep_still=self._keep_still)
            self._views.append(view)

    def _level(self, instance: Instance, camera: SceneCamera) -> int:
        """Compute the number of faces of an instance for a camera."""
        distance = WORKING_DISTANCE["world" if camera.mount == "world" else "link"]
        pixels = 2 * instance.radius * float(camera.intrinsics[1, 1]) / distance
        return power_of_two(FACES_PER_PIXEL * pixels)

    def render(self, poses: Array) -> dict[str, CameraImages]:
        """Draw camera name -> images, with poses (n, 7) as in `Renderer.render`; RuntimeError without a scene."""
        setup, stage = self._setup, self._stage
        if setup is None or stage is None:
            raise RuntimeError("the renderer has no scene: call setup first")
        stage.update(poses)
        return {
            camera.name: view.draw(world_from_camera(setup, camera, poses))
            for camera, view in zip(setup.cameras, self._views, strict=True)
        }


def shadow_size(height: int) -> int:
    """Choose the side of the shadow map, texels, for images of a height."""
    return 512 if height <= 128 else 768 if height <= 320 else 1024


def power_of_two(count: float) -> int:
    """Round to the nearest power of two, at least 64, so that few levels are made and cached."""
    return 1 << max(6, round(math.log2(max(count, 1.0))))


def caster_faces(instance: Instance) -> int:
    """Compute the number of faces of an instance in the shadow map."""
    return power_of_two(CASTER_FACES_PER_METRE * 2 * instance.radius)


@functools.cache
def warm_up() -> None:
    """Compile the kernels unless this or another process has done so; once for each kind of CPU.

    Call it before starting several processes: they then find compiled code instead of each compiling it.
    """
    folder = compiled_folder()
    done = folder / "complete"
    if done.exists():
        return
    with folder_lock(folder):
        if done.exists():
            return
        log.warning("Compiling the renderer for this machine: about half a minute, once (kept in %s).", folder)
        rehearse()
        done.touch()


def rehearse() -> None:
    """Draw a box and a sphere in every mode."""
    texture = Texture(pattern="plain", colors=((0.5, 0.5, 0.5), (0.5, 0.5, 0.5)))
    shapes: dict[VisualKind, tuple[float, ...]] = {"box": (0.3, 0.3, 0.1), "sphere": (0.1,)}
    bodies = [
        VisualBody(
            name=kind,
            num_links=0,
            is_fixed=kind == "box",
            visuals=(Visual(link=-1, kind=kind, size=size, link_from_shape=Pose(), rgba=(1.0, 1.0, 1.0, 1.0)),),
            texture=texture if kind == "box" else None,
        )
        for kind, size in shapes.items()
    ]
    instances = make_instances(bodies, ModelStore())
    pose = look_at((0.8, 0, 0.5), (0, 0, 0))
    camera = SceneCamera(name="rehearsal", width=32, height=24, fov_y=1.0, mount="world", mount_from_camera=pose)
    setup = RenderSetup(bodies=(), cameras=(), depth=True, segmentation=True)
    stage = Stage(instances, setup.light, shadow_size=64, caster_faces=[64, 64])
    poses = np.array([[0.0, 0.0, 0.15 * body, 0.0, 0.0, 0.0, 1.0] for body in range(2)])
    batch = make_batch(instances, [64, 64], specular=setup.light.specular)
    for antialias in (True, False):
        for keep_still in (True, False):
            view = CameraView(camera, batch, stage, replace(setup, antialias=antialias), keep_still=keep_still)
            stage.update(poses)
            view.draw(pose)
