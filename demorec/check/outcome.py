"""Is what is said about the episode's end what its last frames show."""

from __future__ import annotations

import math

import numpy as np

from demorec.check.base import Measurement, check, worst
from demorec.check.episode import RecordedEpisode
from demorec.check.rows import matrices


@check(group="outcome", measures="contradictions within the outcome", warn=0)
def outcome_consistent(episode: RecordedEpisode) -> Measurement | None:
    """Success means that every condition passed; a failure has a phase and a reason; the length is that recorded."""
    outcome = episode.recording.outcome
    if outcome is None:
        return None
    failed = [condition.name for condition in outcome.checks if not condition.passed]
    wrong = []
    if outcome.success and failed:
        wrong.append(f"success, but {failed[0]} did not pass")
    if outcome.success and outcome.failure_reason:
        wrong.append(f"success, but with the failure reason {outcome.failure_reason!r}")
    if not outcome.success and not outcome.failure_reason:
        wrong.append("a failure without a reason")
    if outcome.num_frames != episode.num_frames:
        wrong.append(f"{outcome.num_frames} frames said, {episode.num_frames} recorded")
    if not outcome.checks:
        wrong.append("no conditions")
    return Measurement(value=len(wrong), detail="; ".join(wrong) or f"{len(outcome.checks)} conditions")


@check(
    group="outcome", measures="goal distance in the last frame against the outcome's", unit="m", warn=0.01, fail=0.02
)
def final_state(episode: RecordedEpisode) -> Measurement | None:
    """An object that is said to lie at its goal lies there in the last recorded frame."""
    outcome, scene, c = episode.recording.outcome, episode.info.scene, episode.columns
    if outcome is None or not outcome.success or not scene.goals or not c.num_frames:
        return None
    said = {condition.name: condition for condition in outcome.checks}
    found = []
    for goal in scene.goals:
        name = "distance_to_goal" if len(scene.goals) == 1 else f"distance_to_goal:{goal.object}"
        condition = said.get(name)
        if condition is None:
            continue
        wanted = goal.onto_from_goal.matrix()
        if goal.onto:
            poses = c.object_poses.get(goal.onto)
            onto = scene.body(goal.onto).world_from_body.matrix() if poses is None else matrices(poses[-1:])[0]
            wanted = onto @ wanted
        distance = math.dist(c.object_poses[goal.object][-1, :2], wanted[:2, 3])
        value = abs(distance - condition.value)
        detail = f"{goal.object}: {distance * 1e3:.1f} mm, outcome says {condition.value * 1e3:.1f} mm"
        found.append(Measurement(value=value, frame=c.num_frames - 1, detail=detail))
    return worst(*found)


@check(group="outcome", measures="speed of the goals' objects at the end", unit="m/s", warn=0.03, fail=0.06)
def at_rest_in_the_end(episode: RecordedEpisode) -> Measurement | None:
    """After a success the objects lie still: the recording does not stop in mid-motion."""
    outcome, c = episode.recording.outcome, episode.columns
    if outcome is None or not outcome.success or c.num_frames < 3:
        return None
    found = []
    for name in dict.fromkeys(goal.object for goal in episode.info.scene.goals):
        step = float(np.linalg.norm(np.diff(c.object_poses[name][-2:, :3], axis=0))) * episode.info.fps
        found.append(Measurement(value=step, frame=c.num_frames - 1, detail=name))
    return worst(*found)
