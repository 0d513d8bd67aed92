# mypy: allow-untyped-defs, allow-incomplete-defs
"""Exact triangle rasterisation: every sample of a mesh is covered once, whatever the order of its triangles.

Corners are snapped to 1/256 sample, so that the edge functions are whole numbers, exact in float64; samples on an
edge belong to the triangle for which it is a top or left edge.
"""

from __future__ import annotations

import math

import numpy as np

from demorec.render.raster.kernels import layout as at
from demorec.render.raster.kernels.jit import f4, f8, i4, index, inlined, kernel

LANES, BLOCK = at.LANES, at.BLOCK
CX, CY, CW, SX, SY, IW = at.CLIP_X, at.CLIP_Y, at.CLIP_W, at.SCREEN_X, at.SCREEN_Y, at.INVERSE_W
GUARD = 16.0
"""Triangles that reach farther than this many half pictures from the middle are clipped: beyond, the edge functions
would leave the whole numbers that float64 holds."""
SHIFT = at.TILE_SHIFT
STRIP = 16
"""Samples of a row that are tested at once. Fewer, and the compiler would unroll the loop instead of making vector code
of it."""
NARROW = 3 * STRIP
"""Triangles narrower than this are tested sample by sample: less work than finding where each of their rows ends."""


@inlined
def fill_triangle(x0, y0, v0, x1, y1, v1, x2, y2, v2, area, width, height, values, ids, record, with_ids, left, right):
    """Draw one triangle of positive area where its value is greater than what is there.

    Args:
        x0 .. y2: Corners, 1/256 sample, whole numbers in float64.
        v0, v1, v2: Value at the corners (inverse depth, height), linear over the picture.
        values, ids: (height * width,) greatest value so far, and the record it came from.
        with_ids: Whether ids, left and right are kept.
        left, right: (height,) extents of what was drawn in each row, widened (to the corners, where narrow).

    Returns:
        Whether it may own a sample.
    """
    y_first = max(0, math.ceil((min(y0, y1, y2) - 128.0) / 256.0))
    y_last = min(height - 1, math.floor((max(y0, y1, y2) - 128.0) / 256.0))
    if y_first > y_last:
        return False
    x_first = max(0, math.ceil((min(x0, x1, x2) - 128.0) / 256.0))
    x_last = min(width - 1, math.floor((max(x0, x1, x2) - 128.0) / 256.0))
    if x_first > x_last:
        return False
    inverse_area = 1.0 / area
    d1 = v1 - v0
    d2 = v2 - v0
    step_x = (d1 * (y2 - y0) - d2 * (y1 - y0)) * inverse_area
    step_y = (d2 * (x1 - x0) - d1 * (x2 - x0)) * inverse_area
    a0 = y0 - y1
    b0 = x1 - x0
    a1 = y1 - y2
    b1 = x2 - x1
    a2 = y2 - y0
    b2 = x0 - x2
    x = x_first * 256.0 + 128.0
    y = y_first * 256.0 + 128.0
    e0 = a0 * (x - x0) + b0 * (y - y0)
    e1 = a1 * (x - x1) + b1 * (y - y1)
    e2 = a2 * (x - x2) + b2 * (y - y2)
    if not (a0 > 0.0 or (a0 == 0.0 and b0 > 0.0)):
        e0 -= 1.0
    if not (a1 > 0.0 or (a1 == 0.0 and b1 > 0.0)):
        e1 -= 1.0
    if not (a2 > 0.0 or (a2 == 0.0 and b2 > 0.0)):
        e2 -= 1.0
    row_value = v0 + step_x * (x - x0) + step_y * (y - y0)
    value_step = f4(step_x * 256.0)
    step_y *= 256.0
    a0 *= 256.0
    a1 *= 256.0
    a2 *= 256.0
    b0 *= 256.0
    b1 *= 256.0
    b2 *= 256.0
    span = x_last - x_first
    strips = span // STRIP + 1
    # What lies beyond the row's end is read and written back: within the picture, that is.
    if span < NARROW and y_last * width + x_first + strips * STRIP <= width * height:
        limit = i4(span)
        number = i4(record)
        nearer_count = i4(0)
        for row in range(y_first, y_last + 1):
            if with_ids:
                left[index(row)] = min(left[index(row)], i4(x_first))
                right[index(row)] = max(right[index(row)], i4(x_last + 1))
            start = row * width + x_first
            c0 = e0
            c1 = e1
            c2 = e2
            value = f4(row_value)
            for strip in range(strips):
                base = strip * STRIP
                if with_ids:
                    for k in range(STRIP):
                        q = index(start + base + k)
                        there = values[q]
                        id_there = ids[q]
                        column = i4(base + k)
                        here = value + value_step * f4(column)
                        j = f8(i4(k))
                        inside = (c0 + a0 * j >= 0.0) & (c1 + a1 * j >= 0.0) & (c2 + a2 * j >= 0.0) & (column <= limit)
                        nearer = inside & (here > there)
                        values[q] = here if nearer else there
                        ids[q] = number if nearer else id_there
                        nearer_count += i4(nearer)
                else:
                    for k in range(STRIP):
                        q = index(start + base + k)
                        there = values[q]
                        column = i4(base + k)
                        here = value + value_step * f4(column)
                        j = f8(i4(k))
                        inside = (c0 + a0 * j >= 0.0) & (c1 + a1 * j >= 0.0) & (c2 + a2 * j >= 0.0) & (column <= limit)
                        values[q] = here if inside & (here > there) else there
                c0 += a0 * f8(STRIP)
                c1 += a1 * f8(STRIP)
                c2 += a2 * f8(STRIP)
            e0 += b0
            e1 += b1
            e2 += b2
            row_value += step_y
        return nearer_count > 0
    hit = False
    for row in range(y_first, y_last + 1):
        # Ends of the row's span: the quotients of exact whole numbers round to the right side.
        low = 0.0
        high = float(span)
        if a0 > 0.0:
            low = max(low, -e0 / a0)
        elif a0 < 0.0:
            high = min(high, -e0 / a0)
        elif e0 < 0.0:
            high = -1.0
        if a1 > 0.0:
            low = max(low, -e1 / a1)
        elif a1 < 0.0:
            high = min(high, -e1 / a1)
        elif e1 < 0.0:
            high = -1.0
        if a2 > 0.0:
            low = max(low, -e2 / a2)
        elif a2 < 0.0:
            high = min(high, -e2 / a2)
        elif e2 < 0.0:
            high = -1.0
        if low <= high:
            first = math.ceil(low)
            last = math.floor(high)
            if first <= last:
                hit = True
                value = f4(row_value)
                start = row * width + x_first + first
                if with_ids:
                    left[index(row)] = min(left[index(row)], i4(x_first + first))
                    right[index(row)] = max(right[index(row)], i4(x_first + last + 1))
                    number = i4(record)
                    for k in range(last - first + 1):
                        q = index(start + k)
                        here = value + value_step * f4(i4(first + k))
                        there = values[q]
                        nearer = here > there
                        id_there = ids[q]
                        values[q] = here if nearer else there
                        ids[q] = number if nearer else id_there
                else:
                    for k in range(last - first + 1):
                        q = index(start + k)
                        here = value + value_step * f4(i4(first + k))
                        there = values[q]
                        values[q] = here if here > there else there
        e0 += b0
        e1 += b1
        e2 += b2
        row_value += step_y
    return hit


