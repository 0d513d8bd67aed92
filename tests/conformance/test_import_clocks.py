"""Bags with separate clocks for headers and recording, or with incomplete headers; fps follows the rows' clock."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support import bag_mappings, bags
from support.commands import exit_code

from demorec.mcap import Recording

STATE, ACTION, FRONT = "/joint_states", "/joint_command", "/front/rgb"
GRIPPER = "/gripper/state"
WALL_NS = bags.EPOCH_NS + 5 * bags.NS
SLOWDOWN = 30 / 23
"""Recorded seconds for each second of a simulation that is slower than real time."""
MAPPING = (
    bag_mappings.HEAD.format(robot="arm")
    + """
[[features."observation.state"]]
topic = "/joint_states"
field = "position"
[[features.action]]
topic = "/joint_command"
field = "position"
[cameras.front]
topic = "/front/rgb"
"""
)


def isaac(seconds: float = 3.0) -> bags.Notes:
    """Messages as Isaac Sim's ROS 2 bridge sends them: headers count simulated time from 0, recorded at the host's
    pace.
    """

    def simulated(moments: list[int]) -> list[int]:
        return [moment - bags.EPOCH_NS + 500_000_000 for moment in moments]

    steps = [round(k * bags.NS / 60) + bags.EPOCH_NS for k in range(round(60 * seconds))]
    notes = bags.joints(STATE, ("a", "b"), steps) + bags.joints(ACTION, ("a", "b"), steps, shift=0.1)
    notes += bags.jpeg_images(FRONT, steps[::2], 0, "front")
    stamps = simulated([note.header_ns for note in notes])
    return bags.in_order(
        [
            replace(note, header_ns=stamp, log_ns=WALL_NS + round(stamp * SLOWDOWN) + note.log_ns - note.header_ns)
            for note, stamp in zip(notes, stamps, strict=True)
        ]
    )


def real(seconds: float = 2.0, *, skew_s: float = 0.0) -> bags.Notes:
    """A robot with a camera, and a gripper without headers; other headers are `skew_s` behind the recorder."""
    notes = bags.joints(STATE, ("a", "b"), bags.times(100, seconds, seed=1))
    notes += bags.joints(ACTION, ("a", "b"), bags.times(100, seconds, seed=2), shift=0.1)
    notes += bags.jpeg_images(FRONT, bags.times(30, seconds, seed=3), 0, "front")
    notes = [replace(note, header_ns=note.header_ns - round(skew_s * bags.NS)) for note in notes]
    notes += bags.messages(
        GRIPPER, "std_msgs/msg/Float64MultiArray", bags.times(100, seconds, seed=4),
        lambda moment: {"data": bags.motion(moment, 1)}, has_header=False,
    )  # fmt: skip
    return bags.in_order(notes)


@pytest.fixture
def imports(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Callable[[bags.Notes, str], tuple[int, str, str]]:
    """Import messages with a mapping, or with the suggested one; return exit code, output and errors."""

    def do(notes: bags.Notes, mapping: str) -> tuple[int, str, str]:
        bag = bags.write_rosbag2(notes, tmp_path / "stack_cups_01")
        file = bag_mappings.write_mapping(mapping, tmp_path / "robot.toml")
        if mapping == "suggested":
            assert exit_code("import", "--suggest", bag) == 0
            bag_mappings.write_mapping(capsys.readouterr().out, file)
        code = exit_code("import", bag, "--mapping", file, "--out", tmp_path / "run")
        return code, *capsys.readouterr()

    return do


Imports = Callable[[bags.Notes, str], tuple[int, str, str]]


def test_a_clock_that_was_never_set(imports: Imports) -> None:
    """All headers agree among each other, and are years from the times of recording."""
    shift = 5 * 365 * 24 * 3600 * bags.NS
    notes = [replace(note, header_ns=note.header_ns + shift) for note in real() if note.topic != GRIPPER]
    code, told, _ = imports(notes, MAPPING)
    assert code == 0
    assert "all headers are 5.0 years ahead of" in told
    assert "No findings." not in told


@pytest.mark.parametrize(("step", "is_still"), [(0.0, True), (0.004, False)])
def test_a_bag_in_which_nothing_moves(step: float, is_still: bool, imports: Imports) -> None:
    """A robot that was never switched on, with encoder noise."""
    random = np.random.default_rng(0)
    notes = [
        bags.with_body(note, position=np.array([0.3, -1.2 + step * (k > 100)]) + 5e-4 * random.uniform(-0.5, 0.5, 2))
        for k, note in enumerate(note for note in isaac() if note.topic != FRONT)
    ]
    _, told, _ = imports(bags.in_order(notes), MAPPING.partition("[cameras.front]")[0])
    assert ("  still: nothing moves" in told) is is_still


@pytest.mark.parametrize("mapping", ["suggested", MAPPING])
def test_simulated_time(mapping: str, imports: Imports, tmp_path: Path) -> None:
    """The camera has 23 images a second by the recorder's clock, and 30 by the headers, which rows follow."""
    notes = isaac()
    code, told, _ = imports(notes, mapping)
    assert code == 0
    assert tomllib.loads((tmp_path / "robot.toml").read_text())["clock"]["fps"] == 30
    assert "No findings but the notes above." in told
    with Recording(tmp_path / "run/episodes/episode_000000.mcap") as recording:
        assert recording.info.fps == 30
        times = recording.table().time_ns.tolist()
        assert times == [note.header_ns for note in bags.of_topic(notes, FRONT)]


