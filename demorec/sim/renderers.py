"""PyBullet's own renderers, each with a separate client that contains the shapes to draw.

PyBullet's renderers draw the content of a client. With a separate one, a renderer works whenever it is started, from a
recording as well as during a simulation, and does not disturb the latter. (The EGL plugin requires it: it draws only
bodies that were loaded after it, and no second client of the process.)
"""

from __future__ import annotations

import functools
import importlib.util
import subprocess
import sys
import tempfile
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from demorec.core.errors import RenderError
from demorec.core.files import Closing
from demorec.core.geometry import Array, Pose
from demorec.episode.episode import CameraImages
from demorec.episode.scene import SceneCamera, Texture
from demorec.render import RenderSetup, Visual, check_setup, first_rows, world_from_camera
from demorec.render.procedural import texture_pixels
from demorec.sim.bodies import shape_arguments
from demorec.sim.client import connect

# OpenCV's camera axes (y down, z forward) to OpenGL's (y up, z backward).
_GL_FROM_CV = np.array([1.0, -1.0, -1.0])
_NOTHING_HIT = 1.0 - 1e-7
"""Depth buffer value of the background (TinyRenderer's is one float32 step below 1)."""


class TinyRenderer(Closing):
    """PyBullet's CPU renderer, in a client without a window: slow, hard shadows, always available; a context manager.

    It samples half a pixel up and to the left of the pixel centres, and its depth is about a millimetre too small at a
    metre. Neither is corrected: the images stay PyBullet's.
    """

    constant = "ER_TINY_RENDERER"
    """PyBullet's constant of the renderer."""

    def __init__(self) -> None:
        self._client: Any = None
        self._setup: RenderSetup | None = None
        # Body number of a shape in the client -> row of its pose and pose relative to it; -> its number in images.
        self._places: dict[int, tuple[int, Pose]] = {}
        self._segments: dict[int, int] = {}

    def _connect(self) -> Any:
        """Open a client that can draw; RenderError if that is impossible."""
        return connect()

    def close(self) -> None:
        """Free the client; safe to call twice."""
        if self._client is not None:
            self._client.disconnect()
        self._client = self._setup = None

    def setup(self, setup: RenderSetup) -> None:
        """Load a scene.

        Raises:
            RenderError: PyBullet cannot draw on this machine, cannot draw a camera, or cannot load a shape.
        """
        check_setup(setup)
        if self._client is None:
            self._client = self._connect()
        self._client.resetSimulation()
        self._setup, self._places, self._segments = None, {}, {}
        for number, (body, row) in enumerate(zip(setup.bodies, first_rows(setup.bodies), strict=True)):
            texture = None if body.texture is None else _load_texture(self._client, body.texture)
            for visual in body.visuals:
                try:
                    index = _add(self._client, visual, texture)
                except Exception as error:  # PyBullet raises its own bare pybullet.error
                    raise RenderError(
                        f"PyBullet cannot draw body {number} ({body.name!r}), link {visual.link} "
                        f"({visual.file or visual.kind}: {error})."
                    ) from error
                self._places[index] = (row + 1 + visual.link, visual.link_from_shape)
                self._segments[index] = number + ((visual.link + 1) << 24)
        self._setup = setup

    def render(self, poses: Array) -> dict[str, CameraImages]:
        """Draw camera name -> images, with poses (n, 7) as in `Renderer.render`; RuntimeError without a scene."""
        if self._setup is None:
            raise RuntimeError("the renderer has no scene: call setup first")
        for index, (row, link_from_shape) in self._places.items():
            pose = Pose(position=poses[row, :3], quat_xyzw=poses[row, 3:]) @ link_from_shape
            self._client.resetBasePositionAndOrientation(index, pose.position.tolist(), pose.quat_xyzw.tolist())
        return {camera.name: self._draw(self._setup, camera, poses) for camera in self._setup.cameras}

    def _draw(self, setup: RenderSetup, camera: SceneCamera, poses: Array) -> CameraImages:
        client, light = self._client, setup.light
        pose = world_from_camera(setup, camera, poses)
        _, _, rgba, depth, segmentation = client.getCameraImage(
            camera.width,
            camera.height,
            viewMatrix=view_matrix(pose),
            projectionMatrix=client.computeProjectionMatrixFOV(
                np.degrees(camera.fov_y), camera.width / camera.height, camera.near, camera.far
            ),
            lightDirection=light.direction,
            lightColor=light.color,
            lightDistance=3.0,
            lightAmbientCoeff=light.ambient,
            lightDiffuseCoeff=light.diffuse,
            lightSpecularCoeff=light.specular,
            shadow=int(light.shadow > 0),
            flags=client.ER_SEGMENTATION_MASK_OBJECT_AND_LINKINDEX
            if setup.segmentation
            else client.ER_NO_SEGMENTATION_MASK,
            renderer=getattr(client, self.constant),
        )
        shape = (camera.height, camera.width)
        # PyBullet builds without NumPy return tuples of numbers.
        color = np.ascontiguousarray(np.asarray(rgba, np.uint8).reshape(*shape, 4)[:, :, :3])
        buffer = np.asarray(depth, np.float32).reshape(shape)
        labels = np.asarray(segmentation, np.int32).reshape(shape) if setup.segmentation else None
        # PyBullet's background is always white.
        color[buffer >= _NOTHING_HIT] = [round(255 * v) for v in light.sky_color]
        return CameraImages(
            color=color,
            depth=_metric_depth(buffer, camera) if setup.depth else None,
            segmentation=None if labels is None else self._labels(labels),
            world_from_camera=pose,
        )

    def _labels(self, labels: NDArray[np.int32]) -> NDArray[np.int32]:
        """Convert the client's segmentation to the numbers of the setup."""
        table = np.full(max(self._segments, default=0) + 2, -1, dtype=np.int32)
        table[list(self._segments)] = list(self._segments.values())
        return np.asarray(table[np.where(labels >= 0, labels & 0xFFFFFF, len(table) - 1)], dtype=np.int32)


