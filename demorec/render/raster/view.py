"""One camera's images: triangles into samples, samples into shaded pixels; static pixels are kept between images."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from demorec.core.geometry import Pose
from demorec.episode.episode import CameraImages
from demorec.episode.scene import Light, SceneCamera
from demorec.render import RenderSetup
from demorec.render.raster.batch import Batch, Floats32
from demorec.render.raster.kernels import layout
from demorec.render.raster.kernels.antialias import STILL, centre_of_mixed, halve_extents, resolve, shade_edges
from demorec.render.raster.kernels.layout import Images, Looks, Records
from demorec.render.raster.kernels.records import set_up_records
from demorec.render.raster.kernels.shade import shade_rows
from demorec.render.raster.kernels.still import clear_queued, restore_samples, shade_still
from demorec.render.raster.kernels.triangles import draw_instances
from demorec.render.raster.kernels.vertices import aim_camera, project_instances, transform_vertices
from demorec.render.raster.mesh import Floats
from demorec.render.raster.stage import Stage

SHADOW_OFFSET = 0.006
"""Minimum offset of a point from its surface in a shadow map lookup, metres: the map has coarser meshes than the image,
and half of it leaves blotches."""
SHADOW_OFFSET_TEXELS = 2.2
"""Minimum of the same offset in texels: less leaves stripes at grazing light, since a lookup reads 3x3 texels."""
Int32s = NDArray[np.int32]


@dataclass(eq=False)
class _Still:
    """Static instances before a fixed camera, drawn with their own shadows alone.

    Attributes:
        key: Its inputs: camera pose and the poses of static instances.
        images: Finished images.
        values, ids: Samples.
        pixel_ids: Records of pixels.
        num_records, num_vertices: Number that it uses.
        tile_start: (tiles * tiles + 1,) first of the pixels that read each shadow tile.
        tile_pixels, gathered: Those pixels, y * W + x, and their terms.
    """

    key: tuple[bytes, int]
    images: Images
    values: Floats32
    ids: Int32s
    pixel_ids: Int32s
    num_records: int
    num_vertices: int
    tile_start: NDArray[np.int64]
    tile_pixels: NDArray[np.int64]
    gathered: Floats32


class CameraView:
    """The images of one camera over one scene.

    Args:
        camera: Size, lens and clipping distances.
        batch: The scene's meshes at this camera's level of detail.
        stage: State shared by all cameras.
        setup: Its light colours the sky; its flags select depth, segmentation and 2x2 samples per pixel.
        keep_still: Whether static pixels are kept between images, if the camera is fixed.

    Attributes:
        samples: Samples along a pixel's side, 1 or 2.
        values, ids: (H * samples, W * samples) inverse depths, and their records.
        pixel_ids: (H, W) records of pixels, or the special values of `layout`; not antialiased: `ids` itself.
        edges: y * W + x of pixels that are shaded sample by sample.
        geometry: The batch's, with separate vertices.
        records: The triangles drawn.
        looks, still_looks: Colour inputs of all pixels, and of the static layer with its own shadows alone.
    """

    def __init__(
        self, camera: SceneCamera, batch: Batch, stage: Stage, setup: RenderSetup, *, keep_still: bool
    ) -> None:
        self.camera = camera
        self._stage = stage
        antialias = setup.antialias
        self.samples = 2 if antialias else 1
        self.want_depth, self.want_segments = setup.depth, setup.segmentation
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
        self._mixed = np.zeros(h * w if antialias and (setup.depth or setup.segmentation) else 0, dtype=np.int32)
        self._far_value = np.float32(1 / camera.far)
        self.geometry = batch.geometry._replace(vertices=batch.geometry.vertices.copy())
        self.records = _empty_records(len(batch.geometry.faces) + 1024)
        k = camera.intrinsics
        self._lens = np.array([2 * k[0, 0] / w, 2 * k[1, 1] / h])
        self._focal = float(k[0, 0])
        self._clip_from_world = np.zeros((3, 4))
        self.looks = Looks(
            face_table=batch.face_table,
            face_color=batch.face_color,
            texels=batch.texels,
            mips=batch.mips,
            light=stage.light_table,
            sky=_sky_table(setup.light),
            heights=stage.heights.reshape(-1),  # a view: the stage writes in place
            size=stage.shadow_size,
        )
        self.still_looks = self.looks._replace(heights=stage.still_heights.reshape(-1))
        self._keep_still = keep_still and camera.mount == "world"
        self._still: _Still | None = None
        # Extents of moving instances: in samples, and in pixels.
        self._left, self._right = np.full(sh, sw, dtype=np.int32), np.zeros(sh, dtype=np.int32)
        self._pixel_left, self._pixel_right = np.zeros(h, dtype=np.int32), np.zeros(h, dtype=np.int32)
        self._whole_left, self._whole_right = np.zeros(h, dtype=np.int32), np.full(h, w, dtype=np.int32)
        self._scratch_left, self._scratch_right = np.zeros(sh, dtype=np.int32), np.zeros(sh, dtype=np.int32)

    def draw(self, world_from_camera: Pose) -> CameraImages:
        """Draw the image of the stage's current state."""
        pose = world_from_camera.vector()
        self._aim(pose)
        images = self._draw_changes(pose) if self._keep_still else self._draw(len(self._stage.instances), None)[0]
        return CameraImages(
            color=images.color,
            depth=images.depth if self.want_depth else None,
            segmentation=images.segments if self.want_segments else None,
            world_from_camera=world_from_camera,
        )

    def _draw(self, count: int, still: Floats32 | None) -> tuple[Images, int, int]:
        """Draw the first instances onto the background.

        Args:
            count: Number of instances.
            still: As in `Canvas.shade`.

        Returns:
            The images, and the number of records and vertices used.
        """
        records = -1
        while records < 0:  # the buffers grow until they are large enough
            self.values.fill(self._far_value)
            self.ids.fill(layout.BACKGROUND)
            records, vertices = self._draw_instances(
                0, count, 0, self.geometry.num_vertices, self._scratch_left, self._scratch_right
            )
        h, w = self.camera.height, self.camera.width
        images = Images(
            np.empty((h, w, 3), dtype=np.uint8),
            np.empty((h, w) if self.want_depth else (0, 0), dtype=np.float32),
            np.empty((h, w) if self.want_segments else (0, 0), dtype=np.int32),
        )
        counts = self._shade(images, self._whole_left, self._whole_right, 0, records, everything=True, still=still)
        self._finish_edges(images, *counts, self.looks if still is None else self.still_looks)
        return images, records, vertices

    def _draw_changes(self, pose: Floats) -> Images:
        stage = self._stage
        key = (pose.tobytes(), stage.still_version)
        while True:
            if self._still is None or self._still.key != key:
                self._still = self._draw_still(key)
            still = self._still
            restore_samples(self.values, still.values, self.ids, still.ids, self._left, self._right)
            first = still.num_records
            records, _ = self._draw_instances(
                stage.num_still, len(stage.instances), first, still.num_vertices, self._left, self._right
            )
            if records >= 0:
                break
            self._still = None  # the buffers have grown
        left, right = self._left, self._right
        if self.samples == 2:
            left, right = self._pixel_left, self._pixel_right
            halve_extents(self._left, self._right, left, right, self.pixel_ids)
        color, depth, segments = still.images
        images = Images(color.copy(), depth.copy(), segments.copy())
        edge_count, mixed_count = self._shade(images, left, right, first, records, everything=False, still=None)
        all_edges = shade_still(
            stage.touched,
            still.tile_start,
            still.tile_pixels,
            still.gathered,
            first,
            self.pixel_ids,
            still.pixel_ids,
            self.looks,
            images.color,
            self.edges,
            edge_count,
        )
        self._finish_edges(images, all_edges, mixed_count, self.looks)
        if self.samples == 2:
            clear_queued(self.edges, edge_count, all_edges, self.pixel_ids, STILL)
        return images

    def _draw_still(self, key: tuple[bytes, int]) -> _Still:
        """Draw static instances, with their own shadows."""
        stage = self._stage
        h, w = self.camera.height, self.camera.width
        terms = np.zeros((h, w, layout.STILL_SIZE), dtype=np.float32)
        images, records, vertices = self._draw(stage.num_still, terms)
        tile_start, tile_pixels = self._list_tiles(terms)
        pixel_ids = self.pixel_ids.copy()
        if self.samples == 2:
            self.pixel_ids.fill(STILL)
            self._pixel_left.fill(0)
            self._pixel_right.fill(0)
        self._left.fill(self.ids.shape[1])
        self._right.fill(0)
        return _Still(
            key=key,
            images=images,
            values=self.values.copy(),
            ids=self.ids.copy(),
            pixel_ids=pixel_ids,
            num_records=records,
            num_vertices=vertices,
            tile_start=tile_start,
            tile_pixels=tile_pixels,
            gathered=terms.reshape(-1, layout.STILL_SIZE)[tile_pixels],
        )

    def _list_tiles(self, terms: Floats32) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """List the pixels that read each shadow tile, as in `_Still`; edges are listed for each of their samples.

        Args:
            terms: (H, W, STILL_SIZE) from shading.
        """
        width, records = self.camera.width, self.records
        whole = np.flatnonzero(self.pixel_ids >= 0)
        places = terms.reshape(-1, layout.STILL_SIZE)[whole, 6:8]
        rows, columns = np.nonzero(self.pixel_ids == layout.EDGE)
        sample_x = 2 * columns[:, None] + np.array([0, 1, 0, 1])
        sample_y = 2 * rows[:, None] + np.array([0, 0, 1, 1])
        drawn = self.ids[sample_y, sample_x] >= 0
        sample_x, sample_y = sample_x[drawn], sample_y[drawn]
        record = self.ids[sample_y, sample_x]
        fx, fy = (np.stack([sample_x, sample_y]) - records.origins[record].T).astype(np.float32)
        planes = records.planes[record].T
        z = 1 / (planes[0] + planes[2] * fy + planes[1] * fx)
        x = np.concatenate([places[:, 0], (planes[3] + planes[5] * fy + planes[4] * fx) * z])
        y = np.concatenate([places[:, 1], (planes[6] + planes[8] * fy + planes[7] * fx) * z])
        pixels = np.concatenate([whole, sample_y // 2 * width + sample_x // 2])
        limit = self._stage.shadow_size - 1
        inside = (x >= 0) & (y >= 0) & (x < limit) & (y < limit)
        tiles = self._stage.touched.shape[1]
        tile_x, tile_y = np.stack([x, y])[:, inside].astype(np.int64) >> layout.TILE_SHIFT
        tile = tile_y * tiles + tile_x
        order = np.argsort(tile, kind="stable")
        return np.searchsorted(tile[order], np.arange(tiles**2 + 1)), pixels[inside][order]

    def _aim(self, pose: Floats) -> None:
        """Compute the matrices of the camera and of every instance, and the sky's rays."""
        stage, camera = self._stage, self.camera
        aim_camera(pose, self._lens, self._focal, camera.width, camera.height, self._clip_from_world, self.looks.sky)
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

    def _draw_instances(
        self, first: int, last: int, record: int, vertex: int, left: Int32s, right: Int32s
    ) -> tuple[int, int]:
        """Draw instances; returns the next free record and vertex, or -1 after enlarging the buffers."""
        stage = self._stage
        sh, sw = self.ids.shape
        transform_vertices(
            first,
            last,
            self._visible,
            self.geometry,
            self._clip_from_shape,
            stage.shadow_from_shape,
            stage.light_in_shape,
            stage.world_from_shape,
            self._eye_in_shape,
            np.float32(max(SHADOW_OFFSET, SHADOW_OFFSET_TEXELS * stage.texel)),
            sw,
            sh,
        )
        record, vertex = draw_instances(
            first,
            last,
            record,
            vertex,
            self.geometry,
            self._visible,
            self.values,
            self.ids,
            np.float32(self.camera.near),
            self.records,
            left,
            right,
        )
        if record < 0:
            # Clipping created more vertices than the buffer can hold.
            vertices = self.geometry.vertices
            more = np.zeros(max(4 * layout.BLOCK, len(vertices)), dtype=np.float32)
            self.geometry = self.geometry._replace(vertices=np.concatenate([vertices, more]))
            self.records = _empty_records(2 * len(self.records.faces))
        return record, vertex

    def _shade(
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
        """Shade the pixels of records from `first` (all with `everything`); returns edge and mixed counts."""
        lowest = layout.BACKGROUND if everything else first
        records, face_table, looks = self.records, self.looks.face_table, self.looks
        if still is None:
            still = np.zeros((0, 0, layout.STILL_SIZE), dtype=np.float32)
        else:
            looks = self.still_looks
        counts = 0, 0
        if self.samples == 2:
            counts = resolve(
                left, right, lowest, self.ids, self.values, records, face_table, self.pixel_ids, self.edges, self._mixed
            )
        set_up_records(first, last, records, face_table, self.geometry.vertices)
        shade_rows(left, right, lowest, self.pixel_ids, self.samples, records, looks, images, still)
        return counts

    def _finish_edges(self, images: Images, edge_count: int, mixed_count: int, looks: Looks) -> None:
        """Shade the listed edges, and resolve mixed pixels at their centres; no effect without antialiasing."""
        if self.samples == 1:
            return
        shade_edges(edge_count, self.edges, self.ids, self.records, looks, images.color)
        if self._mixed.size:
            centre_of_mixed(
                self._mixed,
                mixed_count,
                self.ids,
                self.values,
                self.records,
                looks.face_table,
                self.geometry.vertices,
                self._far_value,
                images,
            )


def _empty_records(count: int) -> Records:
    return Records(
        corners=np.zeros((count, 3), dtype=np.int32),
        faces=np.zeros(count, dtype=np.int32),
        planes=np.zeros((count, layout.RECORD), dtype=np.float32),
        origins=np.zeros((count, 2), dtype=np.int32),
    )


def _sky_table(light: Light) -> Floats32:
    """Build the table of kernels.layout; the rays are set by the first camera."""
    table = np.zeros(layout.SKY_SIZE, dtype=np.float32)
    sky = 255 * np.asarray(light.sky_color, dtype=np.float64)
    table[layout.SKY_HORIZON : layout.SKY_ZENITH] = sky + 0.35 * (250 - sky) * (sky < 250)
    table[layout.SKY_ZENITH :] = sky * 0.9
    return table
