"""Words for objects and attempts, on synthetic scenes and episodes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.recording import make_episode

from demorec.core.geometry import Pose
from demorec.episode.episode import Event
from demorec.episode.scene import Body, RobotPlacement, Scene, Shape
from demorec.extensions.language.referring import phrase_for, phrases_for, resolve, situation
from demorec.extensions.language.statements import episode_statements
from demorec.mcap import EpisodeWriter, Recording


def scene(*cubes: tuple[str, float, float, float], yaw: float = 0.0) -> Scene:
    """Cubes (colour, x, y, side) in front of a robot that is turned by `yaw`."""
    bodies = [
        Body(
            name=f"{color}_cube_{number}", role="object", shape=Shape(kind="box", size=(side,) * 3), mass=0.1,
            world_from_body=Pose.from_yaw((0.0, 0.0, 0.0), yaw) @ Pose(position=np.array([x, y, side / 2])),
            color_name=color,
        )
        for number, (color, x, y, side) in enumerate(cubes)
    ]  # fmt: skip
    return Scene(
        robot=RobotPlacement(
            name="panda", world_from_base=Pose.from_yaw((0.0, 0.0, 0.0), yaw), joint_position=(0.0,) * 7,
            gripper_width=0.08,
        ),
        bodies=tuple(bodies),
    )  # fmt: skip


@pytest.mark.parametrize("yaw", [0.0, 2.1])
@pytest.mark.parametrize(
    ("phrase", "number"),
    [
        ("the blue cube", 2), ("the left red cube", 0), ("the right red cube", 1), ("the rightmost cube", 2),
        ("the leftmost cube", 0), ("the smaller red cube", 1), ("the larger red cube", 0), ("the smallest cube", 1),
        ("the cube nearest to the robot", 0), ("the red cube farthest from the robot", 1), ("the middle cube", 1),
    ],
)  # fmt: skip
def test_phrases_are_resolved_from_the_robots_side(phrase: str, number: int, yaw: float) -> None:
    things = scene(("red", 0.3, 0.2, 0.05), ("red", 0.45, 0.0, 0.03), ("blue", 0.5, -0.2, 0.04), yaw=yaw)
    assert resolve(phrase, situation(things)) == {things.bodies[number].name}


@pytest.mark.parametrize(
    "phrase",
    [
        "the cube", "the red cube", "the left cube", "the smaller cube", "the green cube", "the middle red cube",
        "the larger blue cube", "the red one", "a red cube", "the red cube on the mat", "",
    ],
)  # fmt: skip
def test_an_ambiguous_phrase_refers_to_nothing(phrase: str) -> None:
    things = scene(("red", 0.4, 0.2, 0.05), ("red", 0.5, 0.02, 0.03), ("blue", 0.4, -0.2, 0.04))
    assert resolve(phrase, situation(things)) == frozenset()


def test_a_millimetre_decides_neither_left_nor_larger() -> None:
    things = situation(scene(("red", 0.4, 0.1, 0.05), ("red", 0.6, 0.099, 0.0499)))
    for phrase in ("the left red cube", "the larger red cube"):
        assert resolve(phrase, things) == frozenset()
    assert phrase_for("red_cube_0", things) == "the red cube nearest to the robot"
    twins = situation(scene(("red", 0.4, 0.1, 0.05), ("red", 0.401, 0.101, 0.05)))
    assert list(phrases_for("red_cube_0", twins)) == []
    assert phrase_for("red_cube_0", twins) == "a red cube"


PHASES = ("approach", "descend", "close", "lift", "transport", "lower", "release", "retreat")


def told(folder: Path, script: list[tuple[str, str, str]], **arguments: object) -> list[tuple[int, str, str]]:
    """(frame, kind, text) of an episode of two frames a phase; `script` has (phase, event, its message)."""
    info, frames, outcome = make_episode(num_frames=2 * len(script), cameras=(), **arguments)  # type: ignore[arg-type]
    path = folder / "episode.mcap"
    with EpisodeWriter(path, info) as writer:
        for number, frame in enumerate(frames):
            phase, name, message = script[number // 2]
            events = (Event(name=name, message=message),) if name and number % 2 == 0 else ()
            writer.write(replace(frame, phase=phase, events=events, is_deliberate_miss=False))
        writer.finish(outcome)
    with Recording(path) as recording:
        return [
            (statement.row, statement.kind, statement.text)
            for statement in episode_statements(recording, ("subtask", "plan", "memory"))
        ]


def steps(*phases: str, **events: tuple[str, str]) -> list[tuple[str, str, str]]:
    return [(phase, *events.get(phase, ("", ""))) for phase in phases]


GRASP = ("grasp", "grasp cube at yaw 0.1000 rad")


def test_a_miss_and_a_drop_are_named_and_retried(tmp_path: Path) -> None:
    script = [
        *steps("approach", "descend", "close", "recover", approach=GRASP, recover=("miss", "missed cube")),
        *steps(*PHASES[:5], "recover", approach=GRASP, recover=("drop", "dropped cube")),
        *steps(*PHASES, approach=GRASP),
    ]
    found = told(tmp_path, script)
    starts = [2 * index for index in range(len(script))]
    assert [row for row, kind, _ in found if kind == "subtask"] == starts
    said = {row: text for row, kind, text in found if kind == "subtask"}
    assert said[0] == "move above the red cube"
    assert said[6] == "open the gripper and rise after missing the red cube"
    assert said[8] == "try again: move above the red cube"
    assert said[14] == "lift the red cube"
    assert said[18] == "open the gripper and rise after dropping the red cube"
    assert said[20] == "try again: move above the red cube"
    assert [(row, text.splitlines()[0]) for row, kind, text in found if kind == "plan"] == [
        (0, "1. pick up the red cube"), (8, "1. pick up the red cube again"), (20, "1. pick up the red cube again"),
    ]  # fmt: skip
    assert [(row, text) for row, kind, text in found if kind == "memory"][:3] == [
        (6, "I missed the red cube."), (16, "I picked up the red cube."), (18, "I dropped the red cube."),
    ]  # fmt: skip


def test_phases_of_a_foreign_script_are_used_verbatim(tmp_path: Path) -> None:
    found = told(tmp_path, [("wiggle_about", "", ""), ("", "", ""), ("close", "", "")])
    assert [(row, text) for row, kind, text in found if kind == "subtask"] == [
        (0, "wiggle about"), (2, "pick up the red cube and place it on the green target"), (4, "grasp the red cube"),
    ]  # fmt: skip
