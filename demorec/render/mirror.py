"""A copy of a scene's looks in another PyBullet client, for renderers that must have a client to themselves.

PyBullet's EGL plugin sees only bodies that were loaded after it, and no second client of the process; with a client of
its own it works whenever it is started, and keeps out of the simulation.
"""

from __future__ import annotations

import os
import tempfile
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from demorec.errors import RenderError
from demorec.geometry import Pose
from demorec.render import RenderSetup
from demorec.scene import Texture
from demorec.textures import texture_pixels


@dataclass(frozen=True, kw_only=True)
class _Copy:
    """One visual shape: where it comes from, and its body in the copy."""

    body: int
    link: int
    link_from_shape: Pose
    copy: int


class SceneMirror:
    """Fills a client with the visual shapes of a setup, and keeps their poses and colours up.

    Args:
        client: The client that is filled; emptied first.
        setup: The scene.

    Raises:
        RenderError: PyBullet cannot load one of the shapes.
    """

    def __init__(self, client: Any, setup: RenderSetup) -> None:
        self._client = client
        self._source = setup.client
        client.resetSimulation()
        self._copies: list[_Copy] = []
        self._textures = {body: _load_texture(client, texture) for body, texture in setup.textures.items()}
        self._shapes = self._read_shapes()
        for shape in self._shapes:
            self._add(shape)

    def _read_shapes(self) -> tuple[tuple[Any, ...], ...]:
        source = self._source
        return tuple(
            shape
            for number in range(source.getNumBodies())
            for shape in source.getVisualShapeData(source.getBodyUniqueId(number))
        )

    def is_current(self) -> bool:
        """Whether the scene still has the looks that were copied."""
        return self._read_shapes() == self._shapes

    def _add(self, shape: tuple[Any, ...]) -> None:
        client = self._client
        body, link, kind, size, file, position, quat, rgba = shape[:8]
        geometry: dict[str, Any] = {"shapeType": kind, "rgbaColor": rgba}
        if kind == client.GEOM_MESH:
            geometry |= {"fileName": file.decode(), "meshScale": size}
        elif kind == client.GEOM_BOX:
            geometry |= {"halfExtents": [v / 2 for v in size]}
        elif kind == client.GEOM_SPHERE:
            geometry |= {"radius": size[0]}
        elif kind in (client.GEOM_CYLINDER, client.GEOM_CAPSULE):
            geometry |= {"length": size[0], "radius": size[1]}
        else:
            return  # PyBullet draws nothing for the rest (planes)
        try:
            visual = client.createVisualShape(**geometry)
            copy = client.createMultiBody(0, -1, visual)
        except Exception as error:  # PyBullet raises its own bare pybullet.error
            raise RenderError(f"PyBullet cannot draw body {body}, link {link} ({file.decode()}: {error}).") from error
        if body in self._textures:
            client.changeVisualShape(copy, -1, textureUniqueId=self._textures[body])
        place = Pose(position=np.array(position), quat_xyzw=np.array(quat))
        if link == -1:
            dynamics = self._source.getDynamicsInfo(body, -1)
            place = Pose(position=np.array(dynamics[3]), quat_xyzw=np.array(dynamics[4])).inverse() @ place
        self._copies.append(_Copy(body=body, link=link, link_from_shape=place, copy=copy))

    def follow(self) -> None:
        """Put every shape where it is now."""
        poses: dict[tuple[int, int], Pose] = {}
        for item in self._copies:
            place = (item.body, item.link)
            if place not in poses:
                if item.link == -1:
                    position, quat = self._source.getBasePositionAndOrientation(item.body)
                else:
                    state = self._source.getLinkState(item.body, item.link, computeForwardKinematics=1)
                    position, quat = state[4:6]
                poses[place] = Pose(position=np.array(position), quat_xyzw=np.array(quat))
            pose = poses[place] @ item.link_from_shape
            self._client.resetBasePositionAndOrientation(item.copy, pose.position.tolist(), pose.quat_xyzw.tolist())

    def original_labels(self, labels: NDArray[np.int32]) -> NDArray[np.int32]:
        """Segmentation of the copy in the numbers of the original: body + ((link + 1) << 24)."""
        table = np.full(max((item.copy for item in self._copies), default=0) + 2, -1, dtype=np.int32)
        for item in self._copies:
            table[item.copy] = item.body + ((item.link + 1) << 24)
        bodies = np.where(labels >= 0, labels & 0xFFFFFF, len(table) - 1)
        return np.asarray(table[bodies], dtype=np.int32)


def _load_texture(client: Any, texture: Texture) -> int:
    """PyBullet takes pixels only by way of a file."""
    descriptor, name = tempfile.mkstemp(suffix=".png", prefix="demorec_texture_")
    os.close(descriptor)
    try:
        Image.fromarray(texture_pixels(texture)).save(name)
        return int(client.loadTexture(name))
    finally:
        os.unlink(name)  # noqa: PTH108
