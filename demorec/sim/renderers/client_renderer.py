"""What PyBullet's renderers have in common: a client of their own, and pictures through its `getCameraImage`."""

from __future__ import annotations

from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from demorec.core.geometry import Array, Pose
from demorec.episode.episode import CameraImages
from demorec.episode.scene import SceneCamera
from demorec.render import RenderSetup
from demorec.render.setup_checks import check_setup, world_from_camera
from demorec.sim.client import connect
from demorec.sim.renderers.mirror import SceneMirror

# OpenCV's camera axes (y down, z forward) to OpenGL's (y up, z backward).
_GL_FROM_CV = np.array([1.0, -1.0, -1.0])
_NOTHING_HIT = 1.0 - 1e-7
"""Depth buffer value of the background (TinyRenderer's is one float32 step below 1)."""


class ClientRenderer:
    """Draws the shapes of a setup in a client of its own; a context manager."""

    constant: ClassVar[str]
    """PyBullet's name of the renderer that draws."""

    def __init__(self) -> None:
        self._client: Any = None
        self._mirror: SceneMirror | None = None

    def _connect(self) -> Any:
        """A new client that can draw; RenderError when there can be none."""
        return connect()

    def _disconnect(self, client: Any) -> None:
        """Give the client up."""
        client.disconnect()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def close(self) -> None:
        """Free the client; harmless when called twice."""
        if self._client is not None:
            self._disconnect(self._client)
        self._client = self._mirror = None

    def setup(self, setup: RenderSetup) -> None:
        """Take over a scene.

        Raises:
            RenderError: PyBullet cannot draw here, or cannot draw a camera or load a shape.
        """
        check_setup(setup)
        if self._client is None:
            self._client = self._connect()
        self._mirror = SceneMirror(self._client, setup)

    def render(self, poses: Array) -> dict[str, CameraImages]:
        """Camera name -> images, with poses (n, 7) as of `Renderer.render`; RuntimeError without a scene."""
        if self._mirror is None:
            raise RuntimeError("the renderer has no scene: call setup first")
        self._mirror.follow(poses)
        return {camera.name: self._draw(self._mirror, camera, poses) for camera in self._mirror.setup.cameras}

    def _draw(self, mirror: SceneMirror, camera: SceneCamera, poses: Array) -> CameraImages:
        client, setup = self._client, mirror.setup
        pose = world_from_camera(setup, camera, poses)
        light = setup.light
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
        # A PyBullet that was built without NumPy gives tuples of numbers.
        color = np.ascontiguousarray(np.asarray(rgba, np.uint8).reshape(*shape, 4)[:, :, :3])
        buffer = np.asarray(depth, np.float32).reshape(shape)
        labels = np.asarray(segmentation, np.int32).reshape(shape) if setup.segmentation else None
        # PyBullet's background is always white.
        color[buffer >= _NOTHING_HIT] = [round(255 * v) for v in light.sky_color]
        return CameraImages(
            color=color,
            depth=_metric_depth(buffer, camera) if setup.depth else None,
            segmentation=None if labels is None else mirror.original_labels(labels),
            world_from_camera=pose,
        )


def view_matrix(world_from_camera: Pose) -> list[float]:
    """OpenGL's camera_from_world, column by column."""
    inverse = world_from_camera.inverse()
    matrix: Array = inverse.matrix()
    matrix[:3] *= _GL_FROM_CV[:, None]
    return [float(v) for v in matrix.T.reshape(-1)]


def _metric_depth(buffer: NDArray[np.float32], camera: SceneCamera) -> NDArray[np.float32]:
    """OpenGL's depth buffer (0..1) in metres along the optical axis; 0 where nothing is hit."""
    near, far = camera.near, camera.far
    metres = near * far / (far - (far - near) * buffer.astype(np.float64))
    return np.where(buffer >= _NOTHING_HIT, 0.0, metres).astype(np.float32)


class TinyRenderer(ClientRenderer):
    """PyBullet's own CPU renderer, in a client without a window: slow, hard shadows, always there.

    It samples half a pixel up and to the left of the pixels' centres, and its depth is about a millimetre too small at
    a metre. Both are left as they are: the images are PyBullet's.
    """

    constant = "ER_TINY_RENDERER"
