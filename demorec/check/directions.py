"""Does an action go, or move a state, the way that the state goes, in all episodes."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from demorec.check.base import Found, Lacking, Measurement, NotMeasured
from demorec.check.dataset import Dataset, Recorded
from demorec.check.evidence import Motion, is_gripper, quaternion_places
from demorec.check.likeness import CARTESIAN, likeness_check, same_joints
from demorec.check.rows import matrices
from demorec.check.targets import NO_TARGETS, target_check
from demorec.core.geometry import Array
from demorec.episode.features import ACTION

_FEWEST_EPISODES, _FEWEST_FRAMES = 3, 30
_AHEAD_S = 0.1
"""Seconds over which it is looked at how far a state goes."""
_CLEAR = 0.6
"""Correlation of action and way, either sign, in the median episode, from which on the action is taken to move it."""
_BESIDE, _AS_LIVELY, _OTHER = 0.1, 0.25, 0.5
"""Share of a joint's range by which its targets may be beyond it; of its variance that theirs has at least; correlation
below which they go another way."""
_WAYS_OF_POSE = 12
"""Elements of the way and turn of an EE pose along two systems of axes."""
_LIVELY, _STILL = 0.25, 0.02
"""Share of the usual deviation from which on an episode is judged, and below which an action is still."""


@target_check(
    measures="joints whose action lies where they are, and goes another way",
    warn=0,
    fail=math.inf,
    group="alignment",
)
def targets_go_along(subject: Recorded) -> Found:
    """Targets go where their joints do: catches those of another episode, or backwards, which are no targets any more.

    Positions and targets of a joint may all be on one side of 0 and in one range: speeds and increments are on both
    sides, and a goal is sent but once.
    """
    motions = subject.motions
    if not motions.moving.any():
        return NotMeasured(why=NO_TARGETS)
    pairs = [(motion.state, motion.action) for motion in motions.all if motion.action is not None]
    wrong = [
        name
        for element, name in enumerate(motions.all[0].names)
        if motions.moving[element] and not motions.targets and not is_gripper(name)
        if _goes_its_own_way([(state[:, element], action[:, element]) for state, action in pairs])
    ]
    return Measurement(value=len(wrong), detail=", ".join(wrong[:3]))


def _goes_its_own_way(pairs: Sequence[tuple[Array, Array]]) -> bool:
    """Whether actions lie where the states of a joint do, in all episodes, and do not go with them."""
    state, action = (np.concatenate(part) for part in zip(*pairs, strict=True))
    margin = _BESIDE * np.ptp(state)
    in_range = state.min() - margin < action.min() and action.max() < state.max() + margin
    if not in_range or not (min(state.min(), action.min()) > 0 or max(state.max(), action.max()) < 0):
        return False
    own, sent = (np.concatenate([each - each.mean() for each in part]) for part in zip(*pairs, strict=True))
    goes, goes_sent, together = (float((one * other).sum()) for one, other in ((own, own), (sent, sent), (own, sent)))
    return goes_sent > _AS_LIVELY * goes and together < _OTHER * math.sqrt(goes * goes_sent)


@likeness_check(
    group="alignment",
    measures="correlation with which an element of the action moves a state one way in some episodes, and the other "
    "way, or while it is still, in others",
    warn=0.45,
    fail=0.6,
)
def actions_agree(dataset: Dataset) -> Iterator[Found]:
    """Increments, deltas of a pose and velocities move the state the same way in all episodes: catches an axis that was
    turned round or left out in some of them, and datasets of two conventions put together.

    An element that is called after a joint is compared with the joint, one called x, y, z, roll, pitch or yaw with the
    EE pose: a delta may be told along the axes of the base or of the tool, and is at odds only if it is with all that
    goes with it in most episodes.
    """
    feature, motions = dataset.info.features.get(ACTION), dataset.motions.all
    if feature is None or not feature.is_numeric:
        yield Lacking(need="actions of three episodes")
        return
    names, ahead = feature.names or (), max(1, round(_AHEAD_S * dataset.info.fps))
    long = [number for number, motion in enumerate(motions) if len(motion.state) >= _FEWEST_FRAMES + ahead]
    has_pose = all(motions[number].ee_pose is not None for number in long)
    candidates = _candidates(names, dict(same_joints(dataset)), has_pose=has_pose)
    if len(long) < _FEWEST_EPISODES or not candidates:
        yield NotMeasured(why=f"no action of {_FEWEST_EPISODES} episodes is called after a joint, or of an EE pose")
        return
    together, acts, goes = (np.stack(table) for table in zip(*_by_episode(dataset, long, ahead), strict=True))
    usual_acts, usual_goes = np.median(acts, axis=0), np.median(goes, axis=0)
    moved = (goes > _LIVELY * usual_goes) & (usual_goes > 0)
    found = []
    for element, ways in candidates.items():
        share = acts[:, element] / max(float(usual_acts[element]), 1e-12)
        lively, still = share > _LIVELY, share < _STILL
        odds = [_at_odds(together[:, element, way], lively & moved[:, way], still & moved[:, way]) for way in ways]
        if told := [one for one in odds if one is not None]:
            value, row = min(told)
            found.append(Measurement(value=value, detail=f"{names[element]}, episode {long[row]}"))
    yield max(found, key=lambda one: one.value, default=NotMeasured(why="the states do not go where the actions tell"))


def _candidates(names: Sequence[str], joints: Mapping[int, int], *, has_pose: bool) -> dict[int, Sequence[int]]:
    """Element of the action -> the ways that it may be told by: its joint's, or all of the EE pose, which are last."""
    turns = {place + part for place in quaternion_places(names) for part in range(4)}
    of_pose = [element for element, name in enumerate(names) if CARTESIAN.search(name) and element not in turns]
    found: dict[int, Sequence[int]] = {element: range(-_WAYS_OF_POSE, 0) for element in of_pose if has_pose}
    return found | {element: (state,) for element, state in joints.items()}


