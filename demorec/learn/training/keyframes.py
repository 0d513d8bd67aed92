"""What an encoder of images learns to tell before the policy is trained: where the hand will be at its next keyframes.

A keyframe is a moment at which the gripper is told to close or to open (James and Davison, "Q-attention", 2021; PerAct,
Shridhar et al., 2022). Keyframes are read off the robot's own poses and commands, so that nothing is needed that a real
recording does not have, poses of objects least of all; yet the first of them is where the object is, and the second
where it has to go.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from demorec.episode.features import near_field

NUM_KEYFRAMES = 2

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class KeyframeTargets:
    """What an encoder of images learns to tell of each frame.

    Attributes:
        values: (N, K) metres, and sines and cosines of angles.
        names: Of the components.
        is_ahead: (N,) whether the gripper is still to be told something; nothing is learned from the other frames.
        offsets: Places of the offset from the TCP to the next keyframe, base frame, x, y, z.
    """

    values: NDArray[np.float32]
    names: tuple[str, ...]
    is_ahead: NDArray[np.bool_]
    offsets: tuple[int, int, int]


def find_keyframes(opening: NDArray[np.floating], episode: NDArray[np.integer]) -> NDArray[np.int64]:
    """The next frames at which the gripper is told to close or to open.

    Args:
        opening: (N,) commanded opening, in any unit. It is open above the middle of all that is commanded.
        episode: (N,) number of each frame's episode; its frames follow one another.

    Returns:
        (N, 2) indices of the next one and of the one after it; the episode's last frame where there is none.
    """
    is_open = opening > (opening.min() + opening.max()) / 2
    frames = np.arange(len(episode))
    changes = np.flatnonzero((np.diff(is_open) != 0) & (np.diff(episode) == 0)) + 1
    ends = np.append(np.flatnonzero(np.diff(episode)), len(episode) - 1)
    last = ends[np.searchsorted(ends, frames)]
    found = np.empty((len(episode), NUM_KEYFRAMES), np.int64)
    place = np.searchsorted(changes, frames, side="right")
    for k in range(NUM_KEYFRAMES):
        candidate = np.append(changes, len(episode))[np.minimum(place + k, len(changes))]
        found[:, k] = np.minimum(candidate, last)
    return found


def keyframe_targets(
    position: NDArray[np.floating],
    quat_xyzw: NDArray[np.floating],
    episode: NDArray[np.integer],
    keyframes: NDArray[np.int64],
) -> KeyframeTargets:
    """The hand's poses at its next keyframes, as they are and as seen from where it is now.

    Args:
        position: (N, 3) of the TCP, metres, base frame.
        quat_xyzw: (N, 4) of the TCP, base frame.
        episode, keyframes: As of `find_keyframes`.
    """
    xyz = position.astype(np.float64)
    yaw = _yaw(quat_xyzw.astype(np.float64))
    columns: dict[str, Array] = {}
    for k in range(NUM_KEYFRAMES):
        then = keyframes[:, k]
        offset = xyz[then] - xyz
        x_in_hand = np.cos(yaw) * offset[:, 0] + np.sin(yaw) * offset[:, 1]
        y_in_hand = np.cos(yaw) * offset[:, 1] - np.sin(yaw) * offset[:, 0]
        for axis, name in enumerate("xyz"):
            columns[f"keyframe_{k}.{name}"] = xyz[then, axis]
            columns[f"keyframe_{k}.from_tcp.{name}"] = offset[:, axis]
            columns[f"keyframe_{k}.from_tcp.near_{name}"] = near_field(offset[:, axis])
        for name, in_hand in (("x", x_in_hand), ("y", y_in_hand)):
            columns[f"keyframe_{k}.from_tcp.hand_{name}"] = in_hand
            columns[f"keyframe_{k}.from_tcp.near_hand_{name}"] = near_field(in_hand)
        for name, angle in (("yaw", yaw[then]), ("from_tcp.yaw", yaw[then] - yaw)):
            columns[f"keyframe_{k}.{name}.sin2"] = np.sin(2 * angle)  # two fingers: half a turn is the same
            columns[f"keyframe_{k}.{name}.cos2"] = np.cos(2 * angle)
    between = xyz[keyframes[:, 1]] - xyz[keyframes[:, 0]]
    for axis, name in enumerate("xyz"):
        columns[f"keyframe_1.from_keyframe_0.{name}"] = between[:, axis]
        columns[f"keyframe_1.from_keyframe_0.near_{name}"] = near_field(between[:, axis])
    names = tuple(columns)
    x, y, z = (names.index(f"keyframe_0.from_tcp.{name}") for name in "xyz")
    return KeyframeTargets(
        values=np.stack(list(columns.values()), axis=1).astype(np.float32),
        names=names,
        is_ahead=np.append(np.diff(episode) == 0, False)[keyframes[:, 0]],
        offsets=(x, y, z),
    )


def _yaw(quat_xyzw: Array) -> Array:
    """(N,) angle about the base's z of the x axes of frames, radians."""
    x, y, z, w = quat_xyzw.T
    return np.asarray(np.arctan2(2 * (x * y + z * w), 1 - 2 * (y * y + z * z)))
