"""Faults of numbers, phases, outcome and description, each caught by the check that is meant for it."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.check import simulate
from support.faults import Changed, Rows, frozen, halved, inverted, judged, late, noisy, one_alien, upside_down

from demorec.check.base import Found, Measurement
from demorec.check.described import drawn_within_ranges
from demorec.core.config import EpisodePlan, GenerateConfig
from demorec.core.geometry import Pose
from demorec.core.tables import CHECKS, ROBOTS, TASKS
from demorec.episode.camera_error import error_values
from demorec.episode.episode import SuccessCheck
from demorec.episode.variation import PRESET_NAMES, Preset
from demorec.loop import prepare
from demorec.robots.panda import PANDA

Fault = Callable[[Changed], Changed]


@pytest.fixture(scope="session")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One pick-and-place without pictures."""
    return simulate(tmp_path_factory.mktemp("good") / "good.mcap", seed=7)


def column(name: str, change: Callable[[Rows], Rows]) -> Fault:
    return lambda c: c.with_columns(**{name: change(getattr(c.columns, name))})


def wrench(change: Callable[[Rows], Rows]) -> Fault:
    return lambda c: c.with_columns(sensed={"wrench": change(c.columns.sensed["wrench"])})


def phases(change: Callable[[list[str]], list[str]]) -> Fault:
    return lambda c: c.with_columns(phase=tuple(change(list(c.columns.phase))))


def info(**fields: Any) -> Fault:
    return lambda c: c.with_info(**fields)


def outcome(**fields: Any) -> Fault:
    return lambda c: c.with_outcome(**fields)


def scene(change: Callable[[Any], Any]) -> Fault:
    return lambda c: c.with_info(scene=change(c.info.scene))


def config(**fields: Any) -> Fault:
    return lambda c: c.with_info(config={**c.info.config, **fields})


def robot(**fields: Any) -> Fault:
    return lambda c: c.with_info(robot=replace(c.info.robot, **fields))


def condition(name: str, **fields: Any) -> Fault:
    def fault(c: Changed) -> Changed:
        assert any(check.name == name for check in c.outcome.checks)
        return c.with_outcome(
            checks=tuple(replace(check, **fields) if check.name == name else check for check in c.outcome.checks)
        )

    return fault


def behaviour(**values: float) -> Fault:
    return lambda c: c.with_info(behaviour={**c.info.behaviour, **values})


def both_grippers(change: Callable[[Rows], Rows]) -> Fault:
    return lambda c: c.with_columns(
        action_gripper=change(c.columns.action_gripper), command_gripper=change(c.columns.command_gripper)
    )


def without_phase(name: str, instead: str) -> Callable[[list[str]], list[str]]:
    return lambda rows: [instead if phase == name else phase for phase in rows]


def exchanged(a: str, b: str) -> Callable[[list[str]], list[str]]:
    return lambda rows: [{a: b, b: a}.get(phase, phase) for phase in rows]


def missed(frames: slice) -> Fault:
    def fault(c: Changed) -> Changed:
        flags = c.columns.is_deliberate_miss.copy()
        flags[frames] = True
        return c.with_columns(is_deliberate_miss=flags)

    return fault


def stuck(first: int, last: int) -> Callable[[Rows], Rows]:
    def change(rows: Rows) -> Rows:
        out = rows.copy()
        out[first:last] = rows[first]
        return out

    return change


def doubled(rows: Rows) -> Rows:
    return rows * 2


def in_percent(rows: Rows) -> Rows:
    return rows * 100


def one_spike(rows: Rows) -> Rows:
    out = rows.copy()
    out[30] = 50.0
    return out


def other_color(c: Changed) -> Changed:
    return c.with_info(instruction=c.info.instruction.replace("red", "purple").replace("green", "purple"))