WITH_GRIPPER = f'{MAPPING}[[features."observation.state"]]\ntopic = "{GRIPPER}"\nfield = "data"\nnames = ["g"]\n'


def test_only_the_source_without_headers_uses_recording_times(imports: Imports, tmp_path: Path) -> None:
    notes = real()
    code, told, _ = imports(notes, WITH_GRIPPER)
    assert code == 0
    assert "No findings." in told
    with Recording(tmp_path / "run/episodes/episode_000000.mcap") as recording:
        table = recording.table()
    states, grippers = bags.of_topic(notes, STATE), [note for note in notes if note.topic == GRIPPER]
    for time_ns, values in zip(table.time_ns.tolist(), table.features["observation.state"], strict=True):
        state = max((note for note in states if note.header_ns <= time_ns), key=lambda note: note.header_ns)
        gripper = max((note for note in grippers if note.log_ns <= time_ns), key=lambda note: note.log_ns)
        assert values.tolist() == [*state.body["position"].tolist(), *gripper.body["data"].tolist()]


def test_an_action_of_the_next_state_and_a_gripper_command(imports: Imports, tmp_path: Path) -> None:
    """Joint actions are the next state; gripper actions are the latest command of a separate topic, row by row."""
    notes = real(3.0)
    mapping = MAPPING.replace('topic = "/joint_command"\nfield = "position"\n', 'next = "observation.state"\n')
    mapping += f'[[features.action]]\ntopic = "{GRIPPER}"\nfield = "data"\nnames = ["g"]\n'
    code, told, error = imports(notes, mapping)
    assert code == 0, told + error
    with Recording(tmp_path / "run/episodes/episode_000000.mcap") as recording:
        table = recording.table()
    state, grippers = table.features["observation.state"], [note for note in notes if note.topic == GRIPPER]
    for row, values in enumerate(table.features["action"][:-1]):
        time_ns = int(table.time_ns[row])
        gripper = max((note for note in grippers if note.log_ns <= time_ns), key=lambda note: note.log_ns)
        assert values.tolist() == [*state[row + 1].tolist(), *gripper.body["data"].tolist()]


def test_headers_far_from_times_of_recording_are_found_where_both_are_used(imports: Imports) -> None:
    _, told, _ = imports(real(skew_s=0.3), WITH_GRIPPER)
    lines = [line for line in told.splitlines() if line.startswith("  clock_offset: ") and GRIPPER in line]
    assert len(lines) == 1
    assert "+0.31" in lines[0] or "+0.30" in lines[0]
    assert 'clock.stamp = "log"' in lines[0]
    assert "clock_offset" in told.splitlines()[-1]


def test_simulated_headers_next_to_missing_ones_are_refused(imports: Imports) -> None:
    gripper = [
        replace(note, log_ns=note.log_ns - bags.EPOCH_NS + WALL_NS) for note in real(3.0) if note.topic == GRIPPER
    ]
    code, told, error = imports(bags.in_order(isaac() + gripper), WITH_GRIPPER)
    assert (code, told) == (1, "")
    assert "clock_offset" in error
    assert 'clock.stamp = "log"' in error
    assert error.count("\n") == 1


def test_the_suggested_rate(imports: Imports, tmp_path: Path) -> None:
    """A camera pauses for two seconds, as between two attempts."""
    rate = 59.94
    moments = [bags.EPOCH_NS + 1000 * round(k * 1e6 / rate + (2e6 if k > rate else 0)) for k in range(round(3 * rate))]
    notes = bags.joints(STATE, ("a", "b"), range(moments[0] - 10_000_000, moments[-1], 10_000_000))
    notes += bags.joints(ACTION, ("a", "b"), range(moments[0] - 10_000_000, moments[-1], 10_000_000))
    notes += bags.jpeg_images(FRONT, moments, 0, "front")
    imports(bags.in_order(notes), "suggested")
    assert tomllib.loads((tmp_path / "robot.toml").read_text())["clock"]["fps"] == round(rate)


@pytest.mark.parametrize(("name", "task"), [("stack_the_cups_003", "stack the cups"), ("0042", None)])
def test_the_suggested_task_is_that_of_each_bag(
    name: str, task: str | None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The suggestion uses each bag's own name, never that of the first for all; otherwise the user has to supply the
    task.
    """
    paths = []
    for number in range(2):
        notes = bags.in_order(bags.so101(0.6 + 0.1 * number))
        path = bags.write_mcap(notes, tmp_path / (f"{name}.mcap" if not number else "push_the_block_1.mcap"))
        paths.append(path)
    assert exit_code("import", "--suggest", paths[0]) == 0
    text = capsys.readouterr().out
    assert tomllib.loads(text)["task"] == ({"file_name": True} if task else {})
    mapping = bag_mappings.write_mapping(text, tmp_path / "robot.toml")
    code = exit_code("import", *paths, "--mapping", mapping, "--out", tmp_path / "run")
    if task is None:
        assert code == 2
        assert "[task] needs one of text and file_name" in capsys.readouterr().err
        return
    for index, instruction in enumerate((task, "push the block")):
        with Recording(tmp_path / f"run/episodes/episode_{index:06d}.mcap") as recording:
            assert recording.info.instruction == instruction
