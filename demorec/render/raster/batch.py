"""The scene's meshes at one level of detail, merged into the arrays that the kernels read."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from demorec.render.raster import textures
from demorec.render.raster.kernels import layout
from demorec.render.raster.kernels.layout import Geometry
from demorec.render.raster.mesh import Floats
from demorec.render.raster.shapes import Instance
from demorec.render.raster.textures import Pixels

Floats32 = NDArray[np.float32]
SPECULAR_FACES = 100
"""Maximum number of faces of a matt shape; shapes with more have highlights, which on a box or board would light up
whole faces."""


def merge(attributes: Sequence[Floats], faces: Sequence[NDArray[np.integer]], *, spare: int = 0) -> Geometry:
    """Merge meshes given as vertex attributes (v, up to 8: position, normal, u, v) and vertex numbers (f, 3)."""
    counts = np.array([len(a) for a in attributes], dtype=np.int64)
    face_counts = np.array([len(f) for f in faces], dtype=np.int64)
    starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    face_starts = np.concatenate([[0], np.cumsum(face_counts)]).astype(np.int64)
    total = int(starts[-1])
    blocks = max(1, math.ceil((total + spare) / layout.LANES))
    vertices = np.zeros(blocks * layout.BLOCK, dtype=np.float32)
    address = layout.addresses(max(1, total))
    if total:
        together = np.concatenate(attributes)
        for column in range(together.shape[1]):
            vertices[address + column * layout.LANES] = together[:, column]
    numbers = [f + start for f, start in zip(faces, starts, strict=False)]
    all_faces = np.concatenate(numbers) if numbers else np.zeros((0, 3), dtype=np.int64)
    return Geometry(
        vertex_start=starts[:-1].copy(),
        vertex_count=counts,
        face_start=face_starts[:-1].copy(),
        face_end=face_starts[1:].copy(),
        vertices=vertices,
        num_vertices=total,
        faces=np.ascontiguousarray(address[all_faces].astype(np.int32).reshape(-1, 3)),
    )


def caster_geometry(instances: Sequence[Instance], levels: Sequence[int], casts: Sequence[bool]) -> Geometry:
    """Merge positions only, for the shadow map; shapes that cast no shadow get no faces."""
    points, faces = [], []
    for instance, level, does in zip(instances, levels, casts, strict=True):
        piece = instance.model.caster(level) if does else None
        points.append(np.zeros((0, 3)) if piece is None else piece.points * instance.scale)
        faces.append(np.zeros((0, 3), dtype=np.int64) if piece is None else piece.point_faces)
    return merge(points, faces)


class Batch(NamedTuple):
    """Everything drawn for one camera; remaining fields as in `layout.Looks`."""

    geometry: Geometry
    face_table: NDArray[np.int32]
    face_color: Floats32
    texels: NDArray[np.uint32]
    mips: NDArray[np.int64]


SPARE_VERTICES = 4096
"""Initial capacity for vertices created by clipping; grown on demand."""


def make_batch(instances: Sequence[Instance], levels: Sequence[int], *, specular: float) -> Batch:
    """Merge the instances, each at its number of faces.

    Args:
        specular: Strength of highlights, 0..1.
    """
    attributes: list[Floats] = []
    faces: list[NDArray[np.integer]] = []
    tables = [np.zeros((0, 4), dtype=np.int32)]
    colors: list[Floats] = [np.zeros((0, 4))]
    images: dict[int, tuple[int, Pixels]] = {}
    num_groups = 0
    for instance, level in zip(instances, levels, strict=True):
        piece = instance.piece(level)
        n = len(piece.faces)
        attributes.append(piece.scaled_vertices(instance.scale))
        is_mirrored = float(np.prod(instance.scale)) < 0
        faces.append(piece.faces[:, ::-1] if is_mirrored else piece.faces)  # they still face outward
        table = np.zeros((n, 4), dtype=np.int32)
        table[:, layout.FACE_FLAGS] = piece.flags
        table[:, layout.FACE_SEGMENT] = instance.segment
        table[:, layout.FACE_GROUP] = piece.groups + num_groups
        num_groups += int(piece.groups.max(initial=-1)) + 1
        color = np.zeros((n, 4))
        color[:, :3] = piece.colors * instance.color
        if instance.texture is None:
            color[:, :3] *= 255
        else:
            row, _ = images.setdefault(id(instance.texture), (len(images), instance.texture))
            table[:, layout.FACE_TEXTURE] = row
        color[:, layout.FACE_SPECULAR] = 255 * specular if n > SPECULAR_FACES else 0
        tables.append(table)
        colors.append(color)
    texels, mips = textures.pack([image for _, image in images.values()])
    return Batch(
        geometry=merge(attributes, faces, spare=SPARE_VERTICES),
        face_table=np.concatenate(tables),
        face_color=np.concatenate(colors).astype(np.float32),
        texels=texels,
        mips=mips,
    )
