# mypy: allow-untyped-defs, allow-incomplete-defs
"""Pixels of 2x2 samples: which are shaded once, which sample by sample, and whose depth is seen at the centre."""

from __future__ import annotations

import numpy as np

from demorec.render.raster.kernels import layout as at
from demorec.render.raster.kernels.jit import f4, f8, i4, index, inlined, kernel
from demorec.render.raster.kernels.lookups import mip_level, shadow_at, texel_at, tone
from demorec.render.raster.kernels.shade import sky_pixel

EDGE, QUEUED, BACKGROUND = at.EDGE, at.QUEUED, at.BACKGROUND
STILL = -2
"""In the image of pixel records: what stood still and was shaded before."""
FLAT_ENOUGH = 0.012
"""Samples of one surface whose depths differ by less than this share are shaded as one."""
SX, SY = at.SCREEN_X, at.SCREEN_Y


@kernel
def halve_extents(sample_left, sample_right, left, right, pixel_ids):
    """Clear what the last image left in `pixel_ids` and turn extents in samples into extents in pixels."""
    for y in range(pixel_ids.shape[0]):
        for x in range(left[y], right[y]):
            pixel_ids[y, x] = STILL
        left[y] = min(sample_left[2 * y], sample_left[2 * y + 1]) >> 1
        right[y] = (max(sample_right[2 * y], sample_right[2 * y + 1]) + 1) >> 1


@kernel
def resolve(
    left,
    right,
    first_record,
    ids,
    values,
    record_face,
    face_table,
    pixel_ids,
    edges,
    edge_count,
    mixed,
    want_mixed,
    flags,
):
    """Sort the pixels inside the extents: one surface, background, standing still, or an edge.

    Args:
        first_record: Records below it stand still and were shaded before.
        ids, values: (2H, 2W) records and inverse depths of the samples.
        pixel_ids: (H, W) result: record, BACKGROUND, STILL or EDGE.
        edges: Appended from `edge_count` on: y * W + x of pixels to be shaded sample by sample.
        mixed: Likewise, of all pixels whose samples differ (when `want_mixed`).
        flags: Set of each record from `first_record` on that owns a sample.

    Returns:
        Numbers of entries in `edges` and in `mixed`.
    """
    width = pixel_ids.shape[1]
    mixed_count = 0
    lowest = max(first_record, 0)
    for y in range(pixel_ids.shape[0]):
        for x in range(left[y], right[y]):
            a = ids[2 * y, 2 * x]
            b = ids[2 * y, 2 * x + 1]
            c = ids[2 * y + 1, 2 * x]
            d = ids[2 * y + 1, 2 * x + 1]
            if a == b and a == c and a == d:
                pixel_ids[y, x] = a if a >= first_record else STILL
                if a >= lowest:
                    flags[a] = 1
                continue
            if max(a, b, c, d) < first_record:
                pixel_ids[y, x] = STILL
                continue
            for record in (a, b, c, d):
                if record >= lowest:
                    flags[record] = 1
            if want_mixed:
                mixed[mixed_count] = y * width + x
                mixed_count += 1
            edge = True
            if min(a, b, c, d) >= 0:
                group = face_table[record_face[a], at.FACE_GROUP]
                if (
                    group == face_table[record_face[b], at.FACE_GROUP]
                    and group == face_table[record_face[c], at.FACE_GROUP]
                    and group == face_table[record_face[d], at.FACE_GROUP]
                ):
                    p = values[2 * y, 2 * x]
                    q = values[2 * y, 2 * x + 1]
                    r = values[2 * y + 1, 2 * x]
                    s = values[2 * y + 1, 2 * x + 1]
                    farthest = min(p, q, r, s)
                    nearest = max(p, q, r, s)
                    edge = nearest - farthest > f4(FLAT_ENOUGH) * nearest
            if edge:
                edges[edge_count] = y * width + x
                edge_count += 1
                pixel_ids[y, x] = EDGE
            else:
                pixel_ids[y, x] = a
    return edge_count, mixed_count