@inlined
def interpolate_vertex(vertices, new, a, b, t, half_width, half_height):
    """Put the vertex a + t (b - a) at address `new`, projected."""
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
    """How far inside the near plane (0) or a guard plane (1..4) a vertex is; negative outside."""
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


@kernel
def draw_instances(
    record,
    first,
    last,
    visible,
    face_start,
    face_end,
    faces,
    vertices,
    next_vertex,
    vertex_limit,
    width,
    height,
    near,
    values,
    ids,
    record_corners,
    record_face,
    left,
    right,
):
    """Draw the faces of the visible instances `first` .. `last` - 1 that look towards the camera.

    Args:
        record: Number of the first record to write; a record is one triangle that covers at least one sample.
        faces: (f, 3) vertex addresses, counter-clockwise from outside.
        next_vertex, vertex_limit: Numbers of the first vertex free for clipping, and of the first too many.
        values, ids: (height * width,) inverse depth and record numbers.
        record_corners, record_face: (r, 3), (r,) results.
        left, right: (height,) extents of what was drawn.

    Returns:
        The next free record and vertex; a record of -1 when the room for clipped vertices or records ran out.
    """
    guard = f4(GUARD)
    half_width = f4(width * 128.0)
    half_height = f4(height * 128.0)
    inside = np.empty(12, np.int64)
    outside = np.empty(12, np.int64)
    clip_near = near * f4(1.001)
    record_limit = record_face.shape[0] - 8
    for k in range(first, last):
        if not visible[k]:
            continue
        for f in range(face_start[k], face_end[k]):
            a = index(faces[f, 0])
            b = index(faces[f, 1])
            c = index(faces[f, 2])
            wa = vertices[a + index(CW)]
            wb = vertices[b + index(CW)]
            wc = vertices[c + index(CW)]
            if record >= record_limit:
                return -1, next_vertex
            if min(wa, wb, wc) > near:
                x0 = f8(vertices[a + index(SX)])
                y0 = f8(vertices[a + index(SY)])
                x1 = f8(vertices[b + index(SX)])
                y1 = f8(vertices[b + index(SY)])
                x2 = f8(vertices[c + index(SX)])
                y2 = f8(vertices[c + index(SY)])
                area = (x2 - x0) * (y1 - y0) - (x1 - x0) * (y2 - y0)
                if area <= 0.0:
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
                if cx < f4(0) and cy < f4(0):
                    va = f8(vertices[a + index(IW)])
                    vb = f8(vertices[b + index(IW)])
                    vc = f8(vertices[c + index(IW)])
                    if fill_triangle(
                        x0, y0, va, x2, y2, vc, x1, y1, vb, area, width, height, values, ids, record, True, left, right
                    ):
                        record_corners[record, 0] = a
                        record_corners[record, 1] = c
                        record_corners[record, 2] = b
                        record_face[record] = f
                        record += 1
                    continue
            if max(wa, wb, wc) <= near:
                continue
            xa = vertices[a + index(CX)]
            xb = vertices[b + index(CX)]
            xc = vertices[c + index(CX)]
            ya = vertices[a + index(CY)]
            yb = vertices[b + index(CY)]
            yc = vertices[c + index(CY)]
            if (xa > wa and xb > wb and xc > wc) or (-xa > wa and -xb > wb and -xc > wc):
                continue
            if (ya > wa and yb > wb and yc > wc) or (-ya > wa and -yb > wb and -yc > wc):
                continue
            if next_vertex + 12 > vertex_limit:
                return -1, next_vertex
            # Sutherland-Hodgman against the near plane and the four guard planes.
            inside[0] = a
            inside[1] = c
            inside[2] = b
            corners = 3
            for plane in range(5):
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
                        # Always from inside to outside: an edge shared by two faces is cut at the same point.
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
                u = inside[0]
                v = inside[q]
                w = inside[q + 1]
                x0 = f8(vertices[u + SX])
                y0 = f8(vertices[u + SY])
                x1 = f8(vertices[v + SX])
                y1 = f8(vertices[v + SY])
                x2 = f8(vertices[w + SX])
                y2 = f8(vertices[w + SY])
                area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
                if area <= 0.0:
                    continue
                va = f8(vertices[u + IW])
                vb = f8(vertices[v + IW])
                vc = f8(vertices[w + IW])
                if fill_triangle(
                    x0, y0, va, x1, y1, vb, x2, y2, vc, area, width, height, values, ids, record, True, left, right
                ):
                    record_corners[record, 0] = u
                    record_corners[record, 1] = v
                    record_corners[record, 2] = w
                    record_face[record] = f
                    record += 1
    return record, next_vertex


