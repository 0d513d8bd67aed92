"""Is what is said about the episode's end what its last frames show."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from demorec.check.base import Found, Measurement, outcome_check
from demorec.check.episode import CheckedEpisode
from demorec.check.rows import matrices
from demorec.core.tables import TASKS
from demorec.episode.episode import SuccessCheck

AT_LEAST = ("on_support", "on_table", "gripper_width")
"""Conditions of demorec's own tasks that hold from their limit up; all others hold up to it."""


@outcome_check(
    measures="contradictions within the outcome",
    reads=(
        "outcome.success",
        "outcome.checks.name",
        "outcome.checks.value",
        "outcome.checks.limit",
        "outcome.checks.passed",
        "outcome.failure_phase",
        "outcome.failure_reason",
        "outcome.num_frames",
    ),
)
def outcome_consistent(episode: CheckedEpisode) -> Measurement | None:
    """Each condition passed as value and limit have it, success as the conditions; a failure has phase and reason."""
    outcome = episode.outcome
    if outcome is None:
        return None
    failed = [condition.name for condition in outcome.checks if not condition.passed]
    wrong = []
    for condition in outcome.checks:
        if condition.passed not in _possible(episode, condition):
            wrong.append(f"{condition.name} is {condition.value:.4g}, limit {condition.limit:.4g}: {condition.passed}?")
    if outcome.success and failed:
        wrong.append(f"success, but {failed[0]} did not pass")
    if outcome.success and (outcome.failure_reason or outcome.failure_phase):
        wrong.append(f"success, but with the failure reason {outcome.failure_reason!r}")
    if not outcome.success and not outcome.failure_reason:
        wrong.append("a failure without a reason")
    if outcome.failure_reason in {condition.name for condition in outcome.checks if condition.passed}:
        wrong.append(f"failed by {outcome.failure_reason}, which passed")
    if outcome.num_frames != episode.num_frames:
        wrong.append(f"{outcome.num_frames} frames said, {episode.num_frames} recorded")
    if not outcome.checks:
        wrong.append("no conditions")
    if len({condition.name for condition in outcome.checks}) != len(outcome.checks):
        wrong.append("a condition twice")
    return Measurement(value=len(wrong), detail="; ".join(wrong) or f"{len(outcome.checks)} conditions")


def _possible(episode: CheckedEpisode, condition: SuccessCheck) -> set[bool]:
    """What `passed` can be, given value and limit; a task of somebody else's may mean either side of the limit."""
    at_most, at_least = condition.value <= condition.limit, condition.value >= condition.limit
    if episode.info.task not in TASKS.rows:
        return {at_most, at_least}
    return {at_least if condition.name.partition(":")[0] in AT_LEAST else at_most}


@outcome_check(
    measures="values of the outcome against the last frame, in units of their limits",
    reads=(
        "outcome.checks.name",
        "outcome.checks.value",
        "outcome.checks.limit",
        "/object/{body}/pose",
        "/gripper",
        "info.scene.goals.object",
    ),
)
def end_values(episode: CheckedEpisode) -> Iterator[Found]:
    """Height, tilt and opening that the outcome names are those of the last frame, in which all is at rest."""
    outcome, scene, c = episode.outcome, episode.info.scene, episode.columns
    if outcome is None or not outcome.success or not c.num_frames:
        return
    frame = c.num_frames - 1
    for condition in outcome.checks:
        name, _, body = condition.name.partition(":")
        body = body or (scene.goals[0].object if len(scene.goals) == 1 else "")
        value = None
        if name == "gripper_width":
            value = float(c.gripper_width[frame])
        elif body in c.object_poses and name in ("tilt", "disturbed"):
            pose = matrices(c.object_poses[body][-1:])[0]
            upright = min(1.0, float(np.abs(pose[2, :3]).max()))
            start = scene.body(body).world_from_body.position
            value = math.acos(upright) if name == "tilt" else math.dist(pose[:2, 3], start[:2])
        if value is not None and condition.limit > 0:
            detail = f"{condition.name}: {value:.4g}, outcome says {condition.value:.4g}"
            off = abs(value - condition.value) / condition.limit
            yield Measurement(value=off, frame=frame, detail=detail)


@outcome_check(
    measures="goal distance in the last frame against the outcome's",
    unit="m",
    reads=(
        "/object/{body}/pose",
        "outcome.checks.value",
        "info.scene.goals.onto",
        "info.scene.goals.onto_from_goal",
    ),
)
def final_state(episode: CheckedEpisode) -> Iterator[Found]:
    """An object that is said to lie at its goal lies there in the last recorded frame."""
    outcome, scene, c = episode.outcome, episode.info.scene, episode.columns
    if outcome is None or not outcome.success or not scene.goals or not c.num_frames:
        return
    said = {condition.name: condition for condition in outcome.checks}
    for goal in scene.goals:
        name = "distance_to_goal" if len(scene.goals) == 1 else f"distance_to_goal:{goal.object}"
        if (condition := said.get(name)) is None:
            continue
        wanted = goal.onto_from_goal.matrix()
        if goal.onto:
            poses = c.object_poses.get(goal.onto)
            onto = scene.body(goal.onto).world_from_body.matrix() if poses is None else matrices(poses[-1:])[0]
            wanted = onto @ wanted
        distance = math.dist(c.object_poses[goal.object][-1, :2], wanted[:2, 3])
        value = abs(distance - condition.value)
        detail = f"{goal.object}: {distance * 1e3:.1f} mm, outcome says {condition.value * 1e3:.1f} mm"
        yield Measurement(value=value, frame=c.num_frames - 1, detail=detail)


@outcome_check(
    measures="speed of the goals' objects at the end",
    unit="m/s",
    reads=(
        "/object/{body}/pose",
        "info.scene.goals.object",
    ),
)
def at_rest_in_the_end(episode: CheckedEpisode) -> Iterator[Found]:
    """After a success the objects lie still: the recording does not stop in mid-motion."""
    outcome, c = episode.outcome, episode.columns
    if outcome is None or not outcome.success or c.num_frames < 3:
        return
    for name in dict.fromkeys(goal.object for goal in episode.info.scene.goals):
        step = float(np.linalg.norm(np.diff(c.object_poses[name][-2:, :3], axis=0))) * episode.info.fps
        yield Measurement(value=step, frame=c.num_frames - 1, detail=name)
