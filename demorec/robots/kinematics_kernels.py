"""The loops of an arm's kinematics, compiled by Numba.

Without fast-math and BLAS, and with every sum in a fixed order, the same targets result on every CPU (OpenBLAS selects
kernels by CPU type, which changes the last bits). Explicit loops replace whole-array NumPy because they compile several
times as fast. The methods are the textbook ones: product of homogeneous transforms, geometric Jacobian, damped least
squares with weights and a projected null-space pull (Siciliano et al., Robotics, sections 2.8, 3.1, 3.7).

An `arm` is the tuple `demorec.robots.kinematics.ArmKinematics.tables`.
"""

import math

import numpy as np

from demorec.core.compiled import njit

_njit = njit(cache=True, error_model="numpy")


@_njit
def _multiply(a, b):  # type: ignore[no-untyped-def]
    """Multiply two (3, 3) matrices, each sum in index order."""
    out = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            out[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j]
    return out


@_njit
def _apply(a, v):  # type: ignore[no-untyped-def]
    """Multiply a (3, 3) matrix by a (3,) vector."""
    out = np.empty(3)
    for i in range(3):
        out[i] = a[i, 0] * v[0] + a[i, 1] * v[1] + a[i, 2] * v[2]
    return out


@_njit
def _scaled(v, factor):  # type: ignore[no-untyped-def]
    """Multiply a vector by a number."""
    out = np.empty(len(v))
    for i in range(len(v)):
        out[i] = v[i] * factor
    return out


@_njit
def _blend(a, b, share):  # type: ignore[no-untyped-def]
    """Interpolate linearly between two vectors."""
    out = np.empty(len(a))
    for i in range(len(a)):
        out[i] = a[i] + share * (b[i] - a[i])
    return out


@_njit
def _axis_rotation(axis, angle):  # type: ignore[no-untyped-def]
    """Compute Rodrigues' formula for a unit axis."""
    c, s = math.cos(angle), math.sin(angle)
    x, y, z = axis[0], axis[1], axis[2]
    t = 1.0 - c
    out = np.empty((3, 3))
    out[0, 0], out[0, 1], out[0, 2] = t * x * x + c, t * x * y - s * z, t * x * z + s * y
    out[1, 0], out[1, 1], out[1, 2] = t * x * y + s * z, t * y * y + c, t * y * z - s * x
    out[2, 0], out[2, 1], out[2, 2] = t * x * z - s * y, t * y * z + s * x, t * z * z + c
    return out


@_njit
def _rotation_vector(wanted, found):  # type: ignore[no-untyped-def]
    """Compute the rotation vector (3,) in the base frame from `found` to `wanted`."""
    error = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            error[i, j] = wanted[i, 0] * found[j, 0] + wanted[i, 1] * found[j, 1] + wanted[i, 2] * found[j, 2]
    v = np.empty(3)
    v[0], v[1], v[2] = error[2, 1] - error[1, 2], error[0, 2] - error[2, 0], error[1, 0] - error[0, 1]
    sine = 0.5 * math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    cosine = 0.5 * (error[0, 0] + error[1, 1] + error[2, 2] - 1.0)
    if sine > 1e-9:
        return _scaled(v, math.atan2(sine, cosine) / (2.0 * sine))
    if cosine > 0.0:
        return _scaled(v, 0.5)
    # Half a turn: the axis is the largest column of (E + I) / 2.
    largest = 0
    for i in range(3):
        if error[i, i] > error[largest, largest]:
            largest = i
    out = np.empty(3)
    for i in range(3):
        out[i] = 0.5 * (error[i, largest] + (1.0 if i == largest else 0.0))
    return _scaled(out, math.pi / math.sqrt(out[0] * out[0] + out[1] * out[1] + out[2] * out[2]))


