# mypy: allow-untyped-defs, allow-incomplete-defs
"""Lookups of every shaded point: shadow, texture, light, tone. All paths share this arithmetic, so that they agree."""

import numpy as np

from demorec.render.raster.kernels.jit import f4, i4, index, inlined, u4

KNEE = 0.8 * 255
"""Brightness up to which colours are unchanged."""
ROOM = 255 - KNEE


@inlined
def tone(value):
    """Map light to 0..255: linear up to a knee, then flattening out, so that bright surfaces keep their relief."""
    over = (value - f4(KNEE)) * f4(1 / ROOM)
    return value if value <= f4(KNEE) else f4(KNEE) + f4(ROOM) * (over / (f4(1) + over))


@inlined
def filtered_shadow(heights, q, size, z, fx, fy):
    """Compute the ratio of light at height `z`: 3x3 box over bilinear comparisons (16 texels), q the upper-left of 2x2.

    If the corners of the footprint agree, the rest is assumed to agree.
    """
    o = q - size - 1
    a = heights[index(o)]
    b = heights[index(o + 3)]
    c = heights[index(o + 3 * size)]
    d = heights[index(o + 3 * size + 3)]
    if z >= max(a, b, c, d):
        return f4(1)
    if z < min(a, b, c, d):
        return f4(0)
    total = f4(0)
    for j in range(4):
        weight = f4(1)
        if j == 0:
            weight = f4(1) - fy
        elif j == 3:
            weight = fy
        p = index(o + j * size)
        lit0 = f4(1) if z >= heights[p] else f4(0)
        lit1 = f4(1) if z >= heights[p + index(1)] else f4(0)
        lit2 = f4(1) if z >= heights[p + index(2)] else f4(0)
        lit3 = f4(1) if z >= heights[p + index(3)] else f4(0)
        total += weight * ((lit0 - lit0 * fx) + lit1 + lit2 + lit3 * fx)
    return total * f4(1 / 9)


@inlined
def shadow_at(heights, size, x, y, z):
    """Compute the ratio of light at a position of the shadow map (texels, metres); 1 outside."""
    limit = f4(size - 2)
    if x >= f4(1) and y >= f4(1) and x < limit and y < limit:
        column = i4(x)
        row = i4(y)
        return filtered_shadow(heights, row * size + column, size, z, x - f4(column), y - f4(row))
    return f4(1)


@inlined
def mip_level(density, log2_side):
    """Choose the level at which a pixel covers one to two texels; `density` in (texture widths / pixel)^2."""
    texels = density * f4(1 << (2 * log2_side))
    level = 0
    while texels > f4(2.0) and level < log2_side:
        texels *= f4(0.25)
        level += 1
    return level


@inlined
def texel_at(texels, start, log2_side, u, v):
    """Interpolate (red, green, blue), 0..255, bilinearly in one mip level; its border repeats its start."""
    scale = f4(256 << log2_side)
    mask = i4((1 << log2_side) - 1)
    pitch = i4((1 << log2_side) + 1)
    iu = i4(np.floor(u * scale - f4(128)))
    iv = i4(np.floor(v * -scale - f4(128)))
    q = index(i4(start) + i4(i4((iv >> i4(8)) & mask) * pitch) + i4((iu >> i4(8)) & mask))
    return blend_texels(
        texels[q], texels[q + index(1)], texels[q + index(pitch)], texels[q + index(pitch) + index(1)], iu, iv
    )


@inlined
def blend_texels(a, b, c, d, iu, iv):
    """Interpolate four packed texels by the low 8 bits of `iu`, `iv`; red and blue share one multiplication."""
    pair = u4(0xFF00FF)
    low = u4(255)
    fu = u4(iu & i4(255))
    fv = u4(iv & i4(255))
    gu = u4(u4(256) - fu)
    gv = u4(u4(256) - fv)
    r0 = u4(u4(u4(u4(a & pair) * gu) + u4(u4(b & pair) * fu)) >> u4(8)) & pair
    r1 = u4(u4(u4(u4(c & pair) * gu) + u4(u4(d & pair) * fu)) >> u4(8)) & pair
    red_blue = u4(u4(u4(u4(r0 * gv) + u4(r1 * fv)) >> u4(8)) & pair)
    g0 = u4(u4(u4(u4(a >> u4(8)) & low) * gu) + u4(u4(u4(b >> u4(8)) & low) * fu))
    g1 = u4(u4(u4(u4(c >> u4(8)) & low) * gu) + u4(u4(u4(d >> u4(8)) & low) * fu))
    green = u4(u4(u4(g0 * gv) + u4(g1 * fv)) >> u4(16))
    return f4(i4(red_blue & low)), f4(i4(green)), f4(i4(red_blue >> u4(16)))
