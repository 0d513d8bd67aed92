"""Keyframes: the next commands that close or open the gripper, and the hand's poses at them."""

from __future__ import annotations

import math

import numpy as np
import pytest

from lerobot_policy_act_keypoints.keyframes import find_keyframes, keyframe_targets


def test_the_next_changes_are_found_and_never_those_of_another_episode() -> None:
    episode = np.repeat([4, 7, 9], [8, 5, 3])
    opening = np.array([1, 1, 1, 0, 0, 0, 1, 1, 0, 0, 1, 1, 1, 1, 1, 1]) * 0.08
    found = find_keyframes(opening, episode)
    assert found[:8].tolist() == [[3, 6]] * 3 + [[-1, 6]] * 3 + [[-1, -1]] * 2
    assert found[8:13].tolist() == [[-1, 10]] * 2 + [[-1, -1]] * 3  # an initially closed gripper is not a change
    assert found[13:].tolist() == [[-1, -1]] * 3


def about_z(angle: float) -> list[float]:
    """Quaternion (x, y, z, w) of a turn about z."""
    return [0.0, 0.0, math.sin(angle / 2), math.cos(angle / 2)]


def test_targets_are_those_of_geometry() -> None:
    """The hand, turned by 90 degrees, will grasp 3 cm along base x: that is -3 cm along its own y."""
    position = np.array([[0.50, 0.10, 0.30], [0.53, 0.10, 0.02], [0.53, 0.06, 0.02]])
    quat = np.array([about_z(math.pi / 2), about_z(math.pi / 6), about_z(-math.pi / 3)])
    found = keyframe_targets(position, quat, np.array([[1, 2], [-1, 2], [-1, -1]]))
    now = dict(zip(found.names, found.values[0].tolist(), strict=True))
    expected = {
        "closing.x": 0.53,
        "closing.from_tcp.x": 0.03,
        "closing.from_tcp.z": -0.28,
        "closing.from_tcp.near_x": 0.6,
        "closing.from_tcp.near_z": -0.28 / 0.30,
        "closing.from_tcp.hand_x": 0.0,
        "closing.from_tcp.hand_y": -0.03,
        "closing.from_tcp.near_hand_y": -0.6,
        "closing.yaw.sin2": math.sin(math.pi / 3),
        "closing.from_tcp.yaw.cos2": math.cos(-2 * math.pi / 3),
        "opening.y": 0.06,
        "opening.from_tcp.y": -0.04,
        "opening.from_tcp.near_y": -4 / 6,
    }
    assert {name: now[name] for name in expected} == pytest.approx(expected, abs=1e-6)
    for frame, command in enumerate(("closing", "opening")):  # the one that comes first
        assert [found.names[k] for k in found.offsets[frame]] == [f"{command}.from_tcp.{axis}" for axis in "xyz"]
    is_about_closing = np.array([name.startswith("closing.") for name in found.names])
    np.testing.assert_array_equal(
        np.isnan(found.values), [0 * is_about_closing, is_about_closing, is_about_closing >= 0]
    )
