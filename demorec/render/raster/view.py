"""One camera's images: everything redrawn, or static pixels kept and only the rest redrawn."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from demorec.core.geometry import Pose
from demorec.episode.episode import CameraImages
from demorec.render.raster.batch import Floats32
from demorec.render.raster.canvas import Canvas, Int32s
from demorec.render.raster.kernels import layout
from demorec.render.raster.kernels.antialias import STILL, halve_extents
from demorec.render.raster.kernels.layout import Images
from demorec.render.raster.kernels.still import clear_queued, gather_still, list_tiles, restore_samples, shade_still
from demorec.render.raster.mesh import Floats
from demorec.render.raster.stage import Stage


@dataclass(eq=False)
class _Still:
    """Static instances before a fixed camera, drawn with their own shadows alone.

    Attributes:
        key: Its inputs: camera pose and the poses of static instances.
        images: Finished images.
        values, ids: Samples.
        pixel_ids: Records of pixels.
        num_records, num_vertices: Number that it uses.
        tile_start, tile_pixels, gathered: Pixels that read each shadow tile, and their terms.
    """

    key: tuple[bytes, int]
    images: Images
    values: Floats32
    ids: Int32s
    pixel_ids: Int32s
    num_records: int
    num_vertices: int
    tile_start: NDArray[np.int64]
    tile_pixels: Int32s
    gathered: Floats32


class CameraView:
    """The images of one camera over one scene.

    Args:
        canvas: The camera's buffers.
        stage: State shared by all cameras.
        keep_still: Whether static pixels are kept between images (fixed cameras).
    """

    def __init__(self, canvas: Canvas, stage: Stage, *, keep_still: bool) -> None:
        self._canvas = canvas
        self._stage = stage
        self._keep_still = keep_still
        self._still: _Still | None = None
        h, w = canvas.camera.height, canvas.camera.width
        sh, sw = canvas.ids.shape
        # Extents of moving instances: in samples, and in pixels.
        self._left, self._right = np.full(sh, sw, dtype=np.int32), np.zeros(sh, dtype=np.int32)
        self._pixel_left, self._pixel_right = np.zeros(h, dtype=np.int32), np.zeros(h, dtype=np.int32)
        self._whole_left, self._whole_right = np.zeros(h, dtype=np.int32), np.full(h, w, dtype=np.int32)
        self._scratch_left, self._scratch_right = np.zeros(sh, dtype=np.int32), np.zeros(sh, dtype=np.int32)

    def draw(self, world_from_camera: Pose) -> CameraImages:
        """Draw the image of the stage's current state."""
        pose = world_from_camera.vector()
        self._canvas.aim(pose)
        images = self._draw_changes(pose) if self._keep_still else self._draw(len(self._stage.instances), None)[0]
        return CameraImages(
            color=images.color,
            depth=images.depth if self._canvas.want_depth else None,
            segmentation=images.segments if self._canvas.want_segments else None,
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
        canvas = self._canvas
        records = -1
        while records < 0:  # the buffers grow until they are large enough
            canvas.clear()
            records, vertices = canvas.draw_instances(
                0, count, 0, canvas.geometry.num_vertices, self._scratch_left, self._scratch_right
            )
        images = canvas.new_images()
        counts = canvas.shade(images, self._whole_left, self._whole_right, 0, records, everything=True, still=still)
        canvas.finish_edges(images, *counts, canvas.looks if still is None else canvas.still_looks)
        return images, records, vertices

    def _draw_changes(self, pose: Floats) -> Images:
        canvas, stage = self._canvas, self._stage
        key = (pose.tobytes(), stage.still_version)
        while True:
            if self._still is None or self._still.key != key:
                self._still = self._draw_still(key)
            still = self._still
            restore_samples(canvas.values, still.values, canvas.ids, still.ids, self._left, self._right)
            first = still.num_records
            records, _ = canvas.draw_instances(
                stage.num_still, len(stage.instances), first, still.num_vertices, self._left, self._right
            )
            if records >= 0:
                break
            self._still = None  # the buffers have grown
        left, right = self._left, self._right
        if canvas.samples == 2:
            left, right = self._pixel_left, self._pixel_right
            halve_extents(self._left, self._right, left, right, canvas.pixel_ids)
        color, depth, segments = still.images
        images = Images(color.copy(), depth.copy(), segments.copy())
        edge_count, mixed_count = canvas.shade(images, left, right, first, records, everything=False, still=None)
        all_edges = shade_still(
            stage.touched,
            still.tile_start,
            still.tile_pixels,
            still.gathered,
            first,
            canvas.pixel_ids,
            still.pixel_ids,
            canvas.looks,
            images.color,
            canvas.edges,
            edge_count,
        )
        canvas.finish_edges(images, all_edges, mixed_count, canvas.looks)
        if canvas.samples == 2:
            clear_queued(canvas.edges, edge_count, all_edges, canvas.pixel_ids, STILL)
        return images

    def _draw_still(self, key: tuple[bytes, int]) -> _Still:
        """Draw static instances, with their own shadows."""
        canvas, stage = self._canvas, self._stage
        h, w = canvas.camera.height, canvas.camera.width
        terms = np.zeros((h, w, layout.STILL_SIZE), dtype=np.float32)
        images, records, vertices = self._draw(stage.num_still, terms)
        tiles = stage.touched.shape[0]
        tile_start = np.zeros(tiles * tiles + 1, dtype=np.int64)
        tile_pixels = np.zeros(h * w * canvas.samples**2, dtype=np.int32)
        list_tiles(
            terms, canvas.pixel_ids, canvas.ids, canvas.records, tiles, stage.shadow_size, tile_start, tile_pixels
        )
        count = int(tile_start[-1])
        gathered = np.zeros((count + 1, layout.STILL_SIZE), dtype=np.float32)
        gather_still(terms, tile_pixels, count, gathered)
        pixel_ids = canvas.pixel_ids.copy()
        if canvas.samples == 2:
            canvas.pixel_ids.fill(STILL)
            self._pixel_left.fill(0)
            self._pixel_right.fill(0)
        self._left.fill(canvas.ids.shape[1])
        self._right.fill(0)
        return _Still(
            key=key,
            images=images,
            values=canvas.values.copy(),
            ids=canvas.ids.copy(),
            pixel_ids=pixel_ids,
            num_records=records,
            num_vertices=vertices,
            tile_start=tile_start,
            tile_pixels=tile_pixels[:count].copy(),
            gathered=gathered,
        )
