# mypy: allow-untyped-defs, allow-incomplete-defs
"""The image planes of the triangles' attributes, for shading."""

from demorec.render.raster.kernels import layout as at
from demorec.render.raster.kernels.fill import doubled_area, screen
from demorec.render.raster.kernels.jit import f4, f8, index, inlined, kernel

LANES, IW, TEX_U, TEX_V = at.LANES, at.INVERSE_W, at.TEX_U, at.TEX_V


@inlined
def set_planes(planes, record, column, vertices, attribute, count, corners, value, step_x, step_y):
    """Compute the image planes of consecutive attributes; the weights hold each corner's share over depth."""
    a, b, c = corners
    for k in range(count):
        p = vertices[a + index(attribute + k * LANES)]
        q = vertices[b + index(attribute + k * LANES)]
        r = vertices[c + index(attribute + k * LANES)]
        planes[record, column + 3 * k] = value[0] * p + value[1] * q + value[2] * r
        planes[record, column + 3 * k + 1] = step_x[0] * p + step_x[1] * q + step_x[2] * r
        planes[record, column + 3 * k + 2] = step_y[0] * p + step_y[1] * q + step_y[2] * r


@kernel
def set_up_records(first, last, records, face_table, vertices):
    """Fill the planes and origins of the records `first` .. `last` - 1."""
    planes = records.planes
    for t in range(first, last):
        a = index(records.corners[t, 0])
        b = index(records.corners[t, 1])
        c = index(records.corners[t, 2])
        corners = (a, b, c)
        pa = screen(vertices, a)
        pb = screen(vertices, b)
        pc = screen(vertices, c)
        x0, y0 = pa
        x1, y1 = pb
        x2, y2 = pc
        area = doubled_area(pa, pb, pc)
        scale = 256.0 / area
        origin_x = int(min(x0, x1, x2)) >> 8
        origin_y = int(min(y0, y1, y2)) >> 8
        px = f8((origin_x << 8) + 128)
        py = f8((origin_y << 8) + 128)
        records.origins[t, 0] = origin_x
        records.origins[t, 1] = origin_y
        # Barycentric weights: steps per sample, and values at the origin.
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
        planes[t, 0] = value[0] + value[1] + value[2]
        planes[t, 1] = step_x[0] + step_x[1] + step_x[2]
        planes[t, 2] = step_y[0] + step_y[1] + step_y[2]
        set_planes(planes, t, at.SHADOW_X_PLANE, vertices, at.SHADOW_X, 3, corners, value, step_x, step_y)
        kind = face_table[records.faces[t], at.FACE_FLAGS]
        if kind & at.SMOOTH:
            e0 = (x1 - x0) ** 2 + (y1 - y0) ** 2
            e1 = (x2 - x1) ** 2 + (y2 - y1) ** 2
            e2 = (x0 - x2) ** 2 + (y0 - y2) ** 2
            if area * area < 65536.0 * max(e0, e1, e2):
                # Thinner than a sample: the mean normal, because the gradient would be unbounded.
                third = f4(1.0 / 3.0)
                for k in range(3):
                    place = at.TO_LIGHT + k * LANES
                    mean = (
                        vertices[a + index(place)] + vertices[b + index(place)] + vertices[c + index(place)]
                    ) * third
                    for j in range(3):
                        planes[t, at.TO_LIGHT_PLANE + 3 * k + j] = mean * planes[t, j]
            else:
                set_planes(planes, t, at.TO_LIGHT_PLANE, vertices, at.TO_LIGHT, 3, corners, value, step_x, step_y)
        else:
            # Flat: the value itself, not a plane.
            planes[t, at.TO_LIGHT_PLANE] = vertices[a + index(at.TO_LIGHT)]
            planes[t, at.UPWARD_PLANE] = vertices[a + index(at.UPWARD)]
        if kind & at.TEXTURED:
            set_planes(planes, t, at.TEX_U_PLANE, vertices, TEX_U, 2, corners, value, step_x, step_y)
            du1 = f8(vertices[b + index(TEX_U)] - vertices[a + index(TEX_U)])
            du2 = f8(vertices[c + index(TEX_U)] - vertices[a + index(TEX_U)])
            dv1 = f8(vertices[b + index(TEX_V)] - vertices[a + index(TEX_V)])
            dv2 = f8(vertices[c + index(TEX_V)] - vertices[a + index(TEX_V)])
            # The ratio of areas on texture and screen falls with the cube of inverse depth.
            planes[t, at.TEXEL_DENSITY] = f4(abs(du1 * dv2 - du2 * dv1) * 65536.0 * wa * wb * wc / area)
