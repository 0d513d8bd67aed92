"""Read language columns and phrases without the code that writes them."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from demorec.core.geometry import Pose
from demorec.episode.scene import Body, Scene
from support.export import data_table

Row = dict[str, Any]


def language_of(dataset: Path) -> list[list[tuple[list[Row], list[Row]]]]:
    """Episode -> frame -> (persistent rows, events)."""
    table = data_table(dataset)
    episodes: list[list[tuple[list[Row], list[Row]]]] = []
    columns = (table.column(name).to_pylist() for name in ("episode_index", "language_persistent", "language_events"))
    for episode, persistent, events in zip(*columns, strict=True):
        if episode == len(episodes):
            episodes.append([])
        episodes[-1].append((persistent, events))
    return episodes


def active(rows: Sequence[Row], style: str, time: float) -> list[Row]:
    """All rows of a style with the latest start at or before a time: one, unless there is an error."""
    begun = [row for row in rows if row["style"] == style and row["timestamp"] <= time]
    latest = max((row["timestamp"] for row in begun), default=-1.0)
    return [row for row in begun if row["timestamp"] == latest]


NOUNS: dict[str, Callable[[Body], bool]] = {
    "cube": lambda body: "cube" in body.name or (body.shape.kind == "box" and len(set(body.shape.size)) == 1),
    "block": lambda body: "block" in body.name,
    "cylinder": lambda body: body.shape.kind == "cylinder",
    "duck": lambda body: body.name == "duck",
    "mug": lambda body: "mug" in body.name,
    **{
        noun: lambda body, noun=noun: body.name.endswith(f"_{noun}")  # type: ignore[misc]
        for noun in (
            "glass",
            "bowl",
            "bottle",
            "can",
            "jar",
            "box",
            "apple",
            "pear",
            "lemon",
            "banana",
            "brick",
            "wedge",
            "corner",
            "tee",
            "cross",
            "arch",
            "hexagon",
            "plate",
        )
    },
    "wooden plank": lambda body: body.name == "jenga",
    "toy brick": lambda body: "lego" in body.name,
    "tray": lambda body: "tray" in body.name,
    "table": lambda body: body.name == "table",
    **dict.fromkeys(
        ("target", "mark", "square"),
        lambda body: body.role == "target" and not body.name.endswith(("tray", "bowl", "plate")),
    ),
}
"""Word -> whether it names a body, from the view of a person."""
_PHRASE = re.compile(
    r"\b(the|every) ((?:(?:left|right|middle|small|large)\w* )?)"
    r"((?:red|green|blue|yellow|orange|purple|white|grey|black) )?"
    rf"({'|'.join(NOUNS)})\b( (?:nearest to|farthest from) the robot)?"
)


def phrases(text: str) -> list[tuple[str, ...]]:
    """(whole, article, order, colour, noun, nearness) of each phrase in a text."""
    return [(match[0], *((part or "").strip() for part in match.groups())) for match in _PHRASE.finditer(text)]


def scene_at(scene: Scene, world_from_object: Mapping[str, Any]) -> Scene:
    """Move the bodies of a scene to other poses (7,): a phrase refers to the moment at which it is used."""
    poses = {name: Pose(position=pose[:3], quat_xyzw=pose[3:]) for name, pose in world_from_object.items()}
    bodies = (replace(body, world_from_body=poses.get(body.name, body.world_from_body)) for body in scene.bodies)
    return replace(scene, bodies=tuple(bodies))


def meant(phrase: tuple[str, ...], scene: Scene) -> list[str]:
    """Names of the bodies that a phrase refers to, by brute force; as a person reads it, without margins."""
    _, article, order, color, noun, nearness = phrase
    fitting = [body for body in scene.bodies if body.role != "fixture" and NOUNS[noun](body)]
    fitting = [body for body in fitting if color in ("", body.color_name)]
    base = scene.robot.world_from_base.inverse()
    where = {body.name: base.apply(body.world_from_body.position) for body in fitting}

    def distance(body: Body) -> float:
        return math.hypot(*where[body.name][:2])

    if article == "the" and order:
        if order == "middle":
            assert len(fitting) == 3
            return [
                min(fitting, key=lambda body: sum(math.dist(where[body.name], other) for other in where.values())).name
            ]
        assert len(fitting) == 2 if order in ("left", "right", "smaller", "larger") else len(fitting) > 2
        keys: dict[str, Callable[[Body], float]] = {
            "l": lambda body: -where[body.name][1],
            "r": lambda body: where[body.name][1],
            "s": lambda body: max(body.shape.extents),
        }
        keys["lar"] = lambda body: -max(body.shape.extents)
        key = keys["lar" if order.startswith("lar") else order[0]]
        fitting = sorted(fitting, key=key)[:1]
    if nearness:
        fitting = sorted(fitting, key=distance, reverse="farthest" in nearness)[:1]
    return [body.name for body in fitting]