@_njit
def forward(q, arm):  # type: ignore[no-untyped-def]
    """Compute TCP position (3,), rotation (3, 3) and geometric Jacobian (6, n)."""
    origins, rotations, axes, tool, tool_rotation, _, _ = arm
    n = len(q)
    position = np.zeros(3)
    rotation = np.eye(3)
    joint_position = np.empty((n, 3))
    joint_axis = np.empty((n, 3))
    for i in range(n):
        step = _apply(rotation, origins[i])
        rotation = _multiply(_multiply(rotation, rotations[i]), _axis_rotation(axes[i], q[i]))
        axis = _apply(rotation, axes[i])
        for k in range(3):
            position[k] += step[k]
            joint_position[i, k] = position[k]
            joint_axis[i, k] = axis[k]
    step = _apply(rotation, tool)
    for k in range(3):
        position[k] += step[k]
    rotation = _multiply(rotation, tool_rotation)
    jacobian = np.empty((6, n))
    for i in range(n):
        x, y, z = joint_axis[i, 0], joint_axis[i, 1], joint_axis[i, 2]
        dx, dy, dz = (
            position[0] - joint_position[i, 0],
            position[1] - joint_position[i, 1],
            position[2] - joint_position[i, 2],
        )
        jacobian[0, i], jacobian[1, i], jacobian[2, i] = y * dz - z * dy, z * dx - x * dz, x * dy - y * dx
        jacobian[3, i], jacobian[4, i], jacobian[5, i] = x, y, z
    return position, rotation, jacobian


@_njit
def _damped_solve(jacobian, damping, rhs):  # type: ignore[no-untyped-def]
    """Compute (J J^T + damping^2 I)^-1 rhs for each column of rhs (6, m), by Cholesky's method."""
    n, m = jacobian.shape[1], rhs.shape[1]
    lower = np.zeros((6, 6))
    for i in range(6):
        for j in range(i + 1):
            total = damping * damping if i == j else 0.0
            for k in range(n):
                total += jacobian[i, k] * jacobian[j, k]
            for k in range(j):
                total -= lower[i, k] * lower[j, k]
            lower[i, j] = math.sqrt(total) if i == j else total / lower[j, j]
    out = rhs.copy()
    for column in range(m):
        for i in range(6):
            for k in range(i):
                out[i, column] -= lower[i, k] * out[k, column]
            out[i, column] /= lower[i, i]
        for i in range(5, -1, -1):
            for k in range(i + 1, 6):
                out[i, column] -= lower[k, i] * out[k, column]
            out[i, column] /= lower[i, i]
    return out


@_njit
def tilt_and_roll(wanted, found):  # type: ignore[no-untyped-def]
    """Compute the rotation (3,), in the axes of `found`, that aligns its approach (z), then its roll there."""
    x, y, z = 0.0, 0.0, 0.0
    for i in range(3):
        x += found[i, 0] * wanted[i, 2]
        y += found[i, 1] * wanted[i, 2]
        z += found[i, 2] * wanted[i, 2]
    sine = math.sqrt(x * x + y * y)
    angle = math.atan2(sine, z)
    axis = np.array([1.0, 0.0, 0.0])
    if sine > 1e-12:
        axis[0], axis[1] = -y / sine, x / sine
    turned = _multiply(found, _axis_rotation(axis, angle))
    along, across = 0.0, 0.0
    for i in range(3):
        along += turned[i, 0] * wanted[i, 0]
        across += turned[i, 1] * wanted[i, 0]
    out = np.empty(3)
    out[0], out[1], out[2] = axis[0] * angle, axis[1] * angle, math.atan2(across, along)
    return out


@_njit
def _ease(jacobian, error, turn, rotation, cone, roll):  # type: ignore[no-untyped-def]
    """Weight the rows of a task that leaves the approach within a cone and the roll within an angle.

    The rotation rows are transformed to the TCP's axes, so that the roll is one of them. An arm of five joints cannot
    satisfy all six rows: position is weighted far above roll, and roll far above approach, to leave the residual error
    in the approach. A cone or a roll of pi removes its rows.
    """
    turned = np.empty((3, jacobian.shape[1]))
    for k in range(jacobian.shape[1]):
        for a in range(3):
            turned[a, k] = (
                rotation[0, a] * jacobian[3, k] + rotation[1, a] * jacobian[4, k] + rotation[2, a] * jacobian[5, k]
            )
    for a in range(3):
        weight = 0.0 if (roll if a == 2 else cone) >= math.pi else (30.0 if a == 2 else 1.0)
        error[a, 0] *= 500.0
        error[3 + a, 0] = weight * turn[a]
        for k in range(jacobian.shape[1]):
            jacobian[a, k] *= 500.0
            jacobian[3 + a, k] = weight * turned[a, k]