CASES: list[tuple[str, Fault, str]] = [
    ("label of the gripper late", column("action_gripper", late), "gripper_label"),
    ("label of the gripper inverted", column("action_gripper", upside_down), "gripper_label"),
    ("label of the gripper halved", column("action_gripper", halved), "gripper_label"),
    ("label of the gripper frozen", column("action_gripper", frozen), "gripper_label"),
    ("label of the gripper off once", column("action_gripper", one_alien), "gripper_label"),
    ("label of the gripper noisy", column("action_gripper", noisy), "gripper_label"),
    ("label of the gripper in percent", column("action_gripper", in_percent), "gripper_label"),
    ("gripper inverted in both", both_grippers(upside_down), "gripper_follows"),
    ("gripper halved in both", both_grippers(halved), "gripper_follows"),
    ("gripper doubled in both", both_grippers(doubled), "gripper_follows"),
    ("gripper frozen in both", both_grippers(frozen), "gripper_follows"),
    ("gripper late in both", both_grippers(late), "phases_match_motion"),
    ("opening halved", column("gripper_width", halved), "gripper_follows"),
    ("opening inverted", column("gripper_width", upside_down), "gripper_follows"),
    ("opening frozen", column("gripper_width", frozen), "gripper_width"),
    ("contact force halved", column("contact_force", halved), "grip_force"),
    ("contact force doubled", column("contact_force", doubled), "grip_force"),
    ("contact force inverted", column("contact_force", inverted), "grip_force"),
    ("contact force upside down", column("contact_force", upside_down), "touches_nothing"),
    ("contact force frozen", column("contact_force", frozen), "grip_force"),
    ("contact force noisy", column("contact_force", noisy), "touches_nothing"),
    ("contact force in the air once", column("contact_force", one_spike), "touches_nothing"),
    ("contact force in another unit", column("contact_force", lambda rows: rows / 9.81), "grip_force"),
    ("efforts doubled", column("joint_effort", doubled), "joint_effort"),
    ("efforts in another unit", column("joint_effort", lambda rows: rows * 1000), "joint_effort"),
    ("efforts of exchanged joints", column("joint_effort", lambda rows: rows[:, ::-1]), "joint_effort"),
    ("efforts of the next joint", column("joint_effort", lambda r: np.roll(r, 1, axis=1)), "effort_matches_dynamics"),
    ("efforts halved", column("joint_effort", halved), "effort_matches_dynamics"),
    ("efforts inverted", column("joint_effort", inverted), "effort_matches_dynamics"),
    ("efforts upside down", column("joint_effort", upside_down), "effort_matches_dynamics"),
    ("efforts of zero", column("joint_effort", lambda rows: rows * 0), "effort_matches_dynamics"),
    ("efforts of noise", column("joint_effort", noisy), "effort_matches_dynamics"),
    ("efforts frozen", column("joint_effort", frozen), "stuck_sensors"),
    ("efforts frozen for a while", column("joint_effort", stuck(60, 70)), "stuck_sensors"),
    ("velocities frozen for a while", column("joint_velocity", stuck(60, 70)), "stuck_sensors"),
    ("wrench frozen", wrench(frozen), "stuck_sensors"),
    ("wrench halved", wrench(halved), "wrench_bears_the_hand"),
    ("wrench doubled", wrench(doubled), "wrench_bears_the_hand"),
    ("wrench in another unit", wrench(lambda rows: rows / 9.81), "wrench_bears_the_hand"),
    ("wrench of zero", wrench(lambda rows: rows * 0), "wrench_bears_the_hand"),
    ("wrench of exchanged axes", wrench(lambda r: r[:, [2, 1, 0, 5, 4, 3]]), "wrench_bears_the_hand"),
    ("wrench in the world's axes", wrench(lambda r: r * [1, -1, -1, 1, -1, -1]), "wrench_bears_the_hand"),
    ("noise doubled", lambda c: c.with_columns(
        command_joint_target=2 * c.columns.command_joint_target - c.columns.action_joint_target), "noise_as_said"),
    ("labels in place of commands", lambda c: c.with_columns(
        action_joint_target=c.columns.command_joint_target), "noise_as_said"),
    ("noise where none is said", behaviour(action_noise=0.0), "noise_as_said"),
    ("a tenth of the noise is said", behaviour(action_noise=0.002), "noise_as_said"),
    ("a speed that is not drawn", behaviour(speed=1.3), "drawn_within_ranges"),
    ("a height that is not drawn", behaviour(approach_height=0.05), "drawn_within_ranges"),
    ("a miss that is not drawn", behaviour(miss_x=0.04), "drawn_within_ranges"),
    ("perception that errs", behaviour(perception_yaw=0.1), "drawn_within_ranges"),
    ("more noise than is drawn", behaviour(action_noise=0.03), "drawn_within_ranges"),
    ("no number", behaviour(lift_height=math.nan), "drawn_within_ranges"),
    ("a calibration error that is not drawn", behaviour(**error_values({"front": Pose(
        position=np.array([0.0, 0.05, 0.0]))})), "drawn_within_ranges"),
    ("a calibration turn that is not drawn", behaviour(**error_values({"front": Pose(
        quat_xyzw=np.array([0.0, 0.1, 0.0, math.sqrt(0.99)]))})), "drawn_within_ranges"),
    ("phases one frame late", phases(lambda rows: [rows[0], *rows[:-1]]), "phases_match_motion"),
    ("phases one frame early", phases(lambda rows: [*rows[1:], rows[-1]]), "phases_match_motion"),
    ("phases backwards", phases(lambda rows: rows[::-1]), "phases_match_motion"),
    ("all one phase", phases(lambda rows: ["approach"] * len(rows)), "phases_match_motion"),
    ("phases frozen", phases(lambda rows: rows[:100] + [rows[100]] * (len(rows) - 100)), "phases_match_motion"),
    ("one alien phase", phases(lambda rows: [*rows[:20], "lift", *rows[21:]]), "phases_match_motion"),
    ("lift for lower", phases(exchanged("lift", "lower")), "phases_match_motion"),
    ("close for release", phases(exchanged("close", "release")), "phases_match_motion"),
    ("no lift", phases(without_phase("lift", "transport")), "story"),
    ("no descent", phases(without_phase("descend", "approach")), "story"),
    ("an unknown phase", phases(without_phase("lower", "place")), "story"),
    ("retreat for release", phases(exchanged("retreat", "release")), "story"),
    ("no phases before the descent", phases(lambda rows: ["descend" if p == "approach" else p for p in rows]), "story"),
    ("a retry that was none", outcome(num_retries=1), "story"),
    ("misses where there are none", missed(slice(0, 60)), "deliberate_misses"),
    ("a miss in the midst", missed(slice(90, 110)), "deliberate_misses"),
    ("passed beyond the limit", condition("tilt", value=1.0), "outcome_consistent"),
    ("not passed within the limit", condition("tilt", passed=False), "outcome_consistent"),
    ("an open gripper that was closed", condition("gripper_width", value=0.01), "outcome_consistent"),
    ("another limit", condition("distance_to_goal", limit=1e-9), "outcome_consistent"),
    ("a success with a phase of failure", outcome(failure_phase="lift"), "outcome_consistent"),
    ("failed by what passed", outcome(success=False, failure_reason="tilt"), "outcome_consistent"),
    ("a condition twice", lambda c: c.with_outcome(checks=c.outcome.checks * 2), "outcome_consistent"),
    ("a success of nothing", outcome(checks=()), "outcome_consistent"),
    ("a success that leaves the cube behind", lambda c: c.with_outcome(checks=(SuccessCheck(
        name="x", value=2, limit=1, unit="", passed=True), *c.outcome.checks)), "outcome_consistent"),
    ("a tilt that is not seen", condition("tilt", value=0.08), "end_values"),
    ("an opening that is not seen", condition("gripper_width", value=0.2), "end_values"),
    ("a distance that is not seen", condition("distance_to_goal", value=0.0199, limit=0.02), "final_state"),
    ("another task", info(task="stack"), "config_agrees"),
    ("another seed", info(root_seed=8), "config_agrees"),
    ("another rate", info(fps=60), "config_agrees"),
    ("another physics rate", info(physics_hz=480), "config_agrees"),
    ("an attempt that is not allowed", info(attempt=7), "config_agrees"),
    ("a config of another seed", config(seed=8), "config_agrees"),
    ("a config of another speed limit", config(max_episode_seconds=61.0), "config_agrees"),
    ("another digest of the config", info(config_digest="0" * 16), "config_agrees"),
    ("physics of another rate", scene(lambda s: replace(s, physics=replace(s.physics, hz=120))), "config_agrees"),
    ("a scene with another robot", scene(lambda s: replace(s, robot=replace(s.robot, name="iiwa"))), "config_agrees"),
    ("a robot of another name", robot(name="iiwa"), "config_agrees"),
    ("a stronger gripper", robot(gripper=replace(PANDA.gripper, force=40.0)), "robot_as_known"),
    ("a faster robot", robot(velocity_limit=(99.0,) * 7), "robot_as_known"),
    ("wider limits", robot(position_upper=(9.0,) * 7), "robot_as_known"),
    ("another hand", robot(hand_link="panda_link7"), "robot_as_known"),
    ("a robot of another scale", scene(lambda s: replace(s, robot=replace(s.robot, scale=1.3))), "robot_as_known"),
    ("an instruction of another colour", other_color, "instruction_fits_scene"),
    ("no instruction", info(instruction=" "), "instruction_fits_scene"),
    ("an instruction of half the scene", info(instruction="go to the green target"), "instruction_fits_scene"),
]  # fmt: skip


