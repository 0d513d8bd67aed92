# mypy: allow-untyped-defs, allow-incomplete-defs
"""Transformation of vertices from link poses to the screen, the light and the shadow map."""

import math

import numpy as np

from demorec.render.raster.kernels import layout as at
from demorec.render.raster.kernels.jit import f4, index, inlined, kernel

LANES, BLOCK = at.LANES, at.BLOCK
PX, PY, PZ, NX, NY, NZ = at.POS_X, at.POS_Y, at.POS_Z, at.NORMAL_X, at.NORMAL_Y, at.NORMAL_Z
CX, CY, CW, SX, SY, IW = at.CLIP_X, at.CLIP_Y, at.CLIP_W, at.SCREEN_X, at.SCREEN_Y, at.INVERSE_W
TO_LIGHT, UPWARD, HALFWAY = at.TO_LIGHT, at.UPWARD, at.HALFWAY
LX, LY, LZ = at.SHADOW_X, at.SHADOW_Y, at.SHADOW_Z


@kernel
def place_instances(
    pose, link_from_shape, shadow_from_world, light, world_from_shape, shadow_from_shape, light_in_shape
):
    """Compute the camera-independent matrices of every instance.

    Args:
        pose: (n, 7) world_from_link, position and quaternion xyzw.
        link_from_shape: (n, 3, 4).
        shadow_from_world: (3, 4), to texels and height.
        light: (3,) unit vector towards the light, world.
        world_from_shape, shadow_from_shape: (n, 3, 4) results.
        light_in_shape: (n, 3) result.
    """
    r = np.empty((3, 3))
    for k in range(pose.shape[0]):
        x = pose[k, 3]
        y = pose[k, 4]
        z = pose[k, 5]
        w = pose[k, 6]
        r[0, 0] = 1 - 2 * (y * y + z * z)
        r[0, 1] = 2 * (x * y - z * w)
        r[0, 2] = 2 * (x * z + y * w)
        r[1, 0] = 2 * (x * y + z * w)
        r[1, 1] = 1 - 2 * (x * x + z * z)
        r[1, 2] = 2 * (y * z - x * w)
        r[2, 0] = 2 * (x * z - y * w)
        r[2, 1] = 2 * (y * z + x * w)
        r[2, 2] = 1 - 2 * (x * x + y * y)
        local = link_from_shape[k]
        m = world_from_shape[k]
        for i in range(3):
            for j in range(4):
                m[i, j] = r[i, 0] * local[0, j] + r[i, 1] * local[1, j] + r[i, 2] * local[2, j]
            m[i, 3] += pose[k, i]
        s = shadow_from_world
        for i in range(3):
            for j in range(4):
                shadow_from_shape[k, i, j] = s[i, 0] * m[0, j] + s[i, 1] * m[1, j] + s[i, 2] * m[2, j]
            shadow_from_shape[k, i, 3] += s[i, 3]
            light_in_shape[k, i] = m[0, i] * light[0] + m[1, i] * light[1] + m[2, i] * light[2]


@kernel
def aim_camera(pose, lens, focal, width, height, clip_from_world, sky):
    """Compute the matrix of a camera, and the rays of its image.

    Args:
        pose: (7,) world_from_camera, position and quaternion xyzw, OpenCV axes.
        lens: (2,) focal lengths in half images.
        focal: Focal lengths in pixels.
        width, height: Pixels.
        clip_from_world: (3, 4) result, rows x, y (image between -w and w, y down), w = depth.
        sky: Result: origin and steps of the rays (see layout); the colours are unchanged.
    """
    x = pose[3]
    y = pose[4]
    z = pose[5]
    w = pose[6]
    right = (1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w))
    down = (2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w))
    forward = (2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y))
    for row, axis, factor in ((0, right, lens[0]), (1, down, lens[1]), (2, forward, 1.0)):
        for i in range(3):
            clip_from_world[row, i] = axis[i] * factor
        clip_from_world[row, 3] = -(axis[0] * pose[0] + axis[1] * pose[1] + axis[2] * pose[2]) * factor
    left = 0.5 - width / 2
    top = 0.5 - height / 2
    for i in range(3):
        sky[at.SKY_ORIGIN + i] = f4(forward[i] + (right[i] * left + down[i] * top) / focal)
        sky[at.SKY_STEP_X + i] = f4(right[i] / focal)
        sky[at.SKY_STEP_Y + i] = f4(down[i] / focal)


