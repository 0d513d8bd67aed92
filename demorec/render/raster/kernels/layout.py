"""Memory layout of vertices, faces and records: constants shared by all kernels and by the code that fills them.

Vertices are stored in blocks of `LANES`, attribute after attribute (ROWS of them), in one float32 array. The compiler
thus knows the distance between two attributes and vectorises the loops over a block's vertices (numba cannot guarantee
that two arrays do not overlap). The address of a vertex is the index of its first attribute. LANES is not a power of
two, or all attributes would share the same cache lines.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

LANES = 1008
ROWS = 20
BLOCK = LANES * ROWS

# Attributes, as offsets from a vertex' address.
POS_X = 0
POS_Y = LANES
POS_Z = 2 * LANES
NORMAL_X, NORMAL_Y, NORMAL_Z = 3 * LANES, 4 * LANES, 5 * LANES
TEX_U, TEX_V = 6 * LANES, 7 * LANES
CLIP_X, CLIP_Y, CLIP_W = 8 * LANES, 9 * LANES, 10 * LANES  # homogeneous, +-w is the image's border
SCREEN_X, SCREEN_Y = 11 * LANES, 12 * LANES  # 1/256 sample, whole numbers
INVERSE_W = 13 * LANES
TO_LIGHT, UPWARD, HALFWAY = 14 * LANES, 15 * LANES, 16 * LANES  # normal times light, up and half-way vector
SHADOW_X, SHADOW_Y, SHADOW_Z = 17 * LANES, 18 * LANES, 19 * LANES  # texels, texels, 0..1 (greater is nearer)

# Columns of a face's int32 and float32 tables.
FACE_FLAGS = 0
FACE_TEXTURE = 1
FACE_SEGMENT = 2
FACE_GROUP = 3
SMOOTH = 1  # a bit of FACE_FLAGS
TEXTURED = 2  # the next bit
FACE_SPECULAR = 3  # after red, green, blue

# Columns of a record: data of a triangle for shading. Each quantity q is a plane over the image, as value at the
# origin, step in x, step in y. All but the first, the inverse depth, are divided by depth, which makes them planes.
SHADOW_X_PLANE = 3  # then y and z
TO_LIGHT_PLANE = 12
UPWARD_PLANE = 15  # then the half-way vector
TEX_U_PLANE = 21  # then v
TEXEL_DENSITY = 27  # (texture widths / sample)^2 at inverse depth 1
RECORD = 28

# Values in the image of record numbers.
BACKGROUND = -1
EDGE = -3  # shaded sample by sample
QUEUED = -4  # an edge already in the list

# Columns of the light's table.
AMBIENT, AMBIENT_UP, DIFFUSE, IN_SHADOW, LIGHT_RED, LIGHT_GREEN, LIGHT_BLUE = range(7)
LIGHT_SIZE = 7

# Columns of the sky's table: ray = origin + x * step_x + y * step_y (world axes), colours at horizon and zenith.
SKY_ORIGIN = 0
SKY_STEP_X = 3
SKY_STEP_Y = 6
SKY_HORIZON = 9
SKY_ZENITH = 12
SKY_SIZE = 15

# A static pixel, with its shading inputs: ambient and direct colour, position in the shadow map.
STILL_SIZE = 9

TILE_SHIFT = 3
"""Shadow tiles are 8x8 texels."""
MIP_LEVELS = 11
"""Number of columns of the mip table: the first texel of each level; then the log2 of the texture's side."""


class Geometry(NamedTuple):
    """Vertices and faces of all instances; vertices are numbered in the order of the instances.

    Attributes:
        vertex_start, vertex_count: (n,) vertex range of each instance.
        face_start, face_end: (n,) face range of each instance.
        vertices: Blocks of vertices, with spare room at the end.
        num_vertices: Number of vertices, spare ones excluded.
        faces: (f, 3) vertex addresses, counter-clockwise from outside.
    """

    vertex_start: NDArray[np.int64]
    vertex_count: NDArray[np.int64]
    face_start: NDArray[np.int64]
    face_end: NDArray[np.int64]
    vertices: NDArray[np.float32]
    num_vertices: int
    faces: NDArray[np.int32]


class Records(NamedTuple):
    """Triangles that cover at least one sample, in drawing order.

    Attributes:
        corners: (r, 3) vertex addresses.
        faces: (r,) face that the triangle is, or is a part of.
        planes: (r, RECORD).
        origins: (r, 2) samples at the planes' origins.
    """

    corners: NDArray[np.int32]
    faces: NDArray[np.int32]
    planes: NDArray[np.float32]
    origins: NDArray[np.int32]


class Looks(NamedTuple):
    """Inputs to the colour of surfaces and background.

    Attributes:
        face_table: (f, 4) flags, texture, segment, group (faces of equal appearance, without edges between them).
        face_color: (f, 4) red, green, blue, specular, 0..255 (0..1 with a texture).
        texels, mips: Packed texels, and (textures, MIP_LEVELS + 1) start of their levels.
        light: (LIGHT_SIZE,) parameters.
        sky: (SKY_SIZE,) rays and colours.
        heights, size: (size * size,) shadow map, and its side.
    """

    face_table: NDArray[np.int32]
    face_color: NDArray[np.float32]
    texels: NDArray[np.uint32]
    mips: NDArray[np.int64]
    light: NDArray[np.float32]
    sky: NDArray[np.float32]
    heights: NDArray[np.float32]
    size: int


class Images(NamedTuple):
    """(H, W, 3) colour, (H, W) depth and segmentation; the latter two of size (0, 0) if not requested."""

    color: NDArray[np.uint8]
    depth: NDArray[np.float32]
    segments: NDArray[np.int32]


def addresses(count: int) -> NDArray[np.int64]:
    """Compute the (count,) addresses of the first vertices."""
    number = np.arange(count, dtype=np.int64)
    return number // LANES * BLOCK + number % LANES