def test_the_good_one_passes(good: Path) -> None:
    for name in sorted({check for *_, check in CASES}):
        result = judged(good, name, replace)
        assert result.level == "pass", (name, result.value, result.detail)


@pytest.mark.parametrize(("name", "fault", "check"), CASES, ids=[name for name, *_ in CASES])
def test_a_fault(name: str, fault: Fault, check: str, good: Path) -> None:
    result = judged(good, check, fault)
    assert result.level == "fail", (result.value, result.detail)


def test_phases_of_other_tasks_may_mean_anything(good: Path) -> None:
    for name in ("story", "phases_match_motion", "deliberate_misses"):
        result = judged(good, name, info(task="my_tasks:Mine"))
        assert result.level == "skip"
        assert "not measured" in result.detail


def drawn(config: GenerateConfig, index: int = 0, changes: Mapping[str, float] | None = None) -> Found:
    """What `drawn_within_ranges` finds of an episode that was drawn, some of its numbers changed."""
    told = prepare(EpisodePlan(config=config, episode_index=index)).info
    behaviour = {**told.behaviour, **(changes or {})}
    return drawn_within_ranges.measure(SimpleNamespace(info=replace(told, behaviour=behaviour)))


@pytest.mark.parametrize("variation", PRESET_NAMES)
@pytest.mark.parametrize("task", TASKS.names())
def test_what_is_drawn_lies_within_its_ranges(task: str, variation: Preset) -> None:
    for robot, index in itertools.product(ROBOTS.names(), range(5)):
        config = GenerateConfig(task=task, robot=robot, variation=variation, seed=3)
        assert drawn(config, index) == Measurement(value=0)


@pytest.mark.parametrize(
    ("name", "allowed", "beyond"),  # the ranges of docs/simulation.md
    [
        ("speed", 1.49, 1.51),
        ("miss_x", -0.049, -0.051),
        ("calibration_front_x", 0.0029, 0.0031),
        ("calibration_wrist_qz", -0.0049, -0.0051),
        ("calibration_front_angle", 0.0172, 0.0175),  # 0.01 rad about each axis
    ],
)
def test_where_the_ranges_of_full_end(name: str, allowed: float, beyond: float) -> None:
    config = GenerateConfig(variation="full")
    assert drawn(config, changes={name: allowed}) == Measurement(value=0)
    found = drawn(config, changes={name: beyond})
    assert isinstance(found, Measurement)
    assert found.value == 1
    assert name in found.detail


def test_the_checks_used_here_are_rows() -> None:
    assert {check for *_, check in CASES} <= set(CHECKS.names())