@kernel
def project_instances(
    world_from_shape, centre, radius, clip_from_world, pose, near, far, clip_from_shape, eye_in_shape, visible
):
    """Compute the matrices of every instance for one camera, and whether its bounding sphere is in view.

    Args:
        world_from_shape: (n, 3, 4).
        centre, radius: (n, 3), (n,) bounding spheres in the shapes' frames.
        clip_from_world: (3, 4), see `aim_camera`.
        pose: (7,) world_from_camera, of which only the position is used.
        near, far: Metres.
        clip_from_shape: (n, 3, 4) result.
        eye_in_shape: (n, 3) result.
        visible: (n,) bool result.
    """
    p = clip_from_world
    slope_x = math.sqrt(1 + p[0, 0] ** 2 + p[0, 1] ** 2 + p[0, 2] ** 2)
    slope_y = math.sqrt(1 + p[1, 0] ** 2 + p[1, 1] ** 2 + p[1, 2] ** 2)
    for k in range(world_from_shape.shape[0]):
        m = world_from_shape[k]
        c = clip_from_shape[k]
        for i in range(3):
            for j in range(4):
                c[i, j] = p[i, 0] * m[0, j] + p[i, 1] * m[1, j] + p[i, 2] * m[2, j]
            c[i, 3] += p[i, 3]
            eye_in_shape[k, i] = (
                m[0, i] * (pose[0] - m[0, 3]) + m[1, i] * (pose[1] - m[1, 3]) + m[2, i] * (pose[2] - m[2, 3])
            )
        x = c[0, 0] * centre[k, 0] + c[0, 1] * centre[k, 1] + c[0, 2] * centre[k, 2] + c[0, 3]
        y = c[1, 0] * centre[k, 0] + c[1, 1] * centre[k, 1] + c[1, 2] * centre[k, 2] + c[1, 3]
        w = c[2, 0] * centre[k, 0] + c[2, 1] * centre[k, 1] + c[2, 2] * centre[k, 2] + c[2, 3]
        r = radius[k]
        visible[k] = abs(x) < w + slope_x * r and abs(y) < w + slope_y * r and w > near - r and w < far + r


@inlined
def matrix_row(matrix, row):
    """Convert a row of a (3, 4) matrix to single precision."""
    return f4(matrix[row, 0]), f4(matrix[row, 1]), f4(matrix[row, 2]), f4(matrix[row, 3])


@inlined
def moved(row, x, y, z):
    """Compute one coordinate of a transformed point from a row of the matrix."""
    return row[0] * x + row[1] * y + row[2] * z + row[3]


