# mypy: allow-untyped-defs, allow-incomplete-defs
"""Pixels of 2x2 samples: shaded once or sample by sample, with the depth at the centre."""

import numpy as np

from demorec.render.raster.kernels import layout as at
from demorec.render.raster.kernels.fill import doubled_area, screen
from demorec.render.raster.kernels.jit import f4, f8, i4, index, inlined, kernel
from demorec.render.raster.kernels.lookups import mip_level, shadow_at, texel_at, tone
from demorec.render.raster.kernels.shade import sky_pixel

EDGE, QUEUED, BACKGROUND = at.EDGE, at.QUEUED, at.BACKGROUND
STILL = -2
"""Value in the image of pixel records for static pixels, already shaded."""
FLAT_ENOUGH = 0.012
"""Maximum relative depth difference of samples of one surface that are shaded as one."""


@kernel
def halve_extents(sample_left, sample_right, left, right, pixel_ids):
    """Clear the previous image from `pixel_ids` and convert extents in samples to extents in pixels."""
    for y in range(pixel_ids.shape[0]):
        for x in range(left[y], right[y]):
            pixel_ids[y, x] = STILL
        left[y] = min(sample_left[2 * y], sample_left[2 * y + 1]) >> 1
        right[y] = (max(sample_right[2 * y], sample_right[2 * y + 1]) + 1) >> 1


@kernel
def resolve(left, right, first_record, ids, values, records, face_table, pixel_ids, edges, mixed):
    """Classify the pixels inside the extents: one surface, background, static, or an edge.

    Args:
        first_record: Records below it are static and already shaded.
        ids, values: (2H, 2W) records and inverse depths of the samples.
        pixel_ids: (H, W) result: record, BACKGROUND, STILL or EDGE.
        records: The triangles.
        edges: Result: y * W + x of pixels to be shaded sample by sample.
        mixed: Result: y * W + x of all pixels with different samples; of size 0 if not requested.

    Returns:
        Number of entries in `edges` and in `mixed`.
    """
    width = pixel_ids.shape[1]
    want_mixed = mixed.size > 0
    record_face = records.faces
    edge_count = 0
    mixed_count = 0
    for y in range(pixel_ids.shape[0]):
        for x in range(left[y], right[y]):
            a = ids[2 * y, 2 * x]
            b = ids[2 * y, 2 * x + 1]
            c = ids[2 * y + 1, 2 * x]
            d = ids[2 * y + 1, 2 * x + 1]
            if a == b and a == c and a == d:
                pixel_ids[y, x] = a if a >= first_record else STILL
                continue
            if max(a, b, c, d) < first_record:
                pixel_ids[y, x] = STILL
                continue
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
def shade_edges(count, edges, ids, triangles, looks, color):
    """Shade the listed pixels sample by sample and average; equal samples are shaded once."""
    width = color.shape[1]
    records = triangles.planes
    origins = triangles.origins
    face_table = looks.face_table
    face_color = looks.face_color
    light = looks.light
    mips = looks.mips
    for e in range(count):
        y = edges[e] // width
        x = edges[e] - y * width
        red = f4(0)
        green = f4(0)
        blue = f4(0)
        for s in range(4):
            sample_x = 2 * x + (s & 1)
            sample_y = 2 * y + (s >> 1)
            record = ids[sample_y, sample_x]
            alike = 1
            repeated = False
            for r in range(4):
                if r != s and ids[2 * y + (r >> 1), 2 * x + (r & 1)] == record:
                    alike += 1
                    if r < s:
                        repeated = True
            if repeated:
                continue
            share = f4(0.25) * f4(alike)
            if record < 0:
                r0, g0, b0 = sky_pixel(looks.sky, f4(x), f4(y))
                red += share * r0
                green += share * g0
                blue += share * b0
                continue
            face = triangles.faces[record]
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
                    looks.heights,
                    looks.size,
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
                r0, g0, b0 = texel_at(looks.texels, mips[texture, level], log2_side - level, u, v)
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
def covers(record, point, corners, vertices):
    """Check whether a triangle contains a point of the screen, in units of `screen`."""
    a = screen(vertices, index(corners[record, 0]))
    b = screen(vertices, index(corners[record, 1]))
    c = screen(vertices, index(corners[record, 2]))
    return doubled_area(a, b, point) >= 0.0 and doubled_area(b, c, point) >= 0.0 and doubled_area(c, a, point) >= 0.0


@inlined
def value_at_centre(x, y, record, triangles):
    """Compute the inverse depth of a triangle's plane at the centre of a pixel."""
    fx = f4(2 * x - triangles.origins[record, 0]) + f4(0.5)
    fy = f4(2 * y - triangles.origins[record, 1]) + f4(0.5)
    planes = triangles.planes
    return planes[record, 0] + planes[record, 2] * fy + planes[record, 1] * fx


@kernel
def centre_of_mixed(mixed, mixed_count, ids, values, triangles, face_table, vertices, far_value, images):
    """Resolve depth and segmentation at the centre of pixels with different samples.

    Candidates are the triangles that own a sample of the pixel, then those of its neighbours; the nearest one that
    covers the centre is visible there. If none does (the centre is on a triangle that fell between the samples), the
    owner of most samples is used, its plane clamped to the depths of its samples.
    """
    depth = images.depth
    segments = images.segments
    corners = triangles.corners
    width = images.color.shape[1]
    for e in range(mixed_count):
        y = mixed[e] // width
        x = mixed[e] - y * width
        centre = (f8((2 * x + 1) * 256), f8((2 * y + 1) * 256))
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
            if record >= 0 and covers(record, centre, corners, vertices):
                value = value_at_centre(x, y, record, triangles)
                if value > far_value and (best < 0 or value > best_value):
                    best = record
                    best_value = value
        if best < 0:
            # Then triangles that own a sample of a neighbouring pixel.
            for s in range(16):
                sample_x = 2 * x - 1 + (s & 3)
                sample_y = 2 * y - 1 + (s >> 2)
                if 0 <= sample_x < 2 * width and 0 <= sample_y < ids.shape[0]:
                    record = ids[sample_y, sample_x]
                    if record >= 0 and covers(record, centre, corners, vertices):
                        value = value_at_centre(x, y, record, triangles)
                        if value > far_value and (best < 0 or value > best_value):
                            best = record
                            best_value = value
        if best < 0 and most >= 0 and background_count < 2:
            best = most
            best_value = min(max(value_at_centre(x, y, most, triangles), low), high)
        if depth.size > 0:
            depth[y, x] = f4(1) / best_value if best >= 0 else f4(0)
        if segments.size > 0:
            segments[y, x] = face_table[triangles.faces[best], at.FACE_SEGMENT] if best >= 0 else -1
