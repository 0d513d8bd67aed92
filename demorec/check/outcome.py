"""Is what is said about the episode, its end above all, what its scene and its last frames show."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np

from demorec.check.base import Found, Measurement, NotMeasured, outcome_check
from demorec.check.episode import CheckedEpisode
from demorec.core.geometry import Pose
from demorec.core.tables import TASKS
from demorec.episode.conditions import DISTURBED, LIMITS, OPEN, PLACED
from demorec.episode.episode import gave_up
from demorec.episode.scene import Body, Scene
from demorec.episode.words import COLOR_WORDS

_PLACES = ("target", "mark", "marks", "tray")
"""What the tasks call bodies of the role "target"."""
_LEVER = 0.1
"""Metres at which a tilt counts beside a distance."""
_LAST = 11
"""Frames at the end that show how far what settles moves in one step, by the second largest: a tower of three rocks by
0.001 rad. A single large step is a seam between two recordings."""


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
    """The instruction speaks of colours that are in the scene, and of those of the objects that have a goal.

    In demorec's tasks the first thing that it names is the one that is moved first; only a tower is described from the
    bottom. What it calls a target, mark or tray is one.
    """
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
    if episode.info.task in TASKS.rows:
        wrong += _exchanged(scene, re.findall(r"[a-z]+", instruction.lower()))
    return Measurement(value=len(wrong), detail="; ".join(wrong[:3]) or instruction)


def _exchanged(scene: Scene, words: Sequence[str]) -> Iterator[str]:
    """Colours that the instruction gives to what has another one."""
    followed = [(word, after) for word, after in zip(words, [*words[1:], ""], strict=True) if word in COLOR_WORDS]
    places = {body.color_name for body in scene.bodies if body.role == "target"}
    yield from (f"no {place} is {color}" for color, place in followed if place in _PLACES and color not in places)
    things = [color for color, after in followed if after not in _PLACES]
    first = next((scene.body(goal.object).color_name for goal in scene.goals), "")
    if things and first and "bottom" not in words and things[0] != first:
        yield f"the {things[0]} one is named first, the {first} one is moved first"


@outcome_check(
    measures="conditions that are missing, have another limit, or passed though they do not hold",
)
def conditions_as_known(episode: CheckedEpisode) -> Found:
    """The conditions are those of demorec's tasks, with their limits, and those passed that hold."""
    outcome, scene = episode.outcome, episode.info.scene
    if outcome is None:
        return None
    if episode.info.task not in TASKS.rows:
        return NotMeasured(why="the task is none of demorec's, so its conditions are not known")
    names = [condition.name for condition in outcome.checks]
    wrong = [f"{name} is missing" for name in _expected(scene, names) if name not in names]
    for condition in outcome.checks:
        side, limit = LIMITS.get(condition.name.partition(":")[0], ("", math.nan))
        if condition.name == OPEN:
            limit *= episode.info.robot.gripper.open_width
        if side and not math.isclose(condition.limit, limit, rel_tol=1e-9):
            wrong.append(f"{condition.name} has the limit {condition.limit:g}, not {limit:g}")
        holds = condition.value <= condition.limit if side == "at most" else condition.value >= condition.limit
        if side and condition.passed != holds:
            words = "passed" if condition.passed else "did not pass"
            wrong.append(f"{condition.name} {words} with {condition.value:g}, limit {condition.limit:g}")
    return Measurement(value=len(wrong), detail="; ".join(wrong[:3]) or f"{len(names)} conditions")


def _expected(scene: Scene, names: Sequence[str]) -> Iterator[str]:
    """What a task asks for that places things at goals, and the open hand of every task."""
    yield OPEN
    if not any(name.partition(":")[0] == PLACED[0] for name in names):
        return
    for goal in scene.goals:
        yield from (f"{part}:{goal.object}" if len(scene.goals) > 1 else part for part in PLACED)
    placed = {goal.object for goal in scene.goals}
    yield from (f"{DISTURBED}:{body.name}" for body in scene.movable if body.name not in placed)


@outcome_check(
    measures="what the last frame shows of a condition, against the outcome's value",
    unit="m",
)
def final_state(episode: CheckedEpisode) -> Iterator[Found]:
    """After a success objects and fingers are in the last recorded frame where the outcome says: distances to goals,
    heights, tilts (0.1 m for each rad), what was not to be moved, the opening. The outcome is a step later: what moved
    in the last frames may move by as much once more."""
    outcome, c = episode.outcome, episode.columns
    if outcome is None or not outcome.success or not c.num_frames:
        return
    last = [dict(_shown(episode, row)) for row in range(max(c.num_frames - _LAST, 0), c.num_frames)]
    for condition in outcome.checks:
        if condition.name in last[-1]:
            values = [shown[condition.name] for shown in last]
            steps = sorted(abs(b - a) for a, b in pairwise(values))
            value, step = values[-1], steps[-2] if len(steps) > 1 else 0.0
            metres = _LEVER if condition.name.partition(":")[0] == "tilt" else 1.0
            yield Measurement(
                value=metres * max(abs(value - condition.value) - step, 0.0),
                frame=c.num_frames - 1,
                detail=f"{condition.name}: {value:.4f}, outcome says {condition.value:.4f}",
            )


def _shown(episode: CheckedEpisode, frame: int) -> Iterator[tuple[str, float]]:
    """Conditions as a frame has them."""
    c, scene = episode.columns, episode.info.scene
    rows = {name: poses[frame] for name, poses in c.object_poses.items()}
    last = {name: Pose(position=row[:3], quat_xyzw=row[3:]) for name, row in rows.items()}
    yield OPEN, float(c.gripper_width[frame])
    for goal in scene.goals:
        suffix = f":{goal.object}" if len(scene.goals) > 1 else ""
        pose, body = last[goal.object], scene.body(goal.object)
        onto = last.get(goal.onto, scene.body(goal.onto).world_from_body if goal.onto else Pose())
        wanted = onto @ goal.onto_from_goal
        height = wanted.position[2] + _half_height(body, pose) - _half_height(body, wanted)
        yield f"distance_to_goal{suffix}", goal.distance(onto, pose)
        yield f"height_error{suffix}", abs(float(pose.position[2] - height))
        yield f"tilt{suffix}", math.acos(min(1.0, float(np.abs(pose.rotation[2]).max())))
    for body in scene.movable:
        yield f"{DISTURBED}:{body.name}", math.dist(last[body.name].position[:2], body.world_from_body.position[:2])


def _half_height(body: Body, pose: Pose) -> float:
    """Half the extent of the axis that is nearest to the vertical."""
    return body.shape.extents[int(np.argmax(np.abs(pose.rotation[2])))] / 2


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
