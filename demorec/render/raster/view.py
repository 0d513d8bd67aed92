"""One camera's pictures: everything redrawn, or what stands still kept and only the rest redrawn."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from demorec.episode import CameraImages
from demorec.geometry import Pose
from demorec.render.raster.batch import Batch, Floats32
from demorec.render.raster.kernels import layout
from demorec.render.raster.kernels.antialias import (
    STILL,
    centre_of_mixed,
    halve_extents,
    resolve,
    shade_edges,
)
from demorec.render.raster.kernels.records import flag_owners, set_up_records
from demorec.render.raster.kernels.shade import shade_rows
from demorec.render.raster.kernels.still import clear_queued, gather_still, list_tiles, restore_samples, shade_still
from demorec.render.raster.kernels.triangles import draw_instances
from demorec.render.raster.kernels.vertices import aim_camera, project_instances, transform_vertices
from demorec.render.raster.mesh import Floats
from demorec.render.raster.stage import Stage
from demorec.scene import Camera, Light

SHADOW_OFFSET = 0.006
"""How far a point is at least lifted off its surface before it is looked up in the shadow map, metres: the map holds
coarser meshes than the picture, and half of it leaves blotches."""
SHADOW_OFFSET_TEXELS = 2.2
"""And in texels: less leaves stripes where the light grazes a surface, since 3x3 texels are looked at."""
Int32s = NDArray[np.int32]


@dataclass(eq=False)
class _Images:
    """Colour, depth and segmentation; the latter two of size (1, 1) when not wanted."""

    color: NDArray[np.uint8]
    depth: NDArray[np.float32]
    segments: Int32s

    def copy(self) -> _Images:
        return _Images(self.color.copy(), self.depth.copy(), self.segments.copy())


@dataclass(eq=False)
class _Still:
    """What stands still before a fixed camera, as drawn with its own shadows alone.

    Attributes:
        key: What it depends on: camera pose and the poses of what stands still.
        images: Finished pictures.
        values, ids: Samples.
        pixel_ids: Records of pixels.
        num_records, num_vertices: Used up by it.
        tile_start, tile_pixels, gathered: Which pixels look into which shadow tile, and their terms.
    """

    key: tuple[bytes, int]
    images: _Images
    values: Floats32
    ids: Int32s
    pixel_ids: Int32s
    num_records: int
    num_vertices: int
    tile_start: NDArray[np.int64]
    tile_pixels: Int32s
    gathered: Floats32


class View:
    """The buffers of one camera over one scene.

    Args:
        camera: Size, lens and clipping distances.
        batch: The scene's meshes at this camera's level of detail.
        stage: What all cameras share.
        light: For the sky.
        antialias: 2x2 samples a pixel instead of one.
        depth, segmentation: Whether these are drawn.
        keep_still: Whether what stands still is kept between pictures (fixed cameras).
    """

    def __init__(
        self,
        camera: Camera,
        batch: Batch,
        stage: Stage,
        light: Light,
        *,
        antialias: bool,
        depth: bool,
        segmentation: bool,
        keep_still: bool,
    ) -> None:
        self.camera = camera
        self._batch = batch
        self._stage = stage
        self._samples = 2 if antialias else 1
        self._want_depth, self._want_segments = depth, segmentation
        self._keep_still = keep_still
        self._still: _Still | None = None
        h, w = camera.height, camera.width
        sh, sw = h * self._samples, w * self._samples
        n = len(stage.instances)
        self._clip_from_shape = np.zeros((n, 3, 4))
        self._eye_in_shape = np.zeros((n, 3))
        self._visible = np.zeros(n, dtype=np.bool_)
        self._values = np.zeros((sh, sw), dtype=np.float32)
        self._ids = np.zeros((sh, sw), dtype=np.int32)
        self._pixel_ids = np.full((h, w), STILL, dtype=np.int32) if antialias else self._ids
        self._edges = np.zeros(h * w if antialias else 1, dtype=np.int32)
        self._mixed = np.zeros(h * w if antialias and (depth or segmentation) else 1, dtype=np.int32)
        # Extents of what moves: in samples, and in pixels.
        self._left, self._right = np.full(sh, sw, dtype=np.int32), np.zeros(sh, dtype=np.int32)
        self._pixel_left, self._pixel_right = np.zeros(h, dtype=np.int32), np.zeros(h, dtype=np.int32)
        self._whole_left, self._whole_right = np.zeros(h, dtype=np.int32), np.full(h, w, dtype=np.int32)
        self._scratch_left, self._scratch_right = np.zeros(sh, dtype=np.int32), np.zeros(sh, dtype=np.int32)
        self._no_still = np.zeros((1, 1, layout.STILL_SIZE), dtype=np.float32)
        self._far_value = np.float32(1 / camera.far)
        self._vertices = batch.geometry.vertices.copy()
        self._make_records(len(batch.geometry.faces) + 1024)
        k = camera.intrinsics
        self._lens = np.array([2 * k[0, 0] / w, 2 * k[1, 1] / h])
        self._focal = float(k[0, 0])
        self._clip_from_world = np.zeros((3, 4))
        self._sky = _sky_table(light)

    def _make_records(self, count: int) -> None:
        self._corners = np.zeros((count, 3), dtype=np.int32)
        self._faces = np.zeros(count, dtype=np.int32)
        self._flags = np.zeros(count, dtype=np.uint8)
        self._records = np.zeros((count, layout.RECORD), dtype=np.float32)
        self._origins = np.zeros((count, 2), dtype=np.int32)

    def draw(self, world_from_camera: Pose) -> CameraImages:
        """The picture of the stage's present state."""
        pose = world_from_camera.vector()
        self._aim(pose)
        images = self._draw_changes(pose) if self._keep_still else self._draw_all()
        return CameraImages(
            color=images.color,
            depth=images.depth if self._want_depth else None,
            segmentation=images.segments if self._want_segments else None,
            world_from_camera=world_from_camera,
        )

    def _aim(self, pose: Floats) -> None:
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

    def _new_images(self) -> _Images:
        h, w = self.camera.height, self.camera.width
        return _Images(
            np.empty((h, w, 3), dtype=np.uint8),
            np.empty((h, w) if self._want_depth else (1, 1), dtype=np.float32),
            np.empty((h, w) if self._want_segments else (1, 1), dtype=np.int32),
        )

    def _clear(self) -> None:
        self._values.fill(self._far_value)
        self._ids.fill(layout.BACKGROUND)

    def _draw_instances(
        self, first: int, last: int, record: int, vertex: int, left: Int32s, right: Int32s
    ) -> tuple[int, int]:
        """Draw instances; returns the next free record and vertex, or -1 after the buffers have been enlarged."""
        geometry, stage = self._batch.geometry, self._stage
        sh, sw = self._ids.shape
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
            self._values.reshape(-1),
            self._ids.reshape(-1),
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
            self._still = None
        return record, vertex

    def _shade(
        self,
        images: _Images,
        left: Int32s,
        right: Int32s,
        first: int,
        last: int,
        *,
        everything: bool,
        still: Floats32 | None,
    ) -> tuple[int, int]:
        """Shade the pixels of records from `first` (all with `everything`); returns the numbers of edges and mixed."""
        batch, stage = self._batch, self._stage
        lowest = layout.BACKGROUND if everything else first
        heights = stage.heights if still is None else stage.still_heights
        edge_count = mixed_count = 0
        self._flags[first:last] = 0
        if self._samples == 2:
            edge_count, mixed_count = resolve(
                left,
                right,
                lowest,
                self._ids,
                self._values,
                self._faces,
                batch.face_table,
                self._pixel_ids,
                self._edges,
                0,
                self._mixed,
                self._want_depth or self._want_segments,
                self._flags,
            )
        else:
            flag_owners(left, right, first, self._ids, self._flags)
        set_up_records(
            first,
            last,
            self._flags,
            self._corners,
            self._faces,
            batch.face_table,
            self._vertices,
            self._records,
            self._origins,
        )
        shade_rows(
            left,
            right,
            lowest,
            self._pixel_ids,
            self._samples,
            self._faces,
            batch.face_table,
            batch.face_color,
            self._records,
            self._origins,
            stage.light_table,
            heights.reshape(-1),
            stage.shadow_size,
            batch.texels,
            batch.mips,
            self._sky,
            images.color,
            still is not None,
            self._no_still if still is None else still,
            self._want_depth,
            images.depth,
            self._want_segments,
            images.segments,
        )
        return edge_count, mixed_count

    def _finish_edges(self, images: _Images, edge_count: int, mixed_count: int, heights: Floats32) -> None:
        if self._samples == 1:
            return
        batch, stage = self._batch, self._stage
        shade_edges(
            0,
            edge_count,
            self._edges,
            self._ids,
            self.camera.width,
            self._faces,
            batch.face_table,
            batch.face_color,
            self._records,
            self._origins,
            stage.light_table,
            heights.reshape(-1),
            stage.shadow_size,
            batch.texels,
            batch.mips,
            self._sky,
            images.color,
        )
        if self._want_depth or self._want_segments:
            centre_of_mixed(
                self._mixed,
                mixed_count,
                self.camera.width,
                self._ids,
                self._values,
                self._corners,
                self._faces,
                batch.face_table,
                self._vertices,
                self._records,
                self._origins,
                self._far_value,
                self._want_depth,
                images.depth,
                self._want_segments,
                images.segments,
            )

    def _draw_all(self) -> _Images:
        while True:
            self._clear()
            n = len(self._stage.instances)
            num_vertices = self._batch.geometry.num_vertices
            records, _ = self._draw_instances(0, n, 0, num_vertices, self._scratch_left, self._scratch_right)
            if records >= 0:
                break
        images = self._new_images()
        counts = self._shade(images, self._whole_left, self._whole_right, 0, records, everything=True, still=None)
        self._finish_edges(images, *counts, self._stage.heights)
        return images

    def _draw_changes(self, pose: Floats) -> _Images:
        stage = self._stage
        key = (pose.tobytes(), stage.still_version)
        while True:
            if self._still is None or self._still.key != key:
                self._still = self._draw_still(key)
                if self._still is None:
                    continue  # the buffers have grown
            still = self._still
            restore_samples(
                self._values.reshape(-1),
                still.values.reshape(-1),
                self._ids.reshape(-1),
                still.ids.reshape(-1),
                self._left,
                self._right,
                self._ids.shape[1],
            )
            first = still.num_records
            records, _ = self._draw_instances(
                stage.num_still, len(stage.instances), first, still.num_vertices, self._left, self._right
            )
            if records >= 0:
                break
        left, right = self._left, self._right
        if self._samples == 2:
            left, right = self._pixel_left, self._pixel_right
            halve_extents(self._left, self._right, left, right, self._pixel_ids)
        images = still.images.copy()
        edge_count, mixed_count = self._shade(images, left, right, first, records, everything=False, still=None)
        all_edges = shade_still(
            stage.touched,
            still.tile_start,
            still.tile_pixels,
            still.gathered,
            first,
            self._pixel_ids,
            still.pixel_ids,
            stage.light_table,
            stage.heights.reshape(-1),
            stage.shadow_size,
            images.color,
            self._edges,
            edge_count,
        )
        self._finish_edges(images, all_edges, mixed_count, stage.heights)
        if self._samples == 2:
            clear_queued(self._edges, edge_count, all_edges, self._pixel_ids, STILL)
        return images

    def _draw_still(self, key: tuple[bytes, int]) -> _Still | None:
        """Draw what stands still, with its own shadows; None when the buffers had to grow."""
        stage = self._stage
        h, w = self.camera.height, self.camera.width
        self._clear()
        num_vertices = self._batch.geometry.num_vertices
        records, vertices = self._draw_instances(
            0, stage.num_still, 0, num_vertices, self._scratch_left, self._scratch_right
        )
        if records < 0:
            return None
        images = self._new_images()
        terms = np.zeros((h, w, layout.STILL_SIZE), dtype=np.float32)
        counts = self._shade(images, self._whole_left, self._whole_right, 0, records, everything=True, still=terms)
        self._finish_edges(images, *counts, stage.still_heights)
        tiles = stage.touched.shape[0]
        tile_start = np.zeros(tiles * tiles + 1, dtype=np.int64)
        tile_pixels = np.zeros(h * w * self._samples**2, dtype=np.int32)
        list_tiles(
            terms,
            self._pixel_ids,
            self._ids,
            self._records,
            self._origins,
            tiles,
            stage.shadow_size,
            tile_start,
            tile_pixels,
        )
        count = int(tile_start[-1])
        gathered = np.zeros((count + 1, layout.STILL_SIZE), dtype=np.float32)
        gather_still(terms, tile_pixels, count, w, gathered)
        pixel_ids = self._pixel_ids.copy()
        if self._samples == 2:
            self._pixel_ids.fill(STILL)
            self._pixel_left.fill(0)
            self._pixel_right.fill(0)
        self._left.fill(self._ids.shape[1])
        self._right.fill(0)
        return _Still(
            key=key,
            images=images,
            values=self._values.copy(),
            ids=self._ids.copy(),
            pixel_ids=pixel_ids,
            num_records=records,
            num_vertices=vertices,
            tile_start=tile_start,
            tile_pixels=tile_pixels[:count].copy(),
            gathered=gathered,
        )


def _sky_table(light: Light) -> Floats32:
    """See kernels.layout; the rays are those of no camera yet."""
    table = np.zeros(layout.SKY_SIZE, dtype=np.float32)
    sky = 255 * np.asarray(light.sky_color, dtype=np.float64)
    table[layout.SKY_HORIZON : layout.SKY_ZENITH] = sky + 0.35 * (250 - sky) * (sky < 250)
    table[layout.SKY_ZENITH :] = sky * 0.9
    return table
