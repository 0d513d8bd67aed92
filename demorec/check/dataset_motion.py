"""The lag between the actions and the states of a dataset, where its sidecar says what the actions are."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from demorec.check.alignment import nearest_lag, servo_response
from demorec.check.base import Found, Measurement, sidecar_check
from demorec.check.dataset import Dataset
from demorec.core.geometry import Array
from demorec.episode.features import ACTION, STATE


@sidecar_check(
    measures="lag between action and state, off the contract's, frames",
    reads=(
        "action",
        "observation.state",
    ),
)
def dataset_action_lag(dataset: Dataset) -> Iterator[Found]:
    """Action t is what leads from observation t to t + 1, in every episode; catches shifted and made-up actions.

    Poses are compared by position. Exploration noise is in the states and not in the actions: what counts is the
    third of the moving frames in which the two are nearest. Increments are summed up first; where noise was executed,
    it is taken back in them and they cannot be: then their course, smoothed, is compared with that of the changes of
    state, all episodes together, and two frames are allowed.
    """
    wishes, changes = [], []
    for each in dataset.described():
        rows, info = each.rows, each.info
        if (kind := dataset.action_kind(info)) is None:
            continue
        action, state = rows[ACTION].astype(np.float64), rows[STATE].astype(np.float64)
        arm = len(info.robot.arm_joints)
        is_joint = kind in ("joint", "joint_increment")
        if is_joint:
            reached = state[:, :arm]
        elif poses := dataset.tcp_poses(info, rows):
            reached = next(iter(poses.values()))[:, :3]
        else:
            continue
        width = reached.shape[1]
        start = np.array(info.scene.robot.joint_position) if is_joint else reached[0]
        substeps = max(info.physics_hz // dataset.info.fps, 1)
        if kind in ("joint_increment", "ee_delta") and not info.behaviour.get("action_noise", 0.0):
            action = np.concatenate([start + np.cumsum(action[:, :width], axis=0), action[:, -1:]], axis=1)
        elif kind in ("joint_increment", "ee_delta"):
            # The servo is linear: its response to increments is the increments of its response.
            wishes.append(servo_response(action[:, :width], start=np.zeros(width), substeps=substeps)[1:])
            changes.append(np.diff(reached, axis=0))
            continue
        expected = servo_response(action[:, :width], start=start, substeps=substeps)
        if (nearest := nearest_lag(expected, reached, reached, reach=3, fewest=10)) is not None:
            lag, off = nearest
            value, words = (math.inf, "unrelated") if off > 3.0 else (abs(lag), f"{lag:+d} frames")
            yield Measurement(value=value, detail=f"episode {each.number}: {words}")
    if wishes:
        yield _course_lag(wishes, changes)


def _course_lag(wishes: list[Array], changes: list[Array], *, reach: int = 4, window: int = 9) -> Measurement:
    """By how many whole frames changes run behind wishes, by the correlation of their smoothed courses."""
    box = np.ones(window) / window

    def smooth(table: Array) -> Array:
        return np.stack([np.convolve(column, box, mode="same") for column in table.T], axis=1)

    products, sizes = np.zeros(2 * reach + 1), np.zeros(2)
    for wish, change in zip(wishes, changes, strict=True):
        x, y = smooth(wish), smooth(change)
        core = slice(reach, len(x) - reach)
        sizes += (x[core] ** 2).sum(), (y[core] ** 2).sum()
        products += [float((x[core] * np.roll(y, -k, axis=0)[core]).sum()) for k in range(-reach, reach + 1)]
    best = int(np.argmax(products))
    likeness = products[best] / max(math.sqrt(sizes[0] * sizes[1]), 1e-12)
    lag = best - reach
    if likeness < 0.5:
        return Measurement(value=math.inf, detail=f"actions and changes of state are unrelated ({likeness:.2f})")
    return Measurement(value=max(abs(lag) - 2, 0), detail=f"all episodes: {lag:+d} frames, likeness {likeness:.2f}")
