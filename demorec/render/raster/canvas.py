"""One camera's buffers and the passes over them: triangles into samples, samples into shaded pixels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.episode.scene import Light, SceneCamera
from demorec.render.raster.batch import Batch, Floats32
from demorec.render.raster.kernels import layout
from demorec.render.raster.kernels.antialias import STILL, centre_of_mixed, resolve, shade_edges
from demorec.render.raster.kernels.records import flag_owners, set_up_records
from demorec.render.raster.kernels.shade import shade_rows
from demorec.render.raster.kernels.triangles import draw_instances
from demorec.render.raster.kernels.vertices import aim_camera, project_instances, transform_vertices
from demorec.render.raster.mesh import Floats
from demorec.render.raster.stage import Stage

SHADOW_OFFSET = 0.006
"""How far a point is at least lifted off its surface before it is looked up in the shadow map, metres: the map holds
coarser meshes than the image, and half of it leaves blotches."""
SHADOW_OFFSET_TEXELS = 2.2
"""And in texels: less leaves stripes where the light grazes a surface, since 3x3 texels are looked at."""
Int32s = NDArray[np.int32]


@dataclass(eq=False)
class Images:
    """(H, W, 3) colour, (H, W) depth and segmentation; the latter two of size (1, 1) when not wanted."""

    color: NDArray[np.uint8]
    depth: NDArray[np.float32]
    segments: Int32s

    def copy(self) -> Images:
        """The same images in memory of their own."""
        return Images(self.color.copy(), self.depth.copy(), self.segments.copy())


class Canvas:
    """The buffers of one camera over one scene.

    Args:
        camera: Size, lens and clipping distances.
        batch: The scene's meshes at this camera's level of detail.
        stage: What all cameras share.
        light: For the sky.
        antialias: 2x2 samples a pixel instead of one.
        depth, segmentation: Whether these are drawn.

    Attributes:
        samples: Along a pixel's side, 1 or 2.
        values, ids: (H * samples, W * samples) inverse depths, and the records that they came from.
        pixel_ids: (H, W) records of pixels, or what stands for them (layout); not antialiased: `ids` itself.
        edges: y * W + x of pixels that are shaded sample by sample.
        records, origins: Planes of the triangles (layout), and where they start.
    """

    def __init__(
        self,
        camera: SceneCamera,
        batch: Batch,
        stage: Stage,
        light: Light,
        *,
        antialias: bool,
        depth: bool,
        segmentation: bool,
    ) -> None:
        self.camera = camera
        self._batch = batch
        self._stage = stage
        self.samples = 2 if antialias else 1
        self.want_depth, self.want_segments = depth, segmentation
        h, w = camera.height, camera.width
        sh, sw = h * self.samples, w * self.samples
        n = len(stage.instances)
        self._clip_from_shape = np.zeros((n, 3, 4))
        self._eye_in_shape = np.zeros((n, 3))
        self._visible = np.zeros(n, dtype=np.bool_)
        self.values = np.zeros((sh, sw), dtype=np.float32)
        self.ids = np.zeros((sh, sw), dtype=np.int32)
        self.pixel_ids = np.full((h, w), STILL, dtype=np.int32) if antialias else self.ids
        self.edges = np.zeros(h * w if antialias else 1, dtype=np.int32)
        self._mixed = np.zeros(h * w if antialias and (depth or segmentation) else 1, dtype=np.int32)
        self._no_still = np.zeros((1, 1, layout.STILL_SIZE), dtype=np.float32)
        self._far_value = np.float32(1 / camera.far)
        self._vertices = batch.geometry.vertices.copy()
        self._make_records(len(batch.geometry.faces) + 1024)
        k = camera.intrinsics
        self._lens = np.array([2 * k[0, 0] / w, 2 * k[1, 1] / h])
        self._focal = float(k[0, 0])
        self._clip_from_world = np.zeros((3, 4))
        self._sky = _sky_table(light)

    @property
    def num_vertices(self) -> int:
        """Of the scene, without those that clipping makes."""
        return self._batch.geometry.num_vertices

    def _make_records(self, count: int) -> None:
        self._corners = np.zeros((count, 3), dtype=np.int32)
        self._faces = np.zeros(count, dtype=np.int32)
        self._flags = np.zeros(count, dtype=np.uint8)
        self.records = np.zeros((count, layout.RECORD), dtype=np.float32)
        self.origins = np.zeros((count, 2), dtype=np.int32)

    def aim(self, pose: Floats) -> None:
        """Matrices of the camera and of every instance, and the sky's rays."""
        stage, camera = self._stage, self.camera
        aim_camera(pose, self._lens, self._focal, camera.width, camera.height, self._clip_from_world, self._sky)
        project_instances(
            stage.world_from_shape,
            stage.centre,
            stage.radius,
            self._clip_from_world,
            pose,
            camera.near,
            camera.far,
            self._clip_from_shape,
            self._eye_in_shape,
            self._visible,
        )

    def new_images(self) -> Images:
        """Images to be filled."""
        h, w = self.camera.height, self.camera.width
        return Images(
            np.empty((h, w, 3), dtype=np.uint8),
            np.empty((h, w) if self.want_depth else (1, 1), dtype=np.float32),
            np.empty((h, w) if self.want_segments else (1, 1), dtype=np.int32),
        )

    def clear(self) -> None:
        """Nothing but background."""
        self.values.fill(self._far_value)
        self.ids.fill(layout.BACKGROUND)

    def draw_instances(
        self, first: int, last: int, record: int, vertex: int, left: Int32s, right: Int32s
    ) -> tuple[int, int]:
        """Draw instances; returns the next free record and vertex, or -1 after the buffers have been enlarged."""
        geometry, stage = self._batch.geometry, self._stage
        sh, sw = self.ids.shape
        transform_vertices(
            first,
            last,
            self._visible,
            geometry.vertex_start,
            geometry.vertex_count,
            self._vertices,
            self._clip_from_shape,
            stage.shadow_from_shape,
            stage.light_in_shape,
            stage.world_from_shape,
            self._eye_in_shape,
            np.float32(max(SHADOW_OFFSET, SHADOW_OFFSET_TEXELS * stage.texel)),
            sw,
            sh,
        )
        capacity = len(self._vertices) // layout.BLOCK * layout.LANES
        record, vertex = draw_instances(
            record,
            first,
            last,
            self._visible,
            geometry.face_start,
            geometry.face_end,
            geometry.faces,
            self._vertices,
            vertex,
            capacity,
            sw,
            sh,
            np.float32(self.camera.near),
            self.values.reshape(-1),
            self.ids.reshape(-1),
            self._corners,
            self._faces,
            left,
            right,
        )
        if record < 0:
            # More triangles were clipped than there was room for.
            blocks = max(4, capacity // layout.LANES)
            self._vertices = np.concatenate([self._vertices, np.zeros(blocks * layout.BLOCK, dtype=np.float32)])
            self._make_records(2 * len(self._faces))
        return record, vertex

    def shade(
        self,
        images: Images,
        left: Int32s,
        right: Int32s,
        first: int,
        last: int,
        *,
        everything: bool,
        still: Floats32 | None,
    ) -> tuple[int, int]:
        """Shade the pixels of records from `first` (all with `everything`); returns the numbers of edges and mixed."""
        lowest = layout.BACKGROUND if everything else first
        heights = self._stage.heights if still is None else self._stage.still_heights
        self._flags[first:last] = 0
        edge_count, mixed_count = self._find_owners(left, right, first, lowest)
        set_up_records(
            first,
            last,
            self._flags,
            self._corners,
            self._faces,
            self._batch.face_table,
            self._vertices,
            self.records,
            self.origins,
        )
        shade_rows(
            left,
            right,
            lowest,
            self.pixel_ids,
            self.samples,
            *self._surfaces(heights),
            images.color,
            still is not None,
            self._no_still if still is None else still,
            self.want_depth,
            images.depth,
            self.want_segments,
            images.segments,
        )
        return edge_count, mixed_count

    def _surfaces(self, heights: Floats32) -> tuple[Any, ...]:
        """What shading asks about what lies under a sample: records, faces, light and shadow, textures, sky."""
        batch, stage = self._batch, self._stage
        faces = self._faces, batch.face_table, batch.face_color, self.records, self.origins
        shadow = heights.reshape(-1), stage.shadow_size
        return (*faces, stage.light_table, *shadow, batch.texels, batch.mips, self._sky)

    def _find_owners(self, left: Int32s, right: Int32s, first: int, lowest: int) -> tuple[int, int]:
        """Flag the records that own pixels, list the edges between them; returns the numbers of edges and mixed."""
        if self.samples != 2:
            flag_owners(left, right, first, self.ids, self._flags)
            return 0, 0
        edge_count, mixed_count = resolve(
            left,
            right,
            lowest,
            self.ids,
            self.values,
            self._faces,
            self._batch.face_table,
            self.pixel_ids,
            self.edges,
            0,
            self._mixed,
            self.want_depth or self.want_segments,
            self._flags,
        )
        return edge_count, mixed_count

    def finish_edges(self, images: Images, edge_count: int, mixed_count: int, heights: Floats32) -> None:
        """Shade the listed edges, and see what lies at the centres of mixed pixels; nothing when not antialiased."""
        if self.samples == 1:
            return
        width = self.camera.width
        shade_edges(0, edge_count, self.edges, self.ids, width, *self._surfaces(heights), images.color)
        if self.want_depth or self.want_segments:
            centre_of_mixed(
                self._mixed,
                mixed_count,
                width,
                self.ids,
                self.values,
                self._corners,
                self._faces,
                self._batch.face_table,
                self._vertices,
                self.records,
                self.origins,
                self._far_value,
                self.want_depth,
                images.depth,
                self.want_segments,
                images.segments,
            )


def _sky_table(light: Light) -> Floats32:
    """See kernels.layout; the rays are those of no camera yet."""
    table = np.zeros(layout.SKY_SIZE, dtype=np.float32)
    sky = 255 * np.asarray(light.sky_color, dtype=np.float64)
    table[layout.SKY_HORIZON : layout.SKY_ZENITH] = sky + 0.35 * (250 - sky) * (sky < 250)
    table[layout.SKY_ZENITH :] = sky * 0.9
    return table
