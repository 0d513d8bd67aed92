# mypy: allow-untyped-defs, allow-incomplete-defs
"""Drawing of meshes into the image, clipped and without back faces, and into the shadow map."""

import numpy as np

from demorec.render.raster.kernels import layout as at
from demorec.render.raster.kernels.fill import covered, doubled_area, fill_triangle, screen
from demorec.render.raster.kernels.jit import f4, f8, index, inlined, kernel

LANES, BLOCK = at.LANES, at.BLOCK
CX, CY, CW, SX, SY, IW = at.CLIP_X, at.CLIP_Y, at.CLIP_W, at.SCREEN_X, at.SCREEN_Y, at.INVERSE_W
GUARD = 16.0
"""Distance from the middle, in half images, beyond which triangles are clipped: the edge functions would exceed the
integers that float64 represents."""
SHIFT = at.TILE_SHIFT


@inlined
def interpolate_vertex(vertices, new, a, b, t, half_width, half_height):
    """Write the projected vertex a + t (b - a) at address `new`."""
    for row in range(6, at.ROWS):
        if row < 8 or row in (8, 9, 10) or row >= 14:
            k = row * LANES
            vertices[new + k] = vertices[a + k] + t * (vertices[b + k] - vertices[a + k])
    inverse = f4(1) / vertices[new + CW]
    vertices[new + IW] = inverse
    vertices[new + SX] = np.floor(vertices[new + CX] * inverse * half_width + half_width + f4(0.5))
    vertices[new + SY] = np.floor(vertices[new + CY] * inverse * half_height + half_height + f4(0.5))


@inlined
def clip_distance(vertices, a, plane, near):
    """Compute a vertex's distance inside the near plane (0) or a guard plane (1..4); negative outside."""
    w = vertices[a + CW]
    if plane == 0:
        return w - near
    if plane == 1:
        return f4(GUARD) * w - vertices[a + CX]
    if plane == 2:
        return f4(GUARD) * w + vertices[a + CX]
    if plane == 3:
        return f4(GUARD) * w - vertices[a + CY]
    return f4(GUARD) * w + vertices[a + CY]


@inlined
def note_record(records, record, a, b, c, face):
    """Store the corners and the face of a triangle."""
    records.corners[record, 0] = a
    records.corners[record, 1] = b
    records.corners[record, 2] = c
    records.faces[record] = face


