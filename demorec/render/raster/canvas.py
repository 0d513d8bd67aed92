"""One camera's buffers and the passes over them: triangles into samples, samples into shaded pixels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from demorec.episode.scene import Light, SceneCamera
from demorec.render import RenderSetup
from demorec.render.raster.batch import Batch, Floats32
from demorec.render.raster.kernels import layout
from demorec.render.raster.kernels.antialias import STILL, centre_of_mixed, resolve, shade_edges
from demorec.render.raster.kernels.layout import Images, Looks, Records
from demorec.render.raster.kernels.records import flag_owners, set_up_records
from demorec.render.raster.kernels.shade import shade_rows
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


class Canvas:
    """The buffers of one camera over one scene.

    Args:
        camera: Size, lens and clipping distances.
        batch: The scene's meshes at this camera's level of detail.
        stage: State shared by all cameras.
        setup: Its light colours the sky; its flags select depth, segmentation and 2x2 samples per pixel.

    Attributes:
        samples: Samples along a pixel's side, 1 or 2.
        values, ids: (H * samples, W * samples) inverse depths, and their records.
        pixel_ids: (H, W) records of pixels, or the special values of `layout`; not antialiased: `ids` itself.
        edges: y * W + x of pixels that are shaded sample by sample.
        geometry: The batch's, with separate vertices.
        records: The triangles drawn.
        looks, still_looks: Colour inputs of all pixels, and of the static layer with its own shadows alone.
    """

    def __init__(self, camera: SceneCamera, batch: Batch, stage: Stage, setup: RenderSetup) -> None:
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

    def aim(self, pose: Floats) -> None:
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

    def new_images(self) -> Images:
        """Allocate the images."""
        h, w = self.camera.height, self.camera.width
        return Images(
            np.empty((h, w, 3), dtype=np.uint8),
            np.empty((h, w) if self.want_depth else (0, 0), dtype=np.float32),
            np.empty((h, w) if self.want_segments else (0, 0), dtype=np.int32),
        )

    def clear(self) -> None:
        """Clear to the background."""
        self.values.fill(self._far_value)
        self.ids.fill(layout.BACKGROUND)

    def draw_instances(
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
        """Shade the pixels of records from `first` (all with `everything`); returns edge and mixed counts."""
        lowest = layout.BACKGROUND if everything else first
        records, face_table, looks = self.records, self.looks.face_table, self.looks
        if still is None:
            still = np.zeros((0, 0, layout.STILL_SIZE), dtype=np.float32)
        else:
            looks = self.still_looks
        records.flags[first:last] = 0
        counts = 0, 0
        if self.samples == 2:
            counts = resolve(
                left, right, lowest, self.ids, self.values, records, face_table, self.pixel_ids, self.edges, self._mixed
            )
        else:
            flag_owners(left, right, first, self.ids, records.flags)
        set_up_records(first, last, records, face_table, self.geometry.vertices)
        shade_rows(left, right, lowest, self.pixel_ids, self.samples, records, looks, images, still)
        return counts

    def finish_edges(self, images: Images, edge_count: int, mixed_count: int, looks: Looks) -> None:
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
        flags=np.zeros(count, dtype=np.uint8),
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
