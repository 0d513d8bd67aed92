"""State shared by all cameras of a step: poses, light and the shadow map."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import RenderError
from demorec.episode.scene import Light
from demorec.render.raster.batch import caster_geometry
from demorec.render.raster.kernels import layout
from demorec.render.raster.kernels.still import restore_samples
from demorec.render.raster.kernels.triangles import draw_casters
from demorec.render.raster.kernels.vertices import place_instances, transform_casters
from demorec.render.raster.mesh import Floats
from demorec.render.raster.shapes import Instance

REACH = 0.9
"""Expected extent of a robot's shadow around its base, metres."""
LARGEST_RADIUS = 1.2
"""Maximum radius of the shadowed region, metres: a larger one would make texels coarse. The outside is lit."""
LARGE = 2.0
"""Radius above which shapes (floors) receive shadows but cast none, metres."""
BELOW = -1e9
"""Height of the empty shadow map."""


class Stage:
    """The scene's instances, their poses at this step and the shadow that they cast.

    Args:
        instances: Instances, static ones first.
        light: Direction, colour and strengths.
        shadow_size: Texels along the side of the shadow map; a multiple of the tile.
        caster_faces: Faces of each instance in the shadow map.
    """

    def __init__(
        self,
        instances: Sequence[Instance],
        light: Light,
        *,
        shadow_size: int,
        caster_faces: Sequence[int],
    ) -> None:
        self.instances = tuple(instances)
        self.num_still = sum(instance.stands for instance in instances)
        n = len(instances)
        self.link_from_shape = np.array([i.link_from_shape for i in instances]).reshape(n, 3, 4)
        self.centre = np.array([i.centre for i in instances]).reshape(n, 3)
        self.radius = np.array([i.radius for i in instances])
        self._rows = np.array([i.row for i in instances], dtype=np.int64)
        self.pose: Floats = np.zeros((n, 7))
        self.world_from_shape = np.zeros((n, 3, 4))
        self.shadow_from_shape = np.zeros((n, 3, 4))
        self.light_in_shape = np.zeros((n, 3))
        self.light_table = _light_table(light)
        self.still_version = 0
        """Increases when a static instance has been moved."""
        self._still_pose: bytes | None = None

        direction = np.asarray(light.direction, dtype=np.float64)
        length = math.sqrt(float((direction * direction).sum()))
        if length == 0 or not math.isfinite(length):
            raise RenderError(f"The light's direction is {light.direction}: give a finite vector of length above 0.")
        self.light = direction / length
        self.shadow_size = shadow_size
        self.shadow_from_world: Floats = np.zeros((3, 4))
        self.texel = 0.0
        casts = [instance.radius < LARGE and light.shadow > 0 for instance in instances]
        self._casters = caster_geometry(instances, caster_faces, casts)
        tiles = shadow_size >> layout.TILE_SHIFT
        self.heights = np.full((shadow_size, shadow_size), BELOW, dtype=np.float32)
        self.still_heights = self.heights.copy()
        self.touched = np.zeros((tiles, tiles), dtype=np.uint8)
        self._ids = np.zeros((shadow_size, shadow_size), dtype=np.int32)
        # Extents of moving instances in the map.
        self._left = np.full(shadow_size, shadow_size, dtype=np.int32)
        self._right = np.zeros(shadow_size, dtype=np.int32)

    def _fit_shadow(self) -> tuple[Floats, float]:
        """Compute (3, 4) world to shadow map (texels, texels, metres), and metres per texel.

        The region depends on static instances alone: a shadow must not change because of motion elsewhere.
        """
        low, high = np.full(3, np.inf), np.full(3, -np.inf)
        for number, instance in enumerate(self.instances):
            if not instance.stands or instance.radius >= LARGE:
                continue
            place = np.array(self.pose[number, :3])
            reach = REACH if instance.has_links else instance.radius
            low, high = np.minimum(low, place - reach), np.maximum(high, place + reach)
        if not np.isfinite(low).all():
            low, high = np.full(3, -1.0), np.full(3, 1.0)
        centre = (low + high) / 2
        radius = min(LARGEST_RADIUS, float(np.sqrt((((high - low) / 2) ** 2).sum())))
        helper = np.array([0.0, 1.0, 0.0]) if abs(self.light[1]) < 0.9 else np.array([1.0, 0.0, 0.0])
        right = np.cross(helper, self.light)
        right /= math.sqrt(float((right * right).sum()))
        up = np.cross(self.light, right)
        scale = self.shadow_size / (2 * radius)
        matrix = np.zeros((3, 4))
        for row, axis, factor, offset in (
            (0, right, scale, self.shadow_size / 2 - 0.5),
            (1, up, scale, self.shadow_size / 2 - 0.5),
            (2, self.light, 1.0, 0.0),
        ):
            matrix[row, :3] = axis * factor
            matrix[row, 3] = offset - float((axis * centre).sum()) * factor
        return matrix, 1 / scale

    def update(self, poses: Floats) -> None:
        """Set the poses of `Renderer.render` and draw the shadow map.

        Static instances are drawn once, moving ones each time.
        """
        self.pose = poses[self._rows]
        still_pose = self.pose[: self.num_still].tobytes()
        still_moved = still_pose != self._still_pose
        if still_moved:
            self._still_pose = still_pose
            self.still_version += 1
            self.shadow_from_world, self.texel = self._fit_shadow()
        place_instances(
            self.pose,
            self.link_from_shape,
            self.shadow_from_world,
            self.light,
            self.world_from_shape,
            self.shadow_from_shape,
            self.light_in_shape,
        )
        if still_moved:
            self.still_heights.fill(BELOW)
            self._draw(0, self.num_still, self.still_heights)
            self._left.fill(0)
            self._right.fill(self.shadow_size)
        restore_samples(self.heights, self.still_heights, self._ids, self._ids, self._left, self._right)
        self.touched.fill(0)
        self._draw(self.num_still, len(self.instances), self.heights)

    def _draw(self, first: int, last: int, heights: NDArray[np.float32]) -> None:
        transform_casters(first, last, self._casters, self.shadow_from_shape)
        draw_casters(first, last, self._casters, heights, self._ids, self.touched, self._left, self._right)


def _light_table(light: Light) -> NDArray[np.float32]:
    """Build the table of kernels.layout; surfaces that face up get slightly more ambient light than those below."""
    table = np.zeros(layout.LIGHT_SIZE, dtype=np.float32)
    table[layout.AMBIENT] = light.ambient * 0.88
    table[layout.AMBIENT_UP] = light.ambient * 0.12
    table[layout.DIFFUSE] = light.diffuse
    table[layout.IN_SHADOW] = 1 - light.shadow
    table[layout.LIGHT_RED : layout.LIGHT_BLUE + 1] = light.color
    return table
