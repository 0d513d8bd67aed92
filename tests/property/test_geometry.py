"""Properties of rigid transforms, verified with SciPy."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from demorec.core.geometry import Pose, quat_from_rotation

coordinates = st.floats(-10, 10, allow_nan=False)
components = st.tuples(*[st.floats(-1, 1, allow_nan=False)] * 4).filter(lambda q: sum(v * v for v in q) > 1e-3)


@st.composite
def poses(draw: st.DrawFn) -> Pose:
    quat = np.array(draw(components))
    return Pose(
        position=np.array(draw(st.tuples(coordinates, coordinates, coordinates))),
        quat_xyzw=quat / np.linalg.norm(quat),
    )


@given(poses(), poses())
def test_composition_is_matrix_multiplication(a: Pose, b: Pose) -> None:
    np.testing.assert_allclose((a @ b).matrix(), a.matrix() @ b.matrix(), atol=1e-9)


@given(poses())
def test_inverse_undoes(a: Pose) -> None:
    np.testing.assert_allclose((a.inverse() @ a).matrix(), np.eye(4), atol=1e-9)


@given(poses())
def test_rotation_agrees_with_scipy(a: Pose) -> None:
    np.testing.assert_allclose(a.rotation, Rotation.from_quat(a.quat_xyzw).as_matrix(), atol=1e-9)


@given(poses())
def test_quaternion_of_a_rotation_agrees_with_scipy(a: Pose) -> None:
    rotation = Rotation.from_quat(a.quat_xyzw).as_matrix()
    back = Rotation.from_quat(quat_from_rotation(rotation)).as_matrix()
    np.testing.assert_allclose(back, rotation, atol=1e-9)


@given(poses(), st.lists(st.tuples(coordinates, coordinates, coordinates), min_size=1, max_size=5))
def test_apply_maps_points_as_the_matrix_does(a: Pose, points: list[tuple[float, float, float]]) -> None:
    homogeneous = np.column_stack([np.array(points), np.ones(len(points))])
    np.testing.assert_allclose(a.apply(np.array(points)), (homogeneous @ a.matrix().T)[:, :3], atol=1e-8)