@_njit
def _step(jacobian, error, gain, rest, q, low, high, is_whole):  # type: ignore[no-untyped-def]
    """Compute J# e + (I - J# J) gain (rest - q); for partly specified poses without the joints at their limits.

    A joint that the step would move beyond its limit is excluded, and the others compensate.
    """
    n = len(q)
    wanted = np.empty((6, 1))
    step = np.empty(n)
    for _ in range(n):
        for i in range(6):
            wanted[i, 0] = error[i, 0]
            pulled = 0.0
            for k in range(n):
                pulled += jacobian[i, k] * gain[k] * (rest[k] - q[k])
            wanted[i, 0] -= pulled
        solved = _damped_solve(jacobian, 1e-3, wanted)
        is_free = True
        for k in range(n):
            step[k] = gain[k] * (rest[k] - q[k])
            for i in range(6):
                step[k] += jacobian[i, k] * solved[i, 0]
            if not is_whole and ((q[k] <= low[k] + 0.01 and step[k] < 0.0) or (q[k] >= high[k] - 0.01 and step[k] > 0)):
                is_free = False
                gain[k] = 0.0
                for i in range(6):
                    jacobian[i, k] = 0.0
        if is_free:
            break
    return step


@_njit
def inverse(  # type: ignore[no-untyped-def]
    wanted_position,
    wanted_rotation,
    start,
    rest,
    null_gain,
    max_iterations,
    position_tolerance,
    rotation_tolerance,
    cone,
    roll,
    arm,
):
    """Iterate damped least squares: dq = J# e + (I - J# J) gain (rest - q), clipped to 0.35 rad a step and to the
    limits.

    A cone and a roll of 0 require the full pose. Otherwise the nearest pose is sought: it is reached once the motion
    stops with position, approach and roll within the allowed deviation.
    """
    low, high = arm[5], arm[6]
    n = len(start)
    q = start.copy()
    error = np.empty((6, 1))
    gain = np.empty(n)
    is_whole = cone == 0.0 and roll == 0.0
    largest = math.inf
    for iteration in range(max_iterations + 1):
        position, rotation, jacobian = forward(q, arm)
        turn = _rotation_vector(wanted_rotation, rotation) if is_whole else tilt_and_roll(wanted_rotation, rotation)
        worst_position = 0.0
        worst_rotation = 0.0
        for i in range(3):
            error[i, 0] = wanted_position[i] - position[i]
            error[3 + i, 0] = turn[i]
            worst_position = max(worst_position, abs(error[i, 0]))
            worst_rotation = max(worst_rotation, abs(error[3 + i, 0]))
        # A pull needs at least one step; otherwise a start that already reaches the pose would never be improved.
        may_stop = iteration > 0 or null_gain == 0.0
        if may_stop and worst_position < position_tolerance and worst_rotation < rotation_tolerance:
            return q, True
        if not is_whole and (largest < 1e-6 or iteration == max_iterations):
            tilt = math.sqrt(turn[0] * turn[0] + turn[1] * turn[1])
            return q, worst_position < position_tolerance and tilt <= cone and abs(turn[2]) <= roll
        if iteration == max_iterations:
            break
        if not is_whole:
            _ease(jacobian, error, turn, rotation, cone, roll)
        for k in range(n):
            gain[k] = null_gain
        step = _step(jacobian, error, gain, rest, q, low, high, is_whole)
        largest = 0.0
        for k in range(n):
            largest = max(largest, abs(step[k]))
        factor = 0.35 / largest if largest > 0.35 else 1.0
        for k in range(n):
            q[k] = min(max(q[k] + factor * step[k], low[k] + 0.01), high[k] - 0.01)
    return q, False


@_njit
def straight_path(  # type: ignore[no-untyped-def]
    start, goal, start_position, start_rotation, goal_position, goal_rotation, fractions, cone, roll, arm
):
    """Compute (N, n) joint positions on a straight tool line with uniform rotation, and whether all were reached."""
    turn = _rotation_vector(goal_rotation, start_rotation)
    angle = math.sqrt(turn[0] * turn[0] + turn[1] * turn[1] + turn[2] * turn[2])
    axis = np.array([0.0, 0.0, 1.0])
    if angle > 1e-12:
        for k in range(3):
            axis[k] = turn[k] / angle
    out = np.empty((len(fractions), len(start)))
    all_reached = True
    max_iterations = np.int64(40)  # not a literal, for which Numba would compile `_inverse` once more
    for t in range(len(fractions)):
        u = fractions[t]
        position = _blend(start_position, goal_position, u)
        rotation = _multiply(_axis_rotation(axis, u * angle), start_rotation)
        seed = _blend(start, goal, u)
        q, reached = inverse(position, rotation, seed, seed, 0.0, max_iterations, 1e-4, 1e-3, cone, roll, arm)
        all_reached = all_reached and reached
        for k in range(len(q)):
            out[t, k] = q[k]
    return out, all_reached