@kernel
def shade_edges(
    first,
    last,
    edges,
    ids,
    width,
    record_face,
    face_table,
    face_color,
    records,
    origins,
    light,
    heights,
    size,
    texels,
    mips,
    sky,
    color,
):
    """Shade the listed pixels sample by sample and mix; equal samples are shaded once."""
    for e in range(first, last):
        y = edges[e] // width
        x = edges[e] - y * width
        red = f4(0)
        green = f4(0)
        blue = f4(0)
        for s in range(4):
            sample_x = 2 * x + (s & 1)
            sample_y = 2 * y + (s >> 1)
            record = ids[sample_y, sample_x]
            count = 1
            repeated = False
            for r in range(4):
                if r != s and ids[2 * y + (r >> 1), 2 * x + (r & 1)] == record:
                    count += 1
                    if r < s:
                        repeated = True
            if repeated:
                continue
            share = f4(0.25) * f4(count)
            if record < 0:
                r0, g0, b0 = sky_pixel(sky, f4(x), f4(y))
                red += share * r0
                green += share * g0
                blue += share * b0
                continue
            face = record_face[record]
            flags = face_table[face, at.FACE_FLAGS]
            fx = f4(sample_x - origins[record, 0])
            fy = f4(sample_y - origins[record, 1])
            p = records[record]
            z = f4(1) / (p[0] + p[2] * fy + p[1] * fx)
            c0 = face_color[face, 0]
            c1 = face_color[face, 1]
            c2 = face_color[face, 2]
            if flags & at.SMOOTH:
                facing = (p[12] + p[14] * fy + p[13] * fx) * z
                upward = (p[15] + p[17] * fy + p[16] * fx) * z
            else:
                facing = p[12]
                upward = p[15]
            ambient = light[at.AMBIENT] + light[at.AMBIENT_UP] * upward
            diffuse = f4(0)
            specular = f4(0)
            lit = f4(0)
            if facing > f4(0):
                diffuse = light[at.DIFFUSE] * facing
                lit = shadow_at(
                    heights,
                    size,
                    (p[3] + p[5] * fy + p[4] * fx) * z,
                    (p[6] + p[8] * fy + p[7] * fx) * z,
                    (p[9] + p[11] * fy + p[10] * fx) * z,
                )
                lit = light[at.IN_SHADOW] + (f4(1) - light[at.IN_SHADOW]) * lit
                if flags & at.SMOOTH:
                    half = min((p[18] + p[20] * fy + p[19] * fx) * z, f4(1))
                    if half > f4(0.7):
                        half *= half
                        half *= half
                        half *= half
                        half *= half
                        half *= half
                        specular = face_color[face, at.FACE_SPECULAR] * half
            if flags & at.TEXTURED:
                texture = face_table[face, at.FACE_TEXTURE]
                log2_side = mips[texture, at.MIP_LEVELS]
                level = mip_level(f4(4) * p[at.TEXEL_DENSITY] * z * z * z, log2_side)
                u = (p[21] + p[23] * fy + p[22] * fx) * z
                v = (p[24] + p[26] * fy + p[25] * fx) * z
                r0, g0, b0 = texel_at(texels, mips[texture, level], log2_side - level, u, v)
                c0 *= r0
                c1 *= g0
                c2 *= b0
            red += share * tone(c0 * ambient + lit * ((c0 * diffuse + specular) * light[at.LIGHT_RED]))
            green += share * tone(c1 * ambient + lit * ((c1 * diffuse + specular) * light[at.LIGHT_GREEN]))
            blue += share * tone(c2 * ambient + lit * ((c2 * diffuse + specular) * light[at.LIGHT_BLUE]))
        color[y, x, 0] = np.uint8(i4(red + f4(0.5)))
        color[y, x, 1] = np.uint8(i4(green + f4(0.5)))
        color[y, x, 2] = np.uint8(i4(blue + f4(0.5)))


