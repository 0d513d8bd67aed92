# mypy: allow-untyped-defs, allow-incomplete-defs
"""Colour, depth and segmentation of the pixels that one triangle covers, row by row.

Runs of equal record in a row are first turned into columns of numbers (light terms, position in the shadow map). Then
the shadow is looked up for the whole row, then colours are computed. Simple loops over one array, with offsets known to
the compiler, become vector code; the gathers have separate loops.
"""

import numpy as np

from demorec.render.raster.kernels import layout as at
from demorec.render.raster.kernels.jit import f4, i4, index, inlined, kernel
from demorec.render.raster.kernels.lookups import blend_texels, filtered_shadow, mip_level, tone

CHUNK = 1024
"""Pixels processed at once."""
PITCH = CHUNK + 16
# Columns of the scratch array.
SHADOW_X = 0
SHADOW_Y = PITCH
SHADOW_Z = 2 * PITCH
LIT = 3 * PITCH
AMBIENT_R, AMBIENT_G, AMBIENT_B = 4 * PITCH, 5 * PITCH, 6 * PITCH
DIRECT_R, DIRECT_G, DIRECT_B = 7 * PITCH, 8 * PITCH, 9 * PITCH
FRACTION_X, FRACTION_Y = 10 * PITCH, 11 * PITCH
SPECULAR = 12 * PITCH
RED, GREEN, BLUE = 13 * PITCH, 14 * PITCH, 15 * PITCH
COLUMNS = 16
MIP_BLOCK_SHIFT = 4
"""log2 of the pixels of a row that share one mip level, aligned to fixed positions."""


@inlined
def sky_pixel(sky, x, y):
    """Compute (red, green, blue) of the background at a pixel: paler towards the horizon."""
    dx = sky[0] + sky[3] * x + sky[6] * y
    dy = sky[1] + sky[4] * x + sky[7] * y
    dz = sky[2] + sky[5] * x + sky[8] * y
    up = dz / np.sqrt(dx * dx + dy * dy + dz * dz)
    up = max(up, f4(0))
    share = f4(1) - (f4(1) - up) * (f4(1) - up)
    red = sky[9] + share * (sky[12] - sky[9])
    green = sky[10] + share * (sky[13] - sky[10])
    blue = sky[11] + share * (sky[14] - sky[11])
    return red, green, blue


@inlined
def look_up_row(scratch, places, count, heights, size):
    """Fill LIT from SHADOW_X, Y, Z; the same arithmetic as `shadow_at`."""
    limit = f4(size - 2)
    pitch = i4(size)
    for j in range(count):
        x = scratch[index(j + SHADOW_X)]
        y = scratch[index(j + SHADOW_Y)]
        within = (x >= f4(1)) & (y >= f4(1)) & (x < limit) & (y < limit)
        x = x if within else f4(0)
        y = y if within else f4(0)
        column = i4(x)
        row = i4(y)
        q = i4(i4(row * pitch) + column)
        places[index(j)] = q if within else i4(-1)
        scratch[index(j + FRACTION_X)] = x - f4(column)
        scratch[index(j + FRACTION_Y)] = y - f4(row)
    for j in range(count):
        q = places[index(j)]
        lit = f4(1)
        if q >= 0:
            z = scratch[index(j + SHADOW_Z)]
            fx = scratch[index(j + FRACTION_X)]
            fy = scratch[index(j + FRACTION_Y)]
            lit = filtered_shadow(heights, int(q), size, z, fx, fy)
        scratch[index(j + LIT)] = lit