@kernel
def draw_casters(
    first, last, face_start, face_end, faces, vertices, size, heights, touched, mark, bounds, no_ids, no_extents
):
    """Draw the faces of instances `first` .. `last` - 1 into the shadow map, both sides of each.

    Back faces are drawn too: a decimated mesh leaves gaps at its silhouette, and culling would let light through.

    Args:
        size: Texels along a side.
        heights: (size * size,) greatest height towards the light.
        touched: (tiles, tiles) uint8, set where a lookup may see what was drawn (when `mark`).
        bounds: (4,) x from, x to, y from, y to of what was drawn, widened (when `mark`).
        no_ids, no_extents: Empty int32 arrays.
    """
    for k in range(first, last):
        for f in range(face_start[k], face_end[k]):
            a = index(faces[f, 0])
            b = index(faces[f, 1])
            c = index(faces[f, 2])
            x0 = f8(vertices[a + index(SX)])
            y0 = f8(vertices[a + index(SY)])
            v0 = f8(vertices[a + index(IW)])
            x1 = f8(vertices[b + index(SX)])
            y1 = f8(vertices[b + index(SY)])
            v1 = f8(vertices[b + index(IW)])
            x2 = f8(vertices[c + index(SX)])
            y2 = f8(vertices[c + index(SY)])
            v2 = f8(vertices[c + index(IW)])
            area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
            if area == 0.0:
                continue
            if area < 0.0:
                area = -area
                x1, x2 = x2, x1
                y1, y2 = y2, y1
                v1, v2 = v2, v1
            if mark:
                y_first = max(0, math.ceil((min(y0, y1, y2) - 128.0) / 256.0))
                y_last = min(size - 1, math.floor((max(y0, y1, y2) - 128.0) / 256.0))
                x_first = max(0, math.ceil((min(x0, x1, x2) - 128.0) / 256.0))
                x_last = min(size - 1, math.floor((max(x0, x1, x2) - 128.0) / 256.0))
                if y_first > y_last or x_first > x_last:
                    continue
                bounds[0] = min(bounds[0], x_first)
                bounds[1] = max(bounds[1], x_last + 1)
                bounds[2] = min(bounds[2], y_first)
                bounds[3] = max(bounds[3], y_last + 1)
                # A lookup at (x, y) reads the texels x - 1 .. x + 2.
                for tile_y in range(max(0, y_first - 2) >> SHIFT, (min(size - 1, y_last + 1) >> SHIFT) + 1):
                    for tile_x in range(max(0, x_first - 2) >> SHIFT, (min(size - 1, x_last + 1) >> SHIFT) + 1):
                        touched[tile_y, tile_x] = 1
            fill_triangle(
                x0, y0, v0, x1, y1, v1, x2, y2, v2, area, size, size, heights, no_ids, 0, False, no_extents, no_extents
            )