@inlined
def covers(record, x, y, record_corners, vertices):
    """Whether a triangle contains a point of the screen (1/256 sample)."""
    a = index(record_corners[record, 0])
    b = index(record_corners[record, 1])
    c = index(record_corners[record, 2])
    x0 = f8(vertices[a + index(SX)])
    y0 = f8(vertices[a + index(SY)])
    x1 = f8(vertices[b + index(SX)])
    y1 = f8(vertices[b + index(SY)])
    x2 = f8(vertices[c + index(SX)])
    y2 = f8(vertices[c + index(SY)])
    e0 = (y0 - y1) * (x - x0) + (x1 - x0) * (y - y0)
    e1 = (y1 - y2) * (x - x1) + (x2 - x1) * (y - y1)
    e2 = (y2 - y0) * (x - x2) + (x0 - x2) * (y - y2)
    return e0 >= 0.0 and e1 >= 0.0 and e2 >= 0.0


@kernel
def centre_of_mixed(
    mixed,
    mixed_count,
    width,
    ids,
    values,
    record_corners,
    record_face,
    face_table,
    vertices,
    records,
    origins,
    far_value,
    want_depth,
    depth,
    want_segments,
    segments,
):
    """Depth and segmentation, at the pixel's centre, of pixels whose samples differ.

    Of the triangles that own a sample of the pixel, or else of its neighbours, the nearest that covers the centre is
    seen there. Where none does (it lies on a triangle that fell between the samples), the owner of most samples
    stands for it, its plane kept within the depths of its samples.
    """
    for e in range(mixed_count):
        y = mixed[e] // width
        x = mixed[e] - y * width
        centre_x = f8((2 * x + 1) * 256)
        centre_y = f8((2 * y + 1) * 256)
        best = -1
        best_value = f4(0)
        most = -1
        most_count = 0
        low = f4(0)
        high = f4(0)
        background_count = 0
        for s in range(4):
            sample_x = 2 * x + (s & 1)
            sample_y = 2 * y + (s >> 1)
            record = ids[sample_y, sample_x]
            if record < 0:
                background_count += 1
            count = 0
            lowest = f4(3e38)
            highest = f4(-3e38)
            for r in range(4):
                other_x = 2 * x + (r & 1)
                other_y = 2 * y + (r >> 1)
                if ids[other_y, other_x] == record:
                    count += 1
                    value = values[other_y, other_x]
                    lowest = min(lowest, value)
                    highest = max(highest, value)
            if record >= 0 and count > most_count:
                most_count = count
                most = record
                low = lowest
                high = highest
            if record >= 0 and covers(record, centre_x, centre_y, record_corners, vertices):
                fx = f4(2 * x - origins[record, 0]) + f4(0.5)
                fy = f4(2 * y - origins[record, 1]) + f4(0.5)
                value = records[record, 0] + records[record, 2] * fy + records[record, 1] * fx
                if value > far_value and (best < 0 or value > best_value):
                    best = record
                    best_value = value
        if best < 0:
            # Then one that owns a sample of a neighbouring pixel.
            for s in range(16):
                sample_x = 2 * x - 1 + (s & 3)
                sample_y = 2 * y - 1 + (s >> 2)
                if 0 <= sample_x < 2 * width and 0 <= sample_y < ids.shape[0]:
                    record = ids[sample_y, sample_x]
                    if record >= 0 and covers(record, centre_x, centre_y, record_corners, vertices):
                        fx = f4(2 * x - origins[record, 0]) + f4(0.5)
                        fy = f4(2 * y - origins[record, 1]) + f4(0.5)
                        value = records[record, 0] + records[record, 2] * fy + records[record, 1] * fx
                        if value > far_value and (best < 0 or value > best_value):
                            best = record
                            best_value = value
        if best < 0 and most >= 0 and background_count < 2:
            fx = f4(2 * x - origins[most, 0]) + f4(0.5)
            fy = f4(2 * y - origins[most, 1]) + f4(0.5)
            best = most
            best_value = records[most, 0] + records[most, 2] * fy + records[most, 1] * fx
            best_value = min(max(best_value, low), high)
        if want_depth:
            depth[y, x] = f4(1) / best_value if best >= 0 else f4(0)
        if want_segments:
            segments[y, x] = face_table[record_face[best], at.FACE_SEGMENT] if best >= 0 else -1
