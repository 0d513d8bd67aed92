"""A PyBullet client filled with shapes to be drawn, apart from any simulation.

PyBullet's renderers draw what a client holds. In a client of its own a renderer works whenever it is started, from a
recording as well as beside a simulation, and keeps out of the latter. (The EGL plugin could not do otherwise: it sees
only bodies that were loaded after it, and no second client of the process.)
"""

from __future__ import annotations

import os
import tempfile
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from demorec.core.errors import RenderError
from demorec.core.geometry import Array, Pose
from demorec.episode.scene import Texture
from demorec.render import RenderSetup, Visual, first_rows
from demorec.render.procedural import texture_pixels
from demorec.sim.bodies import shape_arguments


class SceneMirror:
    """Fills a client with the visual shapes of a setup, and puts them where they are wanted.

    Args:
        client: The client that is filled; emptied first.
        setup: The scene.

    Attributes:
        setup: As given.

    Raises:
        RenderError: PyBullet cannot load one of the shapes.
    """

    def __init__(self, client: Any, setup: RenderSetup) -> None:
        self.setup = setup
        self._client = client
        client.resetSimulation()
        # By the number of a shape's body in the client: the row of its pose and its pose there; its number in pictures.
        self._places: dict[int, tuple[int, Pose]] = {}
        self._segments: dict[int, int] = {}
        for number, (body, row) in enumerate(zip(setup.bodies, first_rows(setup.bodies), strict=True)):
            texture = None if body.texture is None else _load_texture(client, body.texture)
            for visual in body.visuals:
                if visual.kind == "plane":
                    continue  # PyBullet draws none that is made like this
                try:
                    index = _add(client, visual, texture)
                except Exception as error:  # PyBullet raises its own bare pybullet.error
                    raise RenderError(
                        f"PyBullet cannot draw body {number} ({body.name!r}), link {visual.link} "
                        f"({visual.file or visual.kind}: {error})."
                    ) from error
                self._places[index] = (row + 1 + visual.link, visual.link_from_shape)
                self._segments[index] = number + ((visual.link + 1) << 24)

    def follow(self, poses: Array) -> None:
        """Put every shape where `poses`, as `Renderer.render` is given them, say."""
        for index, (row, link_from_shape) in self._places.items():
            pose = Pose(position=poses[row, :3], quat_xyzw=poses[row, 3:]) @ link_from_shape
            self._client.resetBasePositionAndOrientation(index, pose.position.tolist(), pose.quat_xyzw.tolist())

    def original_labels(self, labels: NDArray[np.int32]) -> NDArray[np.int32]:
        """Segmentation of the client in the numbers of the setup: body + ((link + 1) << 24)."""
        table = np.full(max(self._segments, default=0) + 2, -1, dtype=np.int32)
        table[list(self._segments)] = list(self._segments.values())
        bodies = np.where(labels >= 0, labels & 0xFFFFFF, len(table) - 1)
        return np.asarray(table[bodies], dtype=np.int32)


def _add(client: Any, visual: Visual, texture: int | None) -> int:
    """A body of one visual shape; returns its index."""
    geometry = shape_arguments(client, visual.kind, visual.size, visual.file)
    index = int(client.createMultiBody(0, -1, client.createVisualShape(**geometry, rgbaColor=visual.rgba)))
    if texture is not None:
        client.changeVisualShape(index, -1, textureUniqueId=texture)
    return index


def _load_texture(client: Any, texture: Texture) -> int:
    """PyBullet takes pixels only by way of a file."""
    descriptor, name = tempfile.mkstemp(suffix=".png", prefix="demorec_texture_")
    os.close(descriptor)
    try:
        Image.fromarray(texture_pixels(texture)).save(name)
        return int(client.loadTexture(name))
    finally:
        os.unlink(name)  # noqa: PTH108
