"""Targets of the image encoder's pretraining: the hand's poses at its next keyframes.

A keyframe is a moment at which the gripper is commanded to close or to open (James and Davison, "Q-attention", 2021;
PerAct, Shridhar et al., 2022). Keyframes follow from the robot's own poses and commands, which real recordings have,
unlike object poses; yet the next closing is at the object, and the next opening at its target. Each is constant until
it has passed, which is easy to learn.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

COMMANDS = ("closing", "opening")
NEAR_FIELD_M = 0.02
"""Offset at which a near-field component is 0.5. A centimetre decides whether a grasp succeeds, but is a twentieth of a
standard deviation of the plain offset, which a network learns last."""

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class KeyframeTargets:
    """Targets of the image encoder for each frame.

    Attributes:
        values: (N, K) metres, and sines and cosines of angles; NaN where no such keyframe is ahead.
        names: Names of the components.
        offsets: (N, 3) indices of the components that hold the offset from the TCP to the earlier keyframe (x, y, z in
            the base frame).
    """

    values: NDArray[np.float32]
    names: tuple[str, ...]
    offsets: NDArray[np.int64]


def find_keyframes(opening: NDArray[np.floating], episode: NDArray[np.integer]) -> NDArray[np.int64]:
    """Find the next frames at which the gripper is commanded to close, and to open.

    Args:
        opening: (N,) commanded opening, in any unit. Open is above the middle of its range.
        episode: (N,) number of each frame's episode; the frames of an episode are contiguous.

    Returns:
        (N, 2) indices of the next closing and of the next opening; -1 if the episode has none ahead.
    """
    is_open = opening > (opening.min() + opening.max()) / 2
    changes = np.flatnonzero((np.diff(is_open) != 0) & (np.diff(episode) == 0)) + 1
    found = np.empty((len(episode), len(COMMANDS)), np.int64)
    for k, each in enumerate((changes[~is_open[changes]], changes[is_open[changes]])):
        following = np.append(each, -1)[np.searchsorted(each, np.arange(len(episode)), side="right")]
        found[:, k] = np.where(episode[following] == episode, following, -1)
    return found


def keyframe_targets(
    position: NDArray[np.floating], quat_xyzw: NDArray[np.floating], keyframes: NDArray[np.int64]
) -> KeyframeTargets:
    """Compute the hand's poses at its next keyframes, absolute and relative to its current pose.

    Args:
        position: (N, 3) position of the TCP, metres, base frame.
        quat_xyzw: (N, 4) orientation of the TCP, base frame.
        keyframes: Result of `find_keyframes`.
    """
    xyz = position.astype(np.float64)
    yaw = _yaw(quat_xyzw.astype(np.float64))
    columns: dict[str, Array] = {}
    for command, then in zip(COMMANDS, keyframes.T, strict=True):
        is_ahead = then >= 0
        place, turn = np.where(is_ahead[:, None], xyz[then], np.nan), np.where(is_ahead, yaw[then], np.nan)
        offset = place - xyz
        for axis, name in enumerate("xyz"):
            columns[f"{command}.{name}"] = place[:, axis]
            columns[f"{command}.from_tcp.{name}"] = offset[:, axis]
            columns[f"{command}.from_tcp.near_{name}"] = _near_field(offset[:, axis])
        x_in_hand = np.cos(yaw) * offset[:, 0] + np.sin(yaw) * offset[:, 1]
        y_in_hand = np.cos(yaw) * offset[:, 1] - np.sin(yaw) * offset[:, 0]
        for name, in_hand in (("x", x_in_hand), ("y", y_in_hand)):
            columns[f"{command}.from_tcp.hand_{name}"] = in_hand
            columns[f"{command}.from_tcp.near_hand_{name}"] = _near_field(in_hand)
        for name, angle in (("yaw", turn), ("from_tcp.yaw", turn - yaw)):
            columns[f"{command}.{name}.sin2"] = np.sin(2 * angle)  # two fingers: half a turn is the same
            columns[f"{command}.{name}.cos2"] = np.cos(2 * angle)
    names = tuple(columns)
    first = np.where(keyframes < 0, len(keyframes), keyframes).argmin(1)
    offsets = np.array([[names.index(f"{command}.from_tcp.{name}") for name in "xyz"] for command in COMMANDS])
    return KeyframeTargets(
        values=np.stack(list(columns.values()), axis=1).astype(np.float32), names=names, offsets=offsets[first]
    )


def _yaw(quat_xyzw: Array) -> Array:
    """Angle (N,) of the frames' x axes about the base's z axis, radians."""
    x, y, z, w = quat_xyzw.T
    return np.asarray(np.arctan2(2 * (x * y + z * w), 1 - 2 * (y * y + z * z)))


def _near_field(offset: Array) -> Array:
    """Near-field components d / (|d| + NEAR_FIELD_M) of offsets d in metres: in -1..1, and steep around 0."""
    return np.asarray(offset / (np.abs(offset) + NEAR_FIELD_M), dtype=np.float64)
