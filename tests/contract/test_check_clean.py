"""Clean data of every task passes every check without a warning, and the command says so."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.check import Spoilt, checked, level_of, simulate
from support.commands import exit_code
from support.tasks import QUICK_TASKS

from demorec.core.config import VideoConfig
from demorec.core.tables import ROBOTS, TASKS
from demorec.mcap import Recording

SLOW = [pytest.mark.slow]
FILMED = ("unstack", "pick_anything", "tutorial")
"""One of cubes, one of meshes, one whose cube is held by a constraint; the others are more of the same."""


@pytest.mark.parametrize(
    ("task", "cameras"),
    [
        *((task, ()) for task in QUICK_TASKS),
        *(
            pytest.param(task, ("front", "wrist"), marks=SLOW if task in FILMED else [*SLOW, pytest.mark.long])
            for task in TASKS.names()
        ),
    ],
)
def test_every_task(task: str, cameras: tuple[str, ...], tmp_path: Path) -> None:
    path = simulate(tmp_path / "e.mcap", task=task, seed=22, cameras=cameras, width=128, height=128)
    assert [r for r in checked(path).results if r.level in ("warn", "fail")] == []


@pytest.mark.parametrize("robot", ROBOTS.names())
@pytest.mark.parametrize("variation", ["none", "full"])
def test_every_robot_and_variation(robot: str, variation: str, tmp_path: Path) -> None:
    report = checked(simulate(tmp_path / "e.mcap", robot=robot, variation=variation, seed=23))
    assert [r for r in report.results if r.level in ("warn", "fail")] == []


@pytest.mark.parametrize(
    "config",
    [
        {"task": "pick_from_clutter", "robot": "iiwa", "fps": 60, "seed": 2026, "episode_index": 3},
        {"task": "stack", "fps": 15, "seed": 3603},
        {"task": "line_up", "fps": 60, "seed": 4100},
        *(
            pytest.param(config, marks=[pytest.mark.slow, pytest.mark.long])
            for config in (
                {"task": "line_up", "robot": "iiwa", "variation": "full", "fps": 10, "seed": 4100, "episode_index": 9},
                {"task": "line_up", "robot": "so101", "variation": "none", "fps": 60, "seed": 4100, "episode_index": 9},
                {"task": "stack", "robot": "iiwa", "variation": "full", "fps": 15, "seed": 3602},
                {"task": "pick_anything", "variation": "full", "fps": 60, "seed": 61000},
                {
                    "task": "sort_by_color",
                    "robot": "iiwa",
                    "variation": "full",
                    "fps": 60,
                    "seed": 92000,
                    "episode_index": 4,
                },
                {"task": "place_in_tray", "variation": "full", "fps": 60, "seed": 92000, "episode_index": 19},
                {"task": "tutorial", "variation": "mild", "fps": 48, "seed": 92000, "episode_index": 44},
                {"task": "tutorial", "variation": "full", "fps": 30, "seed": 100000, "episode_index": 16},
                {"task": "pick_shapes", "variation": "full", "fps": 20, "seed": 98000, "episode_index": 60},
                {
                    "task": "stack_three",
                    "robot": "so101",
                    "variation": "mild",
                    "fps": 10,
                    "seed": 594510,
                    "episode_index": 8,
                },
            )
        ),
    ],
    ids=str,
)
def test_an_arm_that_noise_shakes(config: dict[str, Any], tmp_path: Path) -> None:
    """Differences between frames say little of forces then, turned hands press askew, things slip, meshes twitch."""
    path = simulate(tmp_path / "e.mcap", **config)
    assert [r for r in checked(path).results if r.level in ("warn", "fail")] == []


def test_a_palm_that_presses_on_a_neighbour(tmp_path: Path) -> None:
    """A large cube moves by a millimetre that no finger touches."""
    path = simulate(tmp_path / "e.mcap", task="stack", variation="none", fps=20, seed=92000, episode_index=4)
    with Recording(path) as recording:
        numbers = recording.columns()
    lowered = int(np.flatnonzero(numbers.contact_force)[0])
    assert np.ptp(numbers.object_poses["blue_cube"][:lowered, 1]) > 0.001
    assert [r for r in checked(path).results if r.level in ("warn", "fail")] == []


def test_fingers_that_push_a_mesh_aside_as_they_shut(tmp_path: Path) -> None:
    """It moves by 2 mm between two frames in which no finger touches it; earlier, that is a fault."""
    path = simulate(tmp_path / "e.mcap", task="pick_anything", variation="full", fps=10, seed=98000, episode_index=4)
    spoilt = Spoilt(path)
    force, poses = spoilt.columns.contact_force, spoilt.columns.object_poses["purple_cross"]
    step = int(np.flatnonzero(np.abs(np.diff(poses[:, 1])) > 0.001)[0])
    assert not force[step - 1 : step + 3].any()
    assert [r for r in checked(path).results if r.level in ("warn", "fail")] == []
    spoilt.pose_of("purple_cross", np.where(np.arange(len(poses))[:, None] < step - 3, poses, poses[[step + 1]]))
    assert level_of(spoilt.write(tmp_path / "early.mcap"), "object_motion") != "pass"


def test_an_attempt_that_ended_at_once(tmp_path: Path) -> None:
    """What is out of reach ends it with its first frame, and one image may be 5 of 255 darker than what was drawn."""
    config: dict[str, Any] = {"task": "support.odd_tasks:FarAway", "fps": 10, "cameras": ("front", "wrist")}
    path = simulate(tmp_path / "e.mcap", **config, width=96, height=96)
    with Recording(path) as recording:
        assert recording.num_frames == 1
    assert [r for r in checked(path).results if r.level in ("warn", "fail")] == []


@pytest.mark.parametrize(
    ("task", "index"),
    [
        pytest.param("place_in_tray", 26, id="the jaw opens as far as the tray's wall lets it"),
        pytest.param("stack_three", 25, id="the wrist rests on its stop"),
        pytest.param("stack_three", 33, id="a jaw that has turned presses askew"),
        pytest.param("stack_three", 36, id="the tower rocks in the end"),
    ],
)
def test_a_small_arm_that_touches_much(task: str, index: int, tmp_path: Path) -> None:
    path = simulate(tmp_path / "e.mcap", robot="so101", task=task, seed=31, episode_index=index)
    assert [r for r in checked(path).results if r.level in ("warn", "fail")] == []


@pytest.mark.slow
@pytest.mark.parametrize(
    "config",
    [
        pytest.param({"robot": "iiwa", "width": 128, "height": 128}, marks=pytest.mark.long),
        pytest.param(
            {"robot": "iiwa", "variation": "full", "depth": True, "segmentation": True}, marks=pytest.mark.long
        ),
        {"variation": "full", "depth": True, "segmentation": True},
        pytest.param({"width": 320, "height": 240}, marks=pytest.mark.long),
        {"width": 128, "height": 128, "video": VideoConfig(codec="av1", crf=35)},
        {"video": VideoConfig(codec="jpeg", jpeg_quality=60)},
        {"fps": 60},
        pytest.param({"fps": 10}, marks=pytest.mark.long),
        {
            "robot": "iiwa",
            "variation": "full",
            "width": 64,
            "height": 48,
            "video": VideoConfig(codec="jpeg", jpeg_quality=60),
        },
    ],
    ids=str,
)
def test_images_of_every_kind(config: dict[str, Any], tmp_path: Path) -> None:
    path = simulate(tmp_path / "e.mcap", seed=24, cameras=("front", "wrist"), **config)
    assert [r for r in checked(path).results if r.level in ("warn", "fail")] == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("task", "robot", "index"), [("place_in_tray", "panda", 0), ("line_up", "iiwa", 5), ("unstack", "iiwa", 3)]
)
def test_what_is_held_close_to_a_camera_that_is_off(task: str, robot: str, index: int, tmp_path: Path) -> None:
    """The camera's calibration error moves what is near farther than what is far: one shift is not enough for both."""
    path = simulate(
        tmp_path / "e.mcap", task=task, robot=robot, variation="full", seed=77, episode_index=index, cameras=("wrist",)
    )
    assert [r for r in checked(path).results if r.level in ("warn", "fail")] == []


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = simulate(tmp_path / "e.mcap", seed=21)
    cases = [
        ((path,), 0),
        ((path, "--strict", "--json"), 0),
        ((path, "--only", "opens", "joint_speed"), 0),
        ((path, "--only", "joint_velocty"), 2),
        ((tmp_path / "nothing",), 2),
        ((), 2),
        ((path, "--replay", "1"), 0),
    ]
    for args, code in cases:
        capsys.readouterr()
        assert exit_code("check", *args) == code, args
        if "--json" in args:
            told = json.loads(capsys.readouterr().out)
            assert told[0]["level"] == "pass"
            assert len(told[0]["results"]) > 30


@pytest.fixture(scope="module")
def cut_short(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """What recover makes of a good recording of which a third, a half, two thirds are left."""
    from demorec.mcap import recover

    folder = tmp_path_factory.mktemp("cut")
    data = simulate(folder / "e.mcap", seed=21).read_bytes()
    files = []
    for number, share in enumerate((1 / 3, 1 / 2, 2 / 3)):
        part = folder / f"{number}.mcap.part"
        part.write_bytes(data[: int(len(data) * share)])
        files.append(recover(part, folder / f"{number}.mcap").path)
    return files


def test_what_a_crash_left_of_a_good_recording_lacks_its_end_only(cut_short: list[Path]) -> None:
    for path in cut_short:
        found = [(r.check, r.level) for r in checked(path).results if r.level in ("warn", "fail")]
        assert found == [("complete", "warn")], path


def test_strict_turns_warnings_into_failures(cut_short: list[Path]) -> None:
    for args, code in (((), 0), (("--strict",), 1)):
        assert exit_code("check", cut_short[1], *args) == code
