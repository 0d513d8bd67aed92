# mypy: allow-untyped-defs, allow-incomplete-defs
"""Static surfaces before a fixed camera: kept between images, with shadows updated only where they may change."""

from __future__ import annotations

import numpy as np

from demorec.render.raster.kernels import layout as at
from demorec.render.raster.kernels.jit import f4, i4, index, kernel
from demorec.render.raster.kernels.lookups import shadow_at, tone

EDGE, QUEUED, BACKGROUND = at.EDGE, at.QUEUED, at.BACKGROUND
SHIFT = at.TILE_SHIFT


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
def list_tiles(still, pixel_ids, ids, triangles, tiles, size, tile_start, tile_pixels):
    """List for each shadow map tile the pixels that read it: a pixel y * W + x per lookup.

    Args:
        still: (H, W, STILL_SIZE) from shading; pixel_ids, ids: records of pixels and of samples.
        tile_start: (tiles * tiles + 1,) result, start of each tile's pixels.
        tile_pixels: Result, with room for four lookups per pixel.
    """
    height, width = pixel_ids.shape
    records = triangles.planes
    origins = triangles.origins
    limit = f4(size - 1)
    tile_start[:] = 0
    for fill in range(2):
        for y in range(height):
            for x in range(width):
                edge = pixel_ids[y, x] == EDGE
                if pixel_ids[y, x] == BACKGROUND:
                    continue
                for s in range(4 if edge else 1):
                    if edge:
                        sample_x = 2 * x + (s & 1)
                        sample_y = 2 * y + (s >> 1)
                        record = ids[sample_y, sample_x]
                        if record < 0:
                            continue
                        fx = f4(sample_x - origins[record, 0])
                        fy = f4(sample_y - origins[record, 1])
                        p = records[record]
                        z = f4(1) / (p[0] + p[2] * fy + p[1] * fx)
                        place_x = (p[3] + p[5] * fy + p[4] * fx) * z
                        place_y = (p[6] + p[8] * fy + p[7] * fx) * z
                    else:
                        place_x = still[y, x, 6]
                        place_y = still[y, x, 7]
                    if place_x >= f4(0) and place_y >= f4(0) and place_x < limit and place_y < limit:
                        tile = (int(place_y) >> SHIFT) * tiles + (int(place_x) >> SHIFT)
                        if fill == 0:
                            tile_start[tile + 1] += 1
                        else:
                            tile_pixels[tile_start[tile]] = y * width + x
                            tile_start[tile] += 1
        if fill == 0:
            for i in range(tiles * tiles):
                tile_start[i + 1] += tile_start[i]
    for i in range(tiles * tiles, 0, -1):
        tile_start[i] = tile_start[i - 1]
    tile_start[0] = 0


@kernel
def gather_still(still, tile_pixels, count, gathered):
    """Copy the pixels' terms into the order of the tiles, (count, STILL_SIZE)."""
    width = still.shape[1]
    for i in range(count):
        y = tile_pixels[i] // width
        x = tile_pixels[i] - y * width
        for j in range(at.STILL_SIZE):
            gathered[i, j] = still[y, x, j]


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