@kernel
def draw_instances(first, last, record, next_vertex, geometry, visible, values, ids, near, records, left, right):
    """Draw the front faces of the visible instances `first` .. `last` - 1.

    Args:
        record: Number of the first record to write; a record is one triangle that covers at least one sample.
        next_vertex: Number of the first vertex free for clipping.
        values, ids: (height, width) inverse depth and record numbers of the samples.
        records: Records to store corners and faces in.
        left, right: (height,) extents drawn.

    Returns:
        The next free record and vertex; a record of -1 if the room for clipped vertices or records is used up.
    """
    height, width = ids.shape
    values = values.reshape(-1)
    ids = ids.reshape(-1)
    vertices = geometry.vertices
    guard = f4(GUARD)
    half_width = f4(width * 128.0)
    half_height = f4(height * 128.0)
    inside = np.empty(12, np.int64)
    outside = np.empty(12, np.int64)
    clip_near = near * f4(1.001)
    record_limit = records.faces.shape[0] - 8
    vertex_limit = vertices.shape[0] // BLOCK * LANES
    for k in range(first, last):
        if not visible[k]:
            continue
        for f in range(geometry.face_start[k], geometry.face_end[k]):
            a = index(geometry.faces[f, 0])
            b = index(geometry.faces[f, 1])
            c = index(geometry.faces[f, 2])
            wa = vertices[a + index(CW)]
            wb = vertices[b + index(CW)]
            wc = vertices[c + index(CW)]
            if record >= record_limit:
                return -1, next_vertex
            is_clipped = min(wa, wb, wc) <= near
            if not is_clipped:
                if doubled_area(screen(vertices, a), screen(vertices, c), screen(vertices, b)) <= 0.0:
                    continue
                cx = max(
                    abs(vertices[a + index(CX)]) - guard * wa,
                    abs(vertices[b + index(CX)]) - guard * wb,
                    abs(vertices[c + index(CX)]) - guard * wc,
                )
                cy = max(
                    abs(vertices[a + index(CY)]) - guard * wa,
                    abs(vertices[b + index(CY)]) - guard * wb,
                    abs(vertices[c + index(CY)]) - guard * wc,
                )
                is_clipped = cx >= f4(0) or cy >= f4(0)
            elif max(wa, wb, wc) <= near:
                continue
            if is_clipped and next_vertex + 12 > vertex_limit:
                return -1, next_vertex
            inside[0] = a
            inside[1] = c
            inside[2] = b
            corners = 3
            # Sutherland-Hodgman against the near plane and the four guard planes.
            for plane in range(5 if is_clipped else 0):
                kept = 0
                for q in range(corners):
                    u = inside[q]
                    v = inside[q + 1 if q + 1 < corners else 0]
                    du = clip_distance(vertices, u, plane, clip_near)
                    dv = clip_distance(vertices, v, plane, clip_near)
                    if du >= f4(0):
                        outside[kept] = u
                        kept += 1
                    if (du >= f4(0)) != (dv >= f4(0)):
                        new = next_vertex // LANES * BLOCK + next_vertex % LANES
                        next_vertex += 1
                        # Always from inside to outside, so that an edge shared by two faces is cut at the same point.
                        if du >= f4(0):
                            interpolate_vertex(vertices, new, u, v, du / (du - dv), half_width, half_height)
                        else:
                            interpolate_vertex(vertices, new, v, u, dv / (dv - du), half_width, half_height)
                        outside[kept] = new
                        kept += 1
                corners = kept
                for q in range(corners):
                    inside[q] = outside[q]
                if corners < 3:
                    break
            for q in range(1, corners - 1):
                u = index(inside[0])
                v = index(inside[q])
                w = index(inside[q + 1])
                pu = screen(vertices, u)
                pv = screen(vertices, v)
                pw = screen(vertices, w)
                area = doubled_area(pu, pv, pw)
                if area <= 0.0:
                    continue
                vu = f8(vertices[u + index(IW)])
                vv = f8(vertices[v + index(IW)])
                vw = f8(vertices[w + index(IW)])
                if fill_triangle(pu, pv, pw, vu, vv, vw, area, width, height, values, ids, record, left, right):
                    note_record(records, record, u, v, w, f)
                    record += 1
    return record, next_vertex


@kernel
def draw_casters(first, last, geometry, heights, ids, touched, left, right):
    """Draw the faces of instances `first` .. `last` - 1 into the shadow map, both sides of each.

    Back faces are drawn too: a decimated mesh leaves gaps at its silhouette, and culling would let light through.

    Args:
        heights: (size, size) greatest height towards the light.
        ids: (size, size) int32, of no use here.
        touched: (tiles, tiles) uint8, set where a lookup may read the drawn texels.
        left, right: (size,) extents drawn.
    """
    size = heights.shape[0]
    heights = heights.reshape(-1)
    ids = ids.reshape(-1)
    vertices = geometry.vertices
    for k in range(first, last):
        for f in range(geometry.face_start[k], geometry.face_end[k]):
            a = index(geometry.faces[f, 0])
            b = index(geometry.faces[f, 1])
            c = index(geometry.faces[f, 2])
            pa = screen(vertices, a)
            pb = screen(vertices, b)
            pc = screen(vertices, c)
            va = f8(vertices[a + index(IW)])
            vb = f8(vertices[b + index(IW)])
            vc = f8(vertices[c + index(IW)])
            area = doubled_area(pa, pb, pc)
            if area == 0.0:
                continue
            if area < 0.0:
                area = -area
                pb, pc = pc, pb
                vb, vc = vc, vb
            y_first, y_last = covered(min(pa[1], pb[1], pc[1]), max(pa[1], pb[1], pc[1]), size)
            x_first, x_last = covered(min(pa[0], pb[0], pc[0]), max(pa[0], pb[0], pc[0]), size)
            if y_first > y_last or x_first > x_last:
                continue
            # A lookup at (x, y) reads the texels x - 1 .. x + 2.
            for tile_y in range(max(0, y_first - 2) >> SHIFT, (min(size - 1, y_last + 1) >> SHIFT) + 1):
                for tile_x in range(max(0, x_first - 2) >> SHIFT, (min(size - 1, x_last + 1) >> SHIFT) + 1):
                    touched[tile_y, tile_x] = 1
            fill_triangle(pa, pb, pc, va, vb, vc, area, size, size, heights, ids, np.int64(0), left, right)
