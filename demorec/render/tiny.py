"""PyBullet's own CPU renderer (TinyRenderer) behind the `Renderer` protocol: slow, no shadows, always there.

It samples half a pixel up and to the left of the pixels' centres, and its depth is about a millimetre too small at a
metre. Both are left as they are: the pictures are PyBullet's.
"""

from __future__ import annotations

from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from demorec.episode import CameraImages
from demorec.errors import RenderError
from demorec.geometry import Array, Pose
from demorec.render import RenderSetup
from demorec.render.setup_checks import check_setup, world_from_camera
from demorec.scene import Camera

# OpenCV's camera axes (y down, z forward) to OpenGL's (y up, z backward).
_GL_FROM_CV = np.array([1.0, -1.0, -1.0])
_NOTHING_HIT = 1.0 - 1e-7
"""Depth buffer value of the background (TinyRenderer's is one float32 step below 1)."""


class TinyRenderer:
    """Draws through `getCameraImage` of the client."""

    def __init__(self) -> None:
        self._setup: RenderSetup | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def close(self) -> None:
        """Forget the scene; harmless when called twice."""
        self._setup = None

    def setup(self, setup: RenderSetup) -> None:
        """Take over a freshly built scene.

        Raises:
            RenderError: PyBullet was built without NumPy, or a camera cannot draw.
        """
        require_numpy(setup.client)
        check_setup(setup)
        self._setup = setup

    def render(self) -> dict[str, CameraImages]:
        """Camera name -> images of the present state."""
        if self._setup is None:
            raise RuntimeError("the renderer has no scene: call setup first")
        return {
            camera.name: draw(self._setup, camera, renderer=self._setup.client.ER_TINY_RENDERER)
            for camera in self._setup.cameras
        }


def require_numpy(client: Any) -> None:
    """Raise RenderError unless PyBullet returns pictures as arrays."""
    if not client.isNumpyEnabled():
        raise RenderError(
            "PyBullet was compiled without NumPy, which makes pictures unusably slow: install numpy and setuptools "
            "first, then run pip install --no-build-isolation --no-cache-dir --force-reinstall --no-deps pybullet "
            "(or use uv, whose settings in pyproject.toml see to it)."
        )


def draw(setup: RenderSetup, camera: Camera, *, renderer: int, client: Any = None) -> CameraImages:
    """One camera's images through PyBullet's `getCameraImage`, of the setup's client or a copy of it."""
    client = client or setup.client
    pose = world_from_camera(setup, camera)
    light = setup.light
    _, _, rgba, depth, segmentation = client.getCameraImage(
        camera.width,
        camera.height,
        viewMatrix=_view_matrix(pose),
        projectionMatrix=setup.client.computeProjectionMatrixFOV(
            np.degrees(camera.fov_y), camera.width / camera.height, camera.near, camera.far
        ),
        lightDirection=light.direction,
        lightColor=light.color,
        lightDistance=3.0,
        lightAmbientCoeff=light.ambient,
        lightDiffuseCoeff=light.diffuse,
        lightSpecularCoeff=light.specular,
        shadow=int(light.shadow > 0),
        flags=setup.client.ER_SEGMENTATION_MASK_OBJECT_AND_LINKINDEX
        if setup.segmentation
        else setup.client.ER_NO_SEGMENTATION_MASK,
        renderer=renderer,
    )
    shape = (camera.height, camera.width)
    color = np.ascontiguousarray(np.reshape(rgba, (*shape, 4))[:, :, :3], dtype=np.uint8)
    # PyBullet's background is always white.
    color[np.reshape(depth, shape) >= _NOTHING_HIT] = [round(255 * v) for v in light.sky_color]
    return CameraImages(
        color=color,
        depth=_metric_depth(np.reshape(depth, shape), camera) if setup.depth else None,
        segmentation=np.array(np.reshape(segmentation, shape), dtype=np.int32) if setup.segmentation else None,
        world_from_camera=pose,
    )


def _view_matrix(world_from_camera: Pose) -> list[float]:
    """OpenGL's camera_from_world, column by column."""
    inverse = world_from_camera.inverse()
    matrix: Array = inverse.matrix()
    matrix[:3] *= _GL_FROM_CV[:, None]
    return [float(v) for v in matrix.T.reshape(-1)]


def _metric_depth(buffer: NDArray[np.float32], camera: Camera) -> NDArray[np.float32]:
    """OpenGL's depth buffer (0..1) in metres along the optical axis; 0 where nothing is hit."""
    near, far = camera.near, camera.far
    metres = near * far / (far - (far - near) * buffer.astype(np.float64))
    return np.where(buffer >= _NOTHING_HIT, 0.0, metres).astype(np.float32)