@inlined
def texture_run(
    scratch, first, count, places, corners, texels, start, log2_side, u, u_step, v, v_step, w, w_step, x, x_step
):
    """Fill RED, GREEN, BLUE with bilinear texels of one mip level; the same arithmetic as `texel_at`."""
    scale = f4(256 << log2_side)
    mask = i4((1 << log2_side) - 1)
    pitch = i4((1 << log2_side) + 1)
    base = i4(start)
    for j in range(count):
        fx = x + f4(i4(j)) * x_step
        depth = f4(1) / (w + w_step * fx)
        iu = i4(np.floor((u + u_step * fx) * depth * scale - f4(128)))
        iv = i4(np.floor((v + v_step * fx) * depth * -scale - f4(128)))
        places[index(j)] = i4(i4(i4((iv >> i4(8)) & mask) * pitch) + i4((iu >> i4(8)) & mask)) + base
        places[index(j + PITCH)] = iu
        places[index(j + 2 * PITCH)] = iv
    for j in range(count):
        q = index(places[index(j)])
        r = index(q + index(pitch))
        corners[index(j)] = texels[q]
        corners[index(j + PITCH)] = texels[q + index(1)]
        corners[index(j + 2 * PITCH)] = texels[r]
        corners[index(j + 3 * PITCH)] = texels[r + index(1)]
    for j in range(count):
        a = corners[index(j)]
        b = corners[index(j + PITCH)]
        c = corners[index(j + 2 * PITCH)]
        d = corners[index(j + 3 * PITCH)]
        red, green, blue = blend_texels(a, b, c, d, places[index(j + PITCH)], places[index(j + 2 * PITCH)])
        i = first + j
        scratch[index(i + RED)] = red
        scratch[index(i + GREEN)] = green
        scratch[index(i + BLUE)] = blue


@inlined
def finish_chunk(y, count, columns, scratch, places, looks, color, keep, still):
    """Compute shadow, tone and colour of the pixels gathered in scratch."""
    look_up_row(scratch, places, count, looks.heights, looks.size)
    in_shadow = looks.light[at.IN_SHADOW]
    for j in range(count):
        lit = in_shadow + (f4(1) - in_shadow) * scratch[index(j + LIT)]
        scratch[index(j + RED)] = tone(scratch[index(j + AMBIENT_R)] + lit * scratch[index(j + DIRECT_R)])
        scratch[index(j + GREEN)] = tone(scratch[index(j + AMBIENT_G)] + lit * scratch[index(j + DIRECT_G)])
        scratch[index(j + BLUE)] = tone(scratch[index(j + AMBIENT_B)] + lit * scratch[index(j + DIRECT_B)])
    for j in range(count):
        x = columns[index(j)]
        color[y, x, 0] = np.uint8(i4(scratch[index(j + RED)] + f4(0.5)))
        color[y, x, 1] = np.uint8(i4(scratch[index(j + GREEN)] + f4(0.5)))
        color[y, x, 2] = np.uint8(i4(scratch[index(j + BLUE)] + f4(0.5)))
    if keep:
        for j in range(count):
            x = columns[index(j)]
            for q in range(6):
                still[y, x, q] = scratch[index(j + (q + 4) * PITCH)]
            for q in range(3):
                still[y, x, 6 + q] = scratch[index(j + q * PITCH)]


