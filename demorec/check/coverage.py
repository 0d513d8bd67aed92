"""Is every episode there once, and how well do they cover what was randomised."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np

from demorec.check.base import Found, Measurement, worst
from demorec.core.geometry import Array
from demorec.episode.info import EpisodeInfo
from demorec.episode.scene import Scene, yaw_of

MIN_EPISODES = 50
"""With fewer, gaps are chance: the largest of 80 good runs of 50 is 0.26 of a range, of runs of 30 it is 0.38."""
MIN_VALUES = 10
"""A quantity with fewer distinct values was not drawn from a range."""
_MAX_SHARE = 1 / 8
"""A value that more of the episodes share was chosen and not drawn."""
TWIN_DISTANCE = 1e-4
_PIECE, _WAY = 8, 0.25
"""Rows in their order, at least, and how far they go, in deviations, from which on they are a piece of a motion."""
_UNITS = {"x": "m", "y": "m", "size": "m", "mass": "kg", "yaw": "rad"}
"""Last word of a quantity's name -> its unit."""


def randomised(infos: Sequence[EpisodeInfo]) -> dict[str, Array]:
    """Name -> one value per episode: start places, yaws, sizes and masses of objects, places of goals.

    A goal on a body has two places: that of the body, and its own in the body's frame. Quantities that not all
    episodes have, or that take only a few values, are left out. Lengths in metres, yaws in rad within the body's
    symmetry.
    """
    return drawn_columns([_values(info.scene) for info in infos])


def drawn_columns(rows: Sequence[Mapping[str, float]]) -> dict[str, Array]:
    """Name -> its value in each row, of those that all rows have and that take more than a few values."""
    if not rows:
        return {}
    names = [name for name in rows[0] if all(name in row for row in rows)]
    columns = {name: np.array([row[name] for row in rows]) for name in names}
    return {name: values for name, values in columns.items() if len(np.unique(values)) >= MIN_VALUES}


def with_unit(name: str) -> str:
    """The name of a quantity of `randomised` for people, with its unit."""
    unit = _UNITS.get(name.rpartition(" ")[2])
    return f"{name} ({unit})" if unit else name


def _values(scene: Scene) -> dict[str, float]:
    values: dict[str, float] = {}
    for number, goal in enumerate(scene.goals):
        body = scene.body(goal.object)
        label = "object" if len(scene.goals) == 1 else f"object {number + 1}"
        position = body.world_from_body.position
        values[f"{label} x"], values[f"{label} y"] = float(position[0]), float(position[1])
        if body.yaw_symmetry > 0:
            values[f"{label} yaw"] = yaw_of(body.world_from_body) % (2 * math.pi / body.yaw_symmetry)
        if body.shape.kind != "mesh":  # one of a shelf has no ranges: a banana is longer than all else
            values[f"{label} size"] = max(body.shape.extents)
            if body.mass > 0:
                values[f"{label} mass"] = body.mass
        goal_label = "goal" if len(scene.goals) == 1 else f"goal {number + 1}"
        # On a body, apart from where that body is: which of two trays it is, is a choice and not a range with a gap.
        if goal.onto:
            place = scene.body(goal.onto).world_from_body.position
            values[f"{goal_label}'s support x"], values[f"{goal_label}'s support y"] = float(place[0]), float(place[1])
            goal_label += " on it"
        position = goal.onto_from_goal.position
        values[f"{goal_label} x"], values[f"{goal_label} y"] = float(position[0]), float(position[1])
    return values


def worst_gap(infos: Sequence[EpisodeInfo]) -> Found:
    """The largest gap over all tasks."""
    by_task: dict[str, list[EpisodeInfo]] = {}
    for info in infos:
        by_task.setdefault(info.task, []).append(info)
    return worst(*map(largest_gap, by_task.values()))


