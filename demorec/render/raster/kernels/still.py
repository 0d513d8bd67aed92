# mypy: allow-untyped-defs, allow-incomplete-defs
"""Static surfaces before a fixed camera: kept between images, with shadows updated only where they may change."""

import numpy as np

from demorec.render.raster.kernels import layout as at
from demorec.render.raster.kernels.jit import f4, i4, index, kernel
from demorec.render.raster.kernels.lookups import shadow_at, tone

EDGE, QUEUED = at.EDGE, at.QUEUED


@kernel
def restore_samples(values, still_values, ids, still_ids, left, right):
    """Undo the moving layer of the previous image, row by row, and empty the extents."""
    width = ids.shape[1]
    values = values.reshape(-1)
    still_values = still_values.reshape(-1)
    ids = ids.reshape(-1)
    still_ids = still_ids.reshape(-1)
    for y in range(left.shape[0]):
        start = y * width + left[y]
        n = right[y] - left[y]
        for j in range(n):
            values[index(start + j)] = still_values[index(start + j)]
        for j in range(n):
            ids[index(start + j)] = still_ids[index(start + j)]
        left[y] = width
        right[y] = 0


@kernel
def shade_still(
    touched, tile_start, tile_pixels, gathered, first_record, pixel_ids, still_pixel_ids, looks, color, edges, count
):
    """Shade static pixels that read a touched tile again; edge pixels are appended to `edges` instead.

    Returns:
        Number of entries in `edges`, initially `count`; pixels appended here are marked QUEUED.
    """
    width = pixel_ids.shape[1]
    in_shadow = looks.light[at.IN_SHADOW]
    flat = touched.reshape(-1)
    for tile in range(flat.shape[0]):
        if flat[index(tile)] == 0:
            continue
        for i in range(tile_start[tile], tile_start[tile + 1]):
            pixel = tile_pixels[i]
            y = pixel // width
            x = pixel - y * width
            now = pixel_ids[y, x]
            if now >= first_record or now in (EDGE, QUEUED):
                continue
            if still_pixel_ids[y, x] == EDGE:
                edges[count] = pixel
                count += 1
                pixel_ids[y, x] = QUEUED
                continue
            lit = shadow_at(looks.heights, looks.size, gathered[i, 6], gathered[i, 7], gathered[i, 8])
            lit = in_shadow + (f4(1) - in_shadow) * lit
            color[y, x, 0] = np.uint8(i4(tone(gathered[i, 0] + lit * gathered[i, 3]) + f4(0.5)))
            color[y, x, 1] = np.uint8(i4(tone(gathered[i, 1] + lit * gathered[i, 4]) + f4(0.5)))
            color[y, x, 2] = np.uint8(i4(tone(gathered[i, 2] + lit * gathered[i, 5]) + f4(0.5)))
    return count


@kernel
def clear_queued(edges, first, last, pixel_ids, value):
    """Remove the mark QUEUED from the listed pixels."""
    width = pixel_ids.shape[1]
    for e in range(first, last):
        y = edges[e] // width
        pixel_ids[y, edges[e] - y * width] = value
