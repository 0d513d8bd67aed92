# mypy: allow-untyped-defs, allow-incomplete-defs
"""Exact triangle rasterisation: every sample of a mesh is covered once, whatever the order of its triangles.

Corners are snapped to 1/256 sample, so that the edge functions are whole numbers, exact in float64; samples on an
edge belong to the triangle for which it is a top or left edge.
"""

from __future__ import annotations

import math

from demorec.render.raster.kernels.jit import f4, f8, i4, index, inlined
from demorec.render.raster.kernels.layout import SCREEN_X, SCREEN_Y

STRIP = 16
"""Samples of a row that are tested at once. Fewer, and the compiler would unroll the loop instead of making vector code
of it."""
NARROW = 3 * STRIP
"""Triangles narrower than this are tested sample by sample: less work than finding where each of their rows ends."""


@inlined
def screen(vertices, address):
    """Where a vertex is: (x, y) in 1/256 sample, whole numbers in float64."""
    return f8(vertices[address + index(SCREEN_X)]), f8(vertices[address + index(SCREEN_Y)])


@inlined
def doubled_area(a, b, c):
    """Of a triangle (x, y); positive where its corners go round clockwise, y pointing down."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1])


@inlined
def covered(low, high, count):
    """The first and the last of `count` samples in a row between two places (1/256 sample)."""
    return max(0, math.ceil((low - 128.0) / 256.0)), min(count - 1, math.floor((high - 128.0) / 256.0))


@inlined
def fill_triangle(a, b, c, v0, v1, v2, area, width, height, values, ids, record, with_ids, left, right):
    """Draw one triangle of positive area where its value is greater than what is there.

    Args:
        a, b, c: Corners, as of `screen`.
        v0, v1, v2: Value at the corners (inverse depth, height), linear over the image.
        values, ids: (height * width,) greatest value so far, and the record it came from.
        with_ids: Whether ids, left and right are kept.
        left, right: (height,) extents of what was drawn in each row, widened (to the corners, where narrow).

    Returns:
        Whether it may own a sample.
    """
    x0, y0 = a
    x1, y1 = b
    x2, y2 = c
    y_first, y_last = covered(min(y0, y1, y2), max(y0, y1, y2), height)
    if y_first > y_last:
        return False
    x_first, x_last = covered(min(x0, x1, x2), max(x0, x1, x2), width)
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
    # What lies beyond the row's end is read and written back: within the image, that is.
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