def largest_gap(infos: Sequence[EpisodeInfo]) -> Measurement | None:
    """The largest stretch of any randomised quantity in which no episode lies, as a share of its range."""
    if len(infos) < MIN_EPISODES:
        return None
    columns = randomised(infos)
    if not columns:
        return Measurement(value=1.0, detail="no start place, yaw or size differs between the episodes")
    drawn = {name: _drawn(values) for name, values in columns.items()}
    judged = {name: values for name, values in drawn.items() if len(values) >= MIN_EPISODES} or columns
    gaps = {name: float(np.diff(np.sort(values)).max() / np.ptp(values)) for name, values in judged.items()}
    name = max(gaps, key=lambda key: gaps[key])
    return Measurement(value=gaps[name], detail=f"{name}, {len(infos)} episodes, {len(judged)} quantities")


def _drawn(values: Array) -> Array:
    """Those that come from a range: not one of a few that very many episodes share (a slot in a tray)."""
    unique, counts = np.unique(values, return_counts=True)
    return values[~np.isin(values, unique[counts > _MAX_SHARE * len(values)])]


def start_vector(scene: Scene) -> Array:
    """All that is random about a start, in one row: poses and sizes of the bodies, joints; for finding twins."""
    parts: list[Array] = [np.array(scene.robot.joint_position)]
    for body in scene.bodies:
        if body.role in ("object", "target", "distractor"):
            parts += [body.world_from_body.vector(), np.array(body.shape.extents)]
    return np.concatenate(parts)


def twins(rows: Sequence[Array], names: Sequence[str], what: str) -> Measurement:
    """How many rows are within 1e-4 (root mean square) of an earlier one, and the first such pair; `what` they are."""
    from scipy.spatial import cKDTree

    count, first = 0, ""
    by_length: dict[int, list[int]] = {}
    for index, row in enumerate(rows):
        if np.isfinite(row).all():
            by_length.setdefault(len(row), []).append(index)
    for length, group in by_length.items():
        table = np.array([rows[index] for index in group])
        tree, reach = cKDTree(table), TWIN_DISTANCE * math.sqrt(length)
        for later, point in enumerate(table):
            if (earlier := min(tree.query_ball_point(point, reach))) < later:
                count += 1
                first = first or f"{names[group[later]]} is like {names[group[earlier]]}"
    return Measurement(value=count, detail=first or f"{len(rows)} different {what}")


def pieces(tables: Callable[[], Iterable[Array]], names: Sequence[str]) -> Measurement:
    """How many tables (T, D) hold a piece of another one, or of themselves, bit for bit; and the first such pair.

    A start that two have in common is none, unless it is half of one. They are read twice, as all together may not fit
    into memory; of each row a hash is kept.
    """
    spread = np.sqrt(np.mean([table.var(axis=0) for table in tables()], axis=0))
    spread = np.where(spread > 0, spread, np.inf)
    first, found = dict[int, tuple[int, int]](), []
    for number, table in enumerate(tables()):
        begin, before = 0, (-1, -1)
        for row, data in enumerate(np.ascontiguousarray(table)):
            place = first.setdefault(hash(data.tobytes()), (number, row))
            if place == (number, row):  # seen for the first time
                before = (-1, -1)
                continue
            if place != (before[0], before[1] + 1):
                begin = row
            before, length = place, row - begin + 1
            if length < _PIECE or (place[1] == row and 2 * length < len(table)):
                continue
            if (np.abs(data - table[begin]) / spread).max() > _WAY:
                found.append(
                    f"from row {begin} on {names[number]} is {names[place[0]]} from row {place[1] - length + 1}"
                )
                break
    return Measurement(value=len(found), detail=found[0] if found else "")


def motion_vector(joint_position: Array) -> Array:
    """A motion as one row of fixed length: joint positions at 32 moments, evenly spread."""
    if not len(joint_position):
        return np.zeros(32)
    moments = np.linspace(0, len(joint_position) - 1, 32).round().astype(int)
    return np.asarray(joint_position[moments], dtype=np.float64).reshape(-1)
