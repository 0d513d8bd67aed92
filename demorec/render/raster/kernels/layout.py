"""How vertices, faces and records lie in memory: constants shared by all kernels and by the code that fills them.

Vertices are stored in blocks of `LANES`, attribute after attribute (ROWS of them), in one float32 array. The
distance between two attributes is thus known to the compiler, which then turns the loops over a block's vertices
into vector code (numba cannot promise that two arrays do not overlap). A vertex is addressed by the place of its
first attribute. LANES is no power of two, or all attributes would fall on the same cache lines.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

LANES = 1008
ROWS = 20
BLOCK = LANES * ROWS

# Attributes, as distances from a vertex' address.
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
FACE_RED = 0
FACE_GREEN = 1
FACE_BLUE = 2
FACE_SPECULAR = 3

# Columns of a record: what a triangle needs while it is shaded. Each quantity q is a plane over the image, as
# value at the origin, step in x, step in y; all but the first, the inverse depth, are divided by depth, so that they
# are planes at all.
SHADOW_X_PLANE = 3
SHADOW_Y_PLANE = 6
SHADOW_Z_PLANE = 9
TO_LIGHT_PLANE = 12
UPWARD_PLANE = 15
HALFWAY_PLANE = 18
TEX_U_PLANE = 21
TEX_V_PLANE = 24
TEXEL_DENSITY = 27  # (texture widths / sample)^2 at inverse depth 1
RECORD = 28

# Values in the image of record numbers.
BACKGROUND = -1
EDGE = -3  # shaded sample by sample
QUEUED = -4  # an edge that is in the list already

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

# A pixel that stands still, with what its shading needs: ambient and direct colour, place in the shadow map.
STILL_SIZE = 9

TILE_SHIFT = 3
"""Shadow tiles are 8x8 texels."""
MIP_LEVELS = 11
"""Columns of the mip table: the first texel of each level; then the log2 of the texture's side."""


class Geometry(NamedTuple):
    """Vertices and faces of all instances, the vertices numbered in their order.

    Attributes:
        vertex_start, vertex_count: (n,) of each instance.
        face_start, face_end: (n,) of each instance.
        vertices: Blocks of vertices, room for spare ones at the end.
        num_vertices: Without the spare ones.
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
    """Triangles that cover a sample at least, in the order in which they were drawn.

    Attributes:
        corners: (r, 3) vertex addresses.
        faces: (r,) of which face they are, or a part.
        flags: (r,) 1 where one owns a sample, so that its planes are needed.
        planes: (r, RECORD).
        origins: (r, 2) the samples where the planes start.
    """

    corners: NDArray[np.int32]
    faces: NDArray[np.int32]
    flags: NDArray[np.uint8]
    planes: NDArray[np.float32]
    origins: NDArray[np.int32]


class Looks(NamedTuple):
    """What decides the colour of a surface, and of the background.

    Attributes:
        face_table: (f, 4) flags, texture, segment, group (faces of equal look, which need no edge between).
        face_color: (f, 4) red, green, blue, specular, 0..255 (0..1 with a texture).
        texels, mips: Packed texels, and (textures, MIP_LEVELS + 1) where their levels start.
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
    """(H, W, 3) colour, (H, W) depth and segmentation; the latter two of size (0, 0) when not wanted."""

    color: NDArray[np.uint8]
    depth: NDArray[np.float32]
    segments: NDArray[np.int32]


def addresses(count: int) -> NDArray[np.int64]:
    """(count,) addresses of the first vertices."""
    number = np.arange(count, dtype=np.int64)
    return number // LANES * BLOCK + number % LANES
