"""Is what is said about the episode, its end above all, what its scene and its last frames show."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator

import numpy as np

from demorec.annotate.situation import COLOR_WORDS
from demorec.check.base import Found, Measurement, NotMeasured, outcome_check
from demorec.check.episode import CheckedEpisode
from demorec.check.rows import matrices
from demorec.episode.episode import gave_up


@outcome_check(
    measures="contradictions within the outcome",
)
def outcome_consistent(episode: CheckedEpisode) -> Measurement | None:
    """An episode succeeds if all its conditions passed; a failure has a phase and a reason."""
    outcome = episode.outcome
    if outcome is None:
        return None
    failed = [condition.name for condition in outcome.checks if not condition.passed]
    wrong = []
    if outcome.success and failed:
        wrong.append(f"success, but {failed[0]} did not pass")
    if outcome.success and (outcome.failure_reason or outcome.failure_phase):
        wrong.append(f"success, but with the failure reason {outcome.failure_reason!r}")
    if not outcome.success and not outcome.failure_reason:
        wrong.append("a failure without a reason")
    elif not outcome.success and not failed and not gave_up(outcome, [e for _, e in episode.events], episode.info):
        wrong.append("a failure, but all conditions passed, and nothing shows that the expert gave up")
    if outcome.failure_reason in {condition.name for condition in outcome.checks if condition.passed}:
        wrong.append(f"failed by {outcome.failure_reason}, which passed")
    if outcome.num_frames != episode.num_frames:
        wrong.append(f"{outcome.num_frames} frames said, {episode.num_frames} recorded")
    if not outcome.checks:
        wrong.append("no conditions")
    if len({condition.name for condition in outcome.checks}) != len(outcome.checks):
        wrong.append("a condition twice")
    return Measurement(value=len(wrong), detail="; ".join(wrong) or f"{len(outcome.checks)} conditions")


@outcome_check(
    measures="colours that the instruction names and the scene lacks, or the other way round",
)
def instruction_fits_scene(episode: CheckedEpisode) -> Found:
    """The instruction speaks of colours that are in the scene, and of those of the objects that have a goal."""
    scene, instruction = episode.info.scene, episode.info.instruction
    if not instruction.strip():
        return Measurement(value=1, detail="there is no instruction")
    words = [word for word in re.findall(r"[a-z]+", instruction.lower()) if word in COLOR_WORDS]
    if not words:
        return NotMeasured(why="the instruction names no colour")
    known = {body.color_name for body in scene.bodies if body.color_name}
    goals = dict.fromkeys(name for goal in scene.goals if (name := scene.body(goal.object).color_name))
    wrong = [f"nothing is {word}" for word in dict.fromkeys(words) if word not in known]
    wrong += [f"{color} is not named" for color in goals if color not in words]
    return Measurement(value=len(wrong), detail="; ".join(wrong[:3]) or instruction)


@outcome_check(
    measures="goal distance in the last frame against the outcome's",
    unit="m",
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
)
def at_rest_in_the_end(episode: CheckedEpisode) -> Iterator[Found]:
    """After a success the objects lie still: the recording does not stop in mid-motion."""
    outcome, c = episode.outcome, episode.columns
    if outcome is None or not outcome.success or c.num_frames < 3:
        return
    for name in dict.fromkeys(goal.object for goal in episode.info.scene.goals):
        step = float(np.linalg.norm(np.diff(c.object_poses[name][-2:, :3], axis=0))) * episode.info.fps
        yield Measurement(value=step, frame=c.num_frames - 1, detail=name)