@kernel
def shade_rows(left, right, first_record, ids, samples, triangles, looks, images, still):
    """Shade the pixels inside the extents with a record of at least `first_record` (-1: background too).

    Args:
        left, right: (H,) extents of each row.
        ids: (H, W) int32 record of each pixel.
        samples: Samples along a pixel's side; records are planes over samples.
        triangles, looks, images: See layout.
        still: (H, W, STILL_SIZE) result for later shading, x = -9 if empty; of size 0 if not requested.
    """
    records = triangles.planes
    origins = triangles.origins
    face_table = looks.face_table
    face_color = looks.face_color
    light = looks.light
    mips = looks.mips
    color, depth, segments = images
    want_depth = depth.size > 0
    want_segments = segments.size > 0
    keep = still.size > 0
    scratch = np.empty(COLUMNS * PITCH, np.float32)
    columns = np.empty(PITCH, np.int32)
    places = np.empty(3 * PITCH, np.int32)
    corners = np.empty(4 * PITCH, np.uint32)
    scale = f4(samples)
    middle = f4(0.5 * (samples - 1))
    area = f4(samples * samples)
    ambient = light[at.AMBIENT]
    ambient_up = light[at.AMBIENT_UP]
    diffuse = light[at.DIFFUSE]
    light_r = light[at.LIGHT_RED]
    light_g = light[at.LIGHT_GREEN]
    light_b = light[at.LIGHT_BLUE]
    for y in range(ids.shape[0]):
        x = left[y]
        x_end = right[y]
        filled = np.int64(0)  # not a literal, which would compile all inlined code once more
        while x < x_end:
            record = ids[y, x]
            xa = x
            x += 1
            while x < x_end and ids[y, x] == record:
                x += 1
            if record < first_record:
                continue
            if record < 0:
                for i in range(xa, x):
                    red, green, blue = sky_pixel(looks.sky, f4(i), f4(y))
                    color[y, i, 0] = np.uint8(i4(red + f4(0.5)))
                    color[y, i, 1] = np.uint8(i4(green + f4(0.5)))
                    color[y, i, 2] = np.uint8(i4(blue + f4(0.5)))
                if keep:
                    for i in range(xa, x):
                        still[y, i, 6] = f4(-9)
                if want_depth:
                    for i in range(xa, x):
                        depth[y, i] = f4(0)
                if want_segments:
                    for i in range(xa, x):
                        segments[y, i] = -1
                continue
            if x - xa > CHUNK:
                x = xa + CHUNK  # the next iteration handles the rest
            n = x - xa
            if filled + n > CHUNK:
                finish_chunk(y, filled, columns, scratch, places, looks, color, keep, still)
                filled = np.int64(0)
            m = filled
            filled += n
            face = triangles.faces[record]
            flags = face_table[face, at.FACE_FLAGS]
            sy = f4(y * samples - origins[record, 1]) + middle
            sx = f4(xa * samples - origins[record, 0]) + middle
            c0 = face_color[face, 0]
            c1 = face_color[face, 1]
            c2 = face_color[face, 2]
            w = records[record, 0] + records[record, 2] * sy
            w_step = records[record, 1]
            s0 = records[record, 3] + records[record, 5] * sy
            s0_step = records[record, 4]
            s1 = records[record, 6] + records[record, 8] * sy
            s1_step = records[record, 7]
            s2 = records[record, 9] + records[record, 11] * sy
            s2_step = records[record, 10]
            for j in range(n):
                columns[index(m + j)] = xa + j
            if flags & at.SMOOTH:
                specular = face_color[face, at.FACE_SPECULAR]
                l0 = records[record, 12] + records[record, 14] * sy
                l0_step = records[record, 13]
                u0 = records[record, 15] + records[record, 17] * sy
                u0_step = records[record, 16]
                h0 = records[record, 18] + records[record, 20] * sy
                h0_step = records[record, 19]
                for j in range(n):
                    q = m + j
                    fx = sx + f4(i4(j)) * scale
                    z = f4(1) / (w + w_step * fx)
                    facing = (l0 + l0_step * fx) * z
                    lit = facing > f4(0)
                    amb = ambient + ambient_up * ((u0 + u0_step * fx) * z)
                    d = diffuse * facing if lit else f4(0)
                    half = min((h0 + h0_step * fx) * z, f4(1))
                    e = half * half
                    e *= e
                    e *= e
                    e *= e
                    e *= e
                    e = specular * e if (half > f4(0.7)) & lit else f4(0)
                    scratch[index(q + SHADOW_X)] = (s0 + s0_step * fx) * z if lit else f4(-9)
                    scratch[index(q + SHADOW_Y)] = (s1 + s1_step * fx) * z
                    scratch[index(q + SHADOW_Z)] = (s2 + s2_step * fx) * z
                    scratch[index(q + AMBIENT_R)] = c0 * amb
                    scratch[index(q + AMBIENT_G)] = c1 * amb
                    scratch[index(q + AMBIENT_B)] = c2 * amb
                    scratch[index(q + DIRECT_R)] = c0 * d
                    scratch[index(q + DIRECT_G)] = c1 * d
                    scratch[index(q + DIRECT_B)] = c2 * d
                    scratch[index(q + SPECULAR)] = e
            else:
                facing = records[record, 12]
                lit = facing > f4(0)
                amb = ambient + ambient_up * records[record, 15]
                d = diffuse * facing if lit else f4(0)
                a0 = c0 * amb
                a1 = c1 * amb
                a2 = c2 * amb
                d0 = c0 * d
                d1 = c1 * d
                d2 = c2 * d
                for j in range(n):
                    q = m + j
                    fx = sx + f4(i4(j)) * scale
                    z = f4(1) / (w + w_step * fx)
                    scratch[index(q + SHADOW_X)] = (s0 + s0_step * fx) * z if lit else f4(-9)
                    scratch[index(q + SHADOW_Y)] = (s1 + s1_step * fx) * z
                    scratch[index(q + SHADOW_Z)] = (s2 + s2_step * fx) * z
                    scratch[index(q + AMBIENT_R)] = a0
                    scratch[index(q + AMBIENT_G)] = a1
                    scratch[index(q + AMBIENT_B)] = a2
                    scratch[index(q + DIRECT_R)] = d0
                    scratch[index(q + DIRECT_G)] = d1
                    scratch[index(q + DIRECT_B)] = d2
                    scratch[index(q + SPECULAR)] = f4(0)
            if flags & at.TEXTURED:
                texture = face_table[face, at.FACE_TEXTURE]
                log2_side = mips[texture, at.MIP_LEVELS]
                tu = records[record, 21] + records[record, 23] * sy
                tv = records[record, 24] + records[record, 26] * sy
                density = area * records[record, at.TEXEL_DENSITY]
                i = xa
                while i < x:
                    level = -1
                    i_end = i
                    while i_end < x:
                        block = i_end >> MIP_BLOCK_SHIFT
                        block_x = f4(((block << MIP_BLOCK_SHIFT) + 8) * samples - origins[record, 0])
                        z = f4(1) / max(w + w_step * block_x, f4(0.02))
                        here = mip_level(density * z * z * z, log2_side)
                        if level < 0:
                            level = here
                        if here != level:
                            break
                        i_end = min(x, (block + 1) << MIP_BLOCK_SHIFT)
                    run_x = f4(i * samples - origins[record, 0]) + middle
                    texture_run(
                        scratch,
                        m + i - xa,
                        i_end - i,
                        places,
                        corners,
                        looks.texels,
                        mips[texture, level],
                        log2_side - level,
                        tu,
                        records[record, 22],
                        tv,
                        records[record, 25],
                        w,
                        w_step,
                        run_x,
                        scale,
                    )
                    i = i_end
                for j in range(m, m + n):
                    red = scratch[index(j + RED)]
                    green = scratch[index(j + GREEN)]
                    blue = scratch[index(j + BLUE)]
                    scratch[index(j + AMBIENT_R)] *= red
                    scratch[index(j + AMBIENT_G)] *= green
                    scratch[index(j + AMBIENT_B)] *= blue
                    scratch[index(j + DIRECT_R)] *= red
                    scratch[index(j + DIRECT_G)] *= green
                    scratch[index(j + DIRECT_B)] *= blue
            for j in range(m, m + n):
                e = scratch[index(j + SPECULAR)]
                scratch[index(j + DIRECT_R)] = (scratch[index(j + DIRECT_R)] + e) * light_r
                scratch[index(j + DIRECT_G)] = (scratch[index(j + DIRECT_G)] + e) * light_g
                scratch[index(j + DIRECT_B)] = (scratch[index(j + DIRECT_B)] + e) * light_b
            if want_depth:
                for j in range(n):
                    depth[y, xa + j] = f4(1) / (w + w_step * (sx + f4(i4(j)) * scale))
            if want_segments:
                segment = face_table[face, at.FACE_SEGMENT]
                for i in range(xa, x):
                    segments[y, i] = segment
        if filled > 0:
            finish_chunk(y, filled, columns, scratch, places, looks, color, keep, still)
