"""Faults of numbers, phases, outcome and description, each caught by the check that is meant for it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.check import simulate
from support.faults import Changed, Rows, frozen, halved, inverted, judged, late, noisy, one_alien, upside_down

from demorec.core.tables import CHECKS

Fault = Callable[[Changed], Changed]


@pytest.fixture(scope="session")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One pick-and-place without pictures."""
    return simulate(tmp_path_factory.mktemp("good") / "good.mcap", seed=7)


def column(name: str, change: Callable[[Rows], Rows]) -> Fault:
    return lambda c: c.with_columns(**{name: change(getattr(c.columns, name))})


def info(**fields: Any) -> Fault:
    return lambda c: c.with_info(**fields)


def outcome(**fields: Any) -> Fault:
    return lambda c: c.with_outcome(**fields)


def scene(change: Callable[[Any], Any]) -> Fault:
    return lambda c: c.with_info(scene=change(c.info.scene))


def condition(name: str, **fields: Any) -> Fault:
    def fault(c: Changed) -> Changed:
        assert any(check.name == name for check in c.outcome.checks)
        return c.with_outcome(
            checks=tuple(replace(check, **fields) if check.name == name else check for check in c.outcome.checks)
        )

    return fault


def both_grippers(change: Callable[[Rows], Rows]) -> Fault:
    return lambda c: c.with_columns(
        action_gripper=change(c.columns.action_gripper), command_gripper=change(c.columns.command_gripper)
    )


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
    ("wrench frozen", column("wrench", frozen), "stuck_sensors"),
    ("wrench halved", column("wrench", halved), "wrench_bears_the_hand"),
    ("wrench doubled", column("wrench", doubled), "wrench_bears_the_hand"),
    ("wrench in another unit", column("wrench", lambda rows: rows / 9.81), "wrench_bears_the_hand"),
    ("wrench of zero", column("wrench", lambda rows: rows * 0), "wrench_bears_the_hand"),
    ("wrench of exchanged axes", column("wrench", lambda r: r[:, [2, 1, 0, 5, 4, 3]]), "wrench_bears_the_hand"),
    ("wrench in the world's axes", column("wrench", lambda r: r * [1, -1, -1, 1, -1, -1]), "wrench_bears_the_hand"),
    ("not passed within the limit", condition("tilt", passed=False), "outcome_consistent"),
    ("a success with a phase of failure", outcome(failure_phase="lift"), "outcome_consistent"),
    ("failed by what passed", outcome(success=False, failure_reason="tilt"), "outcome_consistent"),
    ("a condition twice", lambda c: c.with_outcome(checks=c.outcome.checks * 2), "outcome_consistent"),
    ("a success of nothing", outcome(checks=()), "outcome_consistent"),
    ("a distance that is not seen", condition("distance_to_goal", value=0.0199, limit=0.02), "final_state"),
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


def test_the_checks_used_here_are_rows() -> None:
    assert {check for *_, check in CASES} <= set(CHECKS.names())