def _add(client: Any, visual: Visual, texture: int | None) -> int:
    """Add a body of one visual shape; returns its index."""
    geometry = shape_arguments(client, visual.kind, visual.size, visual.file)
    index = int(client.createMultiBody(0, -1, client.createVisualShape(**geometry, rgbaColor=visual.rgba)))
    if texture is not None:
        client.changeVisualShape(index, -1, textureUniqueId=texture)
    return index


def _load_texture(client: Any, texture: Texture) -> int:
    """Load a texture by way of a file, PyBullet's only input for pixels."""
    with tempfile.NamedTemporaryFile(suffix=".png", prefix="demorec_texture_") as file:
        Image.fromarray(texture_pixels(texture)).save(file)
        file.flush()
        return int(client.loadTexture(file.name))


def view_matrix(world_from_camera: Pose) -> list[float]:
    """Compute OpenGL's camera_from_world, column by column."""
    matrix: Array = world_from_camera.inverse().matrix()
    matrix[:3] *= _GL_FROM_CV[:, None]
    return [float(v) for v in matrix.T.reshape(-1)]


def _metric_depth(buffer: NDArray[np.float32], camera: SceneCamera) -> NDArray[np.float32]:
    """Convert OpenGL's depth buffer (0..1) to metres along the optical axis; 0 for the background."""
    near, far = camera.near, camera.far
    metres = near * far / (far - (far - near) * buffer.astype(np.float64))
    return np.where(buffer >= _NOTHING_HIT, 0.0, metres).astype(np.float32)


class EglRenderer(TinyRenderer):
    """PyBullet's OpenGL renderer without a window (EGL plugin): fast on a GPU, needs libEGL.

    Only one may exist per process: a second client's images are silently wrong.

    Raises:
        RenderError: The plugin does not work on this machine.
    """

    constant = "ER_BULLET_HARDWARE_OPENGL"

    def __init__(self) -> None:
        super().__init__()
        reason = _egl_problem()
        if reason:
            raise RenderError(
                f"The EGL renderer does not work here ({reason}): install libegl1 (on Debian: apt-get install libegl1 "
                "libgl1-mesa-dri), or use --renderer raster or tiny."
            )
        self._plugin = -1
        self._is_first_image = True

    def _connect(self) -> Any:
        client = super()._connect()
        self._plugin = client.loadPlugin(_egl_plugin(), "_eglRendererPlugin")
        if self._plugin < 0:
            client.disconnect()
            raise RenderError("The EGL renderer could not be loaded into PyBullet: use --renderer raster.")
        self._is_first_image = True
        return client

    def close(self) -> None:
        """See `TinyRenderer.close`."""
        if self._client is not None:
            self._client.unloadPlugin(self._plugin)
        super().close()

    def render(self, poses: Array) -> dict[str, CameraImages]:
        """See `TinyRenderer.render`."""
        if self._is_first_image:  # it differs from all later ones in some pixels
            super().render(poses)
            self._is_first_image = False
        return super().render(poses)


_EGL_TRIAL = """
import sys, pybullet
pybullet.connect(pybullet.DIRECT)
plugin = pybullet.loadPlugin(sys.argv[1], "_eglRendererPlugin")
if plugin < 0:
    sys.exit(3)
pybullet.getCameraImage(16, 16, renderer=pybullet.ER_BULLET_HARDWARE_OPENGL)
print("egl works")
"""


def _egl_plugin() -> str:
    spec = importlib.util.find_spec("eglRenderer")
    if spec is None or spec.origin is None:
        raise RenderError("This PyBullet was built without its EGL renderer: use --renderer raster or tiny.")
    return spec.origin


@functools.cache
def _egl_problem() -> str:
    """Run the plugin in a separate process (without libEGL it crashes); returns "" if it works, else the reason."""
    try:
        result = subprocess.run(
            [sys.executable, "-c", _EGL_TRIAL, _egl_plugin()], capture_output=True, text=True, timeout=120, check=False
        )
    except subprocess.TimeoutExpired:
        return "no answer within 120 s"
    if result.returncode == 0 and "egl works" in result.stdout:
        return ""
    lines = [line for line in (result.stdout + result.stderr).splitlines() if line.strip()]
    return lines[-1] if lines else f"exit status {result.returncode}"
