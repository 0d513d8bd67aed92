# mypy: allow-untyped-defs, allow-incomplete-defs
"""Exact triangle rasterisation: every sample of a mesh is covered once, in any order of its triangles.

Corners are snapped to 1/256 sample, so that the edge functions are integers, exact in float64; samples on an edge
belong to the triangle for which it is a top or left edge.
"""

import math

from demorec.render.raster.kernels.jit import f4, f8, i4, index, inlined
from demorec.render.raster.kernels.layout import SCREEN_X, SCREEN_Y

STRIP = 16
"""Samples of a row tested at once; with fewer, the compiler unrolls the loop instead of vectorising it."""
NARROW = 3 * STRIP
"""Width below which triangles are tested sample by sample: cheaper than computing the end of each row."""


@inlined
def screen(vertices, address):
    """Read the screen position of a vertex: (x, y) in 1/256 sample, integers in float64."""
    return f8(vertices[address + index(SCREEN_X)]), f8(vertices[address + index(SCREEN_Y)])


@inlined
def doubled_area(a, b, c):
    """Compute twice the area of a triangle (x, y); positive if its corners are clockwise, y pointing down."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1])


@inlined
def covered(low, high, count):
    """Return the first and last of `count` samples in a row between two positions (1/256 sample)."""
    return max(0, math.ceil((low - 128.0) / 256.0)), min(count - 1, math.floor((high - 128.0) / 256.0))


@inlined
def edge_function(a, b, x, y):
    """Compute an edge function's step from sample to sample, along a row and down, and its value at (x, y).

    It is negative outside, and on an edge that belongs to the neighbour.
    """
    step_x = a[1] - b[1]
    step_y = b[0] - a[0]
    value = step_x * (x - a[0]) + step_y * (y - a[1])
    if not (step_x > 0.0 or (step_x == 0.0 and step_y > 0.0)):
        value -= 1.0
    return step_x * 256.0, step_y * 256.0, value


@inlined
def within_edge(step_x, value, low, high):
    """Clip a span of samples to those where an edge function is not negative.

    Quotients of exact integers round to the correct side.
    """
    if step_x > 0.0:
        low = max(low, -value / step_x)
    elif step_x < 0.0:
        high = min(high, -value / step_x)
    elif value < 0.0:
        high = -1.0
    return low, high


@inlined
def fill_triangle(a, b, c, v0, v1, v2, area, width, height, values, ids, record, left, right):
    """Draw one triangle of positive area where its value exceeds the stored one.

    Args:
        a, b, c: Corners, in units of `screen`.
        v0, v1, v2: Value at the corners (inverse depth, height), linear over the image.
        values, ids: (height * width,) greatest stored value, and its record.
        left, right: (height,) extents drawn in each row, widened (to the corners, for narrow triangles).

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
    x = x_first * 256.0 + 128.0
    y = y_first * 256.0 + 128.0
    a0, b0, e0 = edge_function(a, b, x, y)
    a1, b1, e1 = edge_function(b, c, x, y)
    a2, b2, e2 = edge_function(c, a, x, y)
    row_value = v0 + step_x * (x - x0) + step_y * (y - y0)
    value_step = f4(step_x * 256.0)
    step_y *= 256.0
    span = x_last - x_first
    strips = span // STRIP + 1
    # Values beyond the row's end are read and written back, which requires them to be inside the image.
    if span < NARROW and y_last * width + x_first + strips * STRIP <= width * height:
        limit = i4(span)
        number = i4(record)
        nearer_count = i4(0)
        for row in range(y_first, y_last + 1):
            left[index(row)] = min(left[index(row)], i4(x_first))
            right[index(row)] = max(right[index(row)], i4(x_last + 1))
            start = row * width + x_first
            c0 = e0
            c1 = e1
            c2 = e2
            value = f4(row_value)
            for strip in range(strips):
                base = strip * STRIP
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
        low, high = within_edge(a0, e0, 0.0, float(span))
        low, high = within_edge(a1, e1, low, high)
        low, high = within_edge(a2, e2, low, high)
        if low <= high:
            first = math.ceil(low)
            last = math.floor(high)
            if first <= last:
                hit = True
                value = f4(row_value)
                start = row * width + x_first + first
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
        e0 += b0
        e1 += b1
        e2 += b2
        row_value += step_y
    return hit
