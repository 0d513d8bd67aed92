"""Poses and cameras against SciPy's rotations and hand-computed projections."""

from __future__ import annotations

import math
import pickle

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from demorec.core.geometry import Pose, intrinsic_matrix, look_at, quat_from_rotation, rotation_from_quat, wrap_angle


def test_look_at_puts_the_target_on_the_optical_axis_upright() -> None:
    world_from_camera = look_at([1.0, 2.0, 3.0], [0.0, 0.0, 0.0])
    target_in_camera = world_from_camera.inverse().apply(np.zeros(3))
    np.testing.assert_allclose(target_in_camera, [0, 0, math.sqrt(14)], atol=1e-12)
    above = world_from_camera.inverse().apply(np.array([0.0, 0.0, 0.1]))
    assert above[1] < 0, "y points down, so a point above the target has a negative y"


def test_look_at_along_up_is_refused() -> None:
    with pytest.raises(ValueError, match="parallel to up"):
        look_at([0, 0, 1], [0, 0, 0])


def test_intrinsics_map_the_field_of_view_to_the_border() -> None:
    fov_y = math.radians(60)
    k = intrinsic_matrix(width=640, height=480, fov_y=fov_y)
    top = k @ np.array([0.0, -math.tan(fov_y / 2), 1.0])
    np.testing.assert_allclose(top[:2] / top[2], [320.0, 0.0], atol=1e-9)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_half_turns_have_a_quaternion(axis: int) -> None:
    rotation = Rotation.from_rotvec(np.eye(3)[axis] * math.pi).as_matrix()
    np.testing.assert_allclose(rotation_from_quat(quat_from_rotation(rotation)), rotation, atol=1e-12)


def test_pose_is_read_only_and_survives_pickling() -> None:
    pose = Pose.from_yaw([1, 2, 3], 0.3)
    with pytest.raises(ValueError, match="read-only"):
        pose.position[0] = 5
    assert pickle.loads(pickle.dumps(pose)) == pose


def test_wrong_shapes_are_named() -> None:
    with pytest.raises(ValueError, match=r"position has shape \(2,\)"):
        Pose(position=np.zeros(2))


def test_wrap_angle() -> None:
    assert wrap_angle(3 * math.pi) == pytest.approx(-math.pi)
    assert wrap_angle(-0.5) == pytest.approx(-0.5)