def _at_odds(together: Array, judged: NDArray[np.bool_], still: NDArray[np.bool_]) -> tuple[float, int] | None:
    """How clearly (E,) episodes differ, and which one does most from the majority; None where nothing is told."""
    if judged.sum() < _FEWEST_EPISODES or np.median(np.abs(together[judged])) < _CLEAR:
        return None
    if still.any():
        return float(np.median(np.abs(together[judged]))), int(np.flatnonzero(still)[0])
    signed = np.where(judged, together, 0.0)
    signed = signed if np.median(together[judged]) >= 0 else -signed
    return max(float(min(signed.max(), -signed.min())), 0.0), int(signed.argmin())


def _by_episode(dataset: Dataset, numbers: Sequence[int], ahead: int) -> Iterator[tuple[Array, Array, Array]]:
    """Of each episode (K, N) correlation of actions and ways, and the deviations (K,) and (N,) of both."""
    for number in numbers:
        ways, action = _ways(dataset.motions.all[number], ahead), dataset.rows[number][ACTION]
        action = action.reshape(len(action), -1).astype(np.float64)[: len(ways)]
        action, ways = action - action.mean(axis=0), ways - ways.mean(axis=0)
        acts, goes = (np.sqrt((table**2).mean(axis=0)) for table in (action, ways))
        shared = np.einsum("tk,tn->kn", action, ways) / len(ways)
        yield shared / np.maximum(np.outer(acts, goes), 1e-12), acts, goes


def _ways(motion: Motion, ahead: int) -> Array:
    """(T - ahead, N) how far each state goes; where there is an EE pose, also its way and its turn, rad, along the
    axes of base and tool."""
    ways = [motion.state[ahead:] - motion.state[:-ahead]]
    if motion.ee_pose is not None:
        frames = matrices(motion.ee_pose)
        rotation, way = frames[:-ahead, :3, :3], frames[ahead:, :3, 3] - frames[:-ahead, :3, 3]
        turn = frames[ahead:, :3, :3] @ rotation.transpose(0, 2, 1)
        skew = turn - turn.transpose(0, 2, 1)
        axes = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1) / 2  # of a small angle
        ways += [way, axes, *(np.einsum("tji,tj->ti", rotation, each) for each in (way, axes))]
    return np.concatenate(ways, axis=1)
