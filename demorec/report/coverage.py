"""The randomised quantities of the scenes, for the histograms of the page."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from demorec.core.geometry import Array
from demorec.episode.info import EpisodeInfo
from demorec.episode.scene import Scene, yaw_of

MIN_VALUES = 10
"""A quantity with fewer distinct values was not drawn from a range."""
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