@kernel
def transform_vertices(
    first,
    last,
    visible,
    geometry,
    clip_from_shape,
    shadow_from_shape,
    light_in_shape,
    world_from_shape,
    eye_in_shape,
    offset,
    width,
    height,
):
    """Fill the per-camera attributes of the vertices of the visible instances `first` .. `last` - 1.

    Args:
        offset: Displacement of a vertex along its normal for the shadow map lookup, metres.
        width, height: Samples.
    """
    vertices = geometry.vertices
    half_width = f4(width * 128.0)
    half_height = f4(height * 128.0)
    for k in range(first, last):
        if not visible[k]:
            continue
        m = clip_from_shape[k]
        m0, m1, m2 = matrix_row(m, 0), matrix_row(m, 1), matrix_row(m, 2)
        s = shadow_from_shape[k]
        s0, s1, s2 = matrix_row(s, 0), matrix_row(s, 1), matrix_row(s, 2)
        l0, l1, l2 = f4(light_in_shape[k, 0]), f4(light_in_shape[k, 1]), f4(light_in_shape[k, 2])
        w = world_from_shape[k]
        u0, u1, u2 = f4(w[2, 0]), f4(w[2, 1]), f4(w[2, 2])
        e0, e1, e2 = f4(eye_in_shape[k, 0]), f4(eye_in_shape[k, 1]), f4(eye_in_shape[k, 2])
        vertex = geometry.vertex_start[k]
        end = vertex + geometry.vertex_count[k]
        while vertex < end:
            block = vertex // LANES
            lane = vertex - block * LANES
            n = min(LANES - lane, end - vertex)
            base = block * BLOCK + lane
            vertex += n
            for j in range(n):
                i = index(base + j)
                x = vertices[i]
                y = vertices[i + index(PY)]
                z = vertices[i + index(PZ)]
                cx = moved(m0, x, y, z)
                cy = moved(m1, x, y, z)
                cw = moved(m2, x, y, z)
                inverse = f4(1) / cw
                vertices[i + index(CX)] = cx
                vertices[i + index(CY)] = cy
                vertices[i + index(CW)] = cw
                vertices[i + index(IW)] = inverse
                vertices[i + index(SX)] = np.floor(cx * inverse * half_width + half_width + f4(0.5))
                vertices[i + index(SY)] = np.floor(cy * inverse * half_height + half_height + f4(0.5))
            for j in range(n):
                i = index(base + j)
                x = vertices[i]
                y = vertices[i + index(PY)]
                z = vertices[i + index(PZ)]
                n0 = vertices[i + index(NX)]
                n1 = vertices[i + index(NY)]
                n2 = vertices[i + index(NZ)]
                vertices[i + index(TO_LIGHT)] = n0 * l0 + n1 * l1 + n2 * l2
                vertices[i + index(UPWARD)] = n0 * u0 + n1 * u1 + n2 * u2
                vx = e0 - x
                vy = e1 - y
                vz = e2 - z
                length = f4(1) / np.sqrt(vx * vx + vy * vy + vz * vz)
                hx = vx * length + l0
                hy = vy * length + l1
                hz = vz * length + l2
                vertices[i + index(HALFWAY)] = (n0 * hx + n1 * hy + n2 * hz) / np.sqrt(hx * hx + hy * hy + hz * hz)
                x += n0 * offset
                y += n1 * offset
                z += n2 * offset
                vertices[i + index(LX)] = moved(s0, x, y, z)
                vertices[i + index(LY)] = moved(s1, x, y, z)
                vertices[i + index(LZ)] = moved(s2, x, y, z)


@kernel
def transform_casters(first, last, geometry, shadow_from_shape):
    """Fill screen position (1/256 texel) and height of the vertices of shadow casters `first` .. `last` - 1."""
    vertices = geometry.vertices
    for k in range(first, last):
        s = shadow_from_shape[k]
        s0, s1, s2 = matrix_row(s, 0), matrix_row(s, 1), matrix_row(s, 2)
        vertex = geometry.vertex_start[k]
        end = vertex + geometry.vertex_count[k]
        while vertex < end:
            block = vertex // LANES
            lane = vertex - block * LANES
            n = min(LANES - lane, end - vertex)
            base = block * BLOCK + lane
            vertex += n
            for j in range(n):
                i = index(base + j)
                x = vertices[i]
                y = vertices[i + index(PY)]
                z = vertices[i + index(PZ)]
                # Texel centres are integers in the lookup, half-integers in the rasteriser.
                vertices[i + index(SX)] = np.floor((moved(s0, x, y, z) + f4(0.5)) * f4(256) + f4(0.5))
                vertices[i + index(SY)] = np.floor((moved(s1, x, y, z) + f4(0.5)) * f4(256) + f4(0.5))
                vertices[i + index(IW)] = moved(s2, x, y, z)
