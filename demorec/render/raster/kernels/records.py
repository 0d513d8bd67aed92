# mypy: allow-untyped-defs, allow-incomplete-defs
"""Which triangles own samples, and the planes over the image that shading needs of them."""

from __future__ import annotations

from demorec.render.raster.kernels import layout as at
from demorec.render.raster.kernels.jit import f4, f8, index, inlined, kernel

SX, SY, IW = at.SCREEN_X, at.SCREEN_Y, at.INVERSE_W
TO_LIGHT, UPWARD, HALFWAY, TEX_U, TEX_V = at.TO_LIGHT, at.UPWARD, at.HALFWAY, at.TEX_U, at.TEX_V
LX, LY, LZ = at.SHADOW_X, at.SHADOW_Y, at.SHADOW_Z


@kernel
def flag_owners(left, right, first_record, ids, flags):
    """Set the flag of every record from `first_record` on that owns a sample of (rows, columns) `ids`."""
    before = -9
    lowest = max(first_record, 0)
    for y in range(ids.shape[0]):
        for x in range(left[y], right[y]):
            record = ids[y, x]
            if record != before:
                before = record
                if record >= lowest:
                    flags[record] = 1


@inlined
def set_plane(records, record, column, vertices, attribute, a, b, c, step_x, step_y, value):
    """Plane of one attribute over the image; the weights hold each corner's share, divided by its depth."""
    p = vertices[a + attribute]
    q = vertices[b + attribute]
    r = vertices[c + attribute]
    records[record, column] = value[0] * p + value[1] * q + value[2] * r
    records[record, column + 1] = step_x[0] * p + step_x[1] * q + step_x[2] * r
    records[record, column + 2] = step_y[0] * p + step_y[1] * q + step_y[2] * r


@inlined
def set_constant(records, record, column, value):
    """Plane of a quantity that is the same all over the triangle: the inverse depth's, scaled."""
    records[record, column] = value * records[record, 0]
    records[record, column + 1] = value * records[record, 1]
    records[record, column + 2] = value * records[record, 2]


@kernel
def set_up_records(first, last, flags, record_corners, record_face, face_table, vertices, records, origins):
    """Fill (n, RECORD) `records` and (n, 2) `origins` (the sample where the planes start) of the flagged ones."""
    for t in range(first, last):
        if flags[t] == 0:
            continue
        a = index(record_corners[t, 0])
        b = index(record_corners[t, 1])
        c = index(record_corners[t, 2])
        x0 = f8(vertices[a + index(SX)])
        y0 = f8(vertices[a + index(SY)])
        x1 = f8(vertices[b + index(SX)])
        y1 = f8(vertices[b + index(SY)])
        x2 = f8(vertices[c + index(SX)])
        y2 = f8(vertices[c + index(SY)])
        area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
        scale = 256.0 / area
        origin_x = int(min(x0, x1, x2)) >> 8
        origin_y = int(min(y0, y1, y2)) >> 8
        px = f8((origin_x << 8) + 128)
        py = f8((origin_y << 8) + 128)
        origins[t, 0] = origin_x
        origins[t, 1] = origin_y
        # Barycentric weights: steps a sample, and values at the origin.
        a1 = (y2 - y0) * scale
        b1 = (x0 - x2) * scale
        a2 = (y0 - y1) * scale
        b2 = (x1 - x0) * scale
        c1 = (a1 * (px - x0) + b1 * (py - y0)) / 256.0
        c2 = (a2 * (px - x0) + b2 * (py - y0)) / 256.0
        wa = f8(vertices[a + index(IW)])
        wb = f8(vertices[b + index(IW)])
        wc = f8(vertices[c + index(IW)])
        step_x = (f4(-(a1 + a2) * wa), f4(a1 * wb), f4(a2 * wc))
        step_y = (f4(-(b1 + b2) * wa), f4(b1 * wb), f4(b2 * wc))
        value = (f4((1.0 - c1 - c2) * wa), f4(c1 * wb), f4(c2 * wc))
        records[t, 0] = value[0] + value[1] + value[2]
        records[t, 1] = step_x[0] + step_x[1] + step_x[2]
        records[t, 2] = step_y[0] + step_y[1] + step_y[2]
        set_plane(records, t, at.SHADOW_X_PLANE, vertices, index(LX), a, b, c, step_x, step_y, value)
        set_plane(records, t, at.SHADOW_Y_PLANE, vertices, index(LY), a, b, c, step_x, step_y, value)
        set_plane(records, t, at.SHADOW_Z_PLANE, vertices, index(LZ), a, b, c, step_x, step_y, value)
        kind = face_table[record_face[t], at.FACE_FLAGS]
        if kind & at.SMOOTH:
            e0 = (x1 - x0) ** 2 + (y1 - y0) ** 2
            e1 = (x2 - x1) ** 2 + (y2 - y1) ** 2
            e2 = (x0 - x2) ** 2 + (y0 - y2) ** 2
            if area * area < 65536.0 * max(e0, e1, e2):
                # Thinner than a sample: the mean normal, where the gradient would run wild.
                third = f4(1.0 / 3.0)
                set_constant(
                    records,
                    t,
                    at.TO_LIGHT_PLANE,
                    (vertices[a + index(TO_LIGHT)] + vertices[b + index(TO_LIGHT)] + vertices[c + index(TO_LIGHT)])
                    * third,
                )
                set_constant(
                    records,
                    t,
                    at.UPWARD_PLANE,
                    (vertices[a + index(UPWARD)] + vertices[b + index(UPWARD)] + vertices[c + index(UPWARD)]) * third,
                )
                set_constant(
                    records,
                    t,
                    at.HALFWAY_PLANE,
                    (vertices[a + index(HALFWAY)] + vertices[b + index(HALFWAY)] + vertices[c + index(HALFWAY)])
                    * third,
                )
            else:
                set_plane(records, t, at.TO_LIGHT_PLANE, vertices, index(TO_LIGHT), a, b, c, step_x, step_y, value)
                set_plane(records, t, at.UPWARD_PLANE, vertices, index(UPWARD), a, b, c, step_x, step_y, value)
                set_plane(records, t, at.HALFWAY_PLANE, vertices, index(HALFWAY), a, b, c, step_x, step_y, value)
        else:
            # Flat: the value itself, no plane.
            records[t, at.TO_LIGHT_PLANE] = vertices[a + index(TO_LIGHT)]
            records[t, at.UPWARD_PLANE] = vertices[a + index(UPWARD)]
        if kind & at.TEXTURED:
            set_plane(records, t, at.TEX_U_PLANE, vertices, index(TEX_U), a, b, c, step_x, step_y, value)
            set_plane(records, t, at.TEX_V_PLANE, vertices, index(TEX_V), a, b, c, step_x, step_y, value)
            du1 = f8(vertices[b + index(TEX_U)] - vertices[a + index(TEX_U)])
            du2 = f8(vertices[c + index(TEX_U)] - vertices[a + index(TEX_U)])
            dv1 = f8(vertices[b + index(TEX_V)] - vertices[a + index(TEX_V)])
            dv2 = f8(vertices[c + index(TEX_V)] - vertices[a + index(TEX_V)])
            # The ratio of areas on texture and screen falls with the cube of inverse depth.
            records[t, at.TEXEL_DENSITY] = f4(abs(du1 * dv2 - du2 * dv1) * 65536.0 * wa * wb * wc / area)
