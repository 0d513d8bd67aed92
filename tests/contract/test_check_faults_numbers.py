"""Faults of numbers, phases, outcome and description, each caught by the check that is meant for it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.check import simulate
from support.faults import (
    Changed,
    Fault,
    Rows,
    backwards,
    both_grippers,
    condition,
    frozen,
    halved,
    info,
    inverted,
    judged,
    late,
    noisy,
    one_alien,
    outcome,
    upside_down,
)

from demorec.check.rows import matrices
from demorec.episode.episode import SuccessCheck
from demorec.robots.panda import PANDA


@pytest.fixture(scope="session")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One pick-and-place without images."""
    return simulate(tmp_path_factory.mktemp("good") / "good.mcap", seed=7)


def column(name: str, change: Callable[[Rows], Rows]) -> Fault:
    return lambda c: c.with_columns(**{name: change(getattr(c.columns, name))})


def columns(change: Callable[[Rows], Rows], *names: str) -> Fault:
    return lambda c: c.with_columns(**{name: change(getattr(c.columns, name)) for name in names})


def cube(change: Callable[[Rows], Rows]) -> Fault:
    """Other poses of the cube."""

    def fault(c: Changed) -> Changed:
        before = c.columns.object_poses["red_cube"]
        after = change(before)
        assert not np.array_equal(before, after)
        return replace(c, columns=replace(c.columns, object_poses={**c.columns.object_poses, "red_cube": after}))

    return fault


def plus(where: Any, by: Any) -> Callable[[Rows], Rows]:
    """Some of the values larger."""

    def change(rows: Rows) -> Rows:
        out = rows.copy()
        out[where] += by
        return out

    return change


def early(rows: Rows) -> Rows:
    return np.concatenate([rows[1:], rows[-1:]])


def six_frames_late(rows: Rows) -> Rows:
    return np.concatenate([np.repeat(rows[:1], 6, axis=0), rows[:-6]])


def first_two_exchanged(rows: Rows) -> Rows:
    return rows[:, [1, 0, *range(2, rows.shape[1])]]


def scalar_first(rows: Rows) -> Rows:
    return rows[:, [0, 1, 2, 6, 3, 4, 5]]


def random_targets(rows: Rows) -> Rows:
    return np.random.default_rng(0).uniform(PANDA.position_lower, PANDA.position_upper, rows.shape)


def jump_in_the_hand(rows: Rows) -> Rows:
    middle = len(rows) // 2
    return plus(np.s_[middle : middle + 5, 0], 0.12)(rows)


def trembling(rows: Rows) -> Rows:
    return plus(np.s_[41:60:2, 0], -8.0)(plus(np.s_[40:60:2, 0], 8.0)(rows))


def with_fingers(c: Changed, joints: Rows) -> Changed:
    return c.with_columns(joint_position=joints, gripper_width=joints[:, -2:].sum(axis=1))


def held(c: Changed) -> Rows:
    """Rows in which the cube is lifted and carried."""
    return np.flatnonzero(np.isin(c.columns.phase, ["lift", "transport"]))


def open_hand(c: Changed) -> Changed:
    joints = c.columns.joint_position.copy()
    joints[:, -2:] = 0.001
    return with_fingers(c, joints)


def fingers_in_the_cube(c: Changed) -> Changed:
    return with_fingers(c, plus(np.s_[held(c), -2:], -0.0025)(c.columns.joint_position))


def force_late(rows: Rows) -> Rows:
    """The torque stays where it was."""
    return np.column_stack([late(late(rows[:, :3])), rows[:, 3:]])


def filtered(rows: Rows) -> Rows:
    """A low-pass filter of the first order."""
    out = rows.copy()
    for t in range(1, len(out)):
        out[t] = 0.8 * out[t - 1] + 0.2 * rows[t]
    return out


def slipping(c: Changed) -> Changed:
    """By 15 mm, slowly, while it is carried."""
    rows = held(c)
    return cube(plus(np.s_[rows, 2], -np.linspace(0.0, 0.015, len(rows))))(c)


def rotation_jumps(rows: Rows) -> Rows:
    """For a frame, by 0.35 rad about the vertical, long before anything touches the cube."""
    out = rows.copy()
    half = 0.175
    x, y, z, w = rows[3, 3:]
    s, k = math.sin(half), math.cos(half)
    out[3, 3:] = k * x - s * y, k * y + s * x, k * z + s * w, k * w - s * z
    return out


def cut(kept: slice) -> Fault:
    """Only some of the frames, as if no others had been recorded."""

    def fault(c: Changed) -> Changed:
        taken: dict[str, Any] = {}
        for name, value in vars(c.columns).items():
            taken[name] = {key: table[kept] for key, table in value.items()} if isinstance(value, dict) else value[kept]
        return replace(c, columns=replace(c.columns, **taken))

    return fault


def beside_the_middle_of_the_fingers(c: Changed) -> Changed:
    rows = held(c)
    hands = matrices(c.columns.base_from_tcp[rows])  # the robot's base is the origin of the world
    return cube(plus(np.s_[rows, :3], 0.003 * hands[:, :3, 1]))(c)


def wrench(change: Callable[[Rows], Rows]) -> Fault:
    return lambda c: c.with_columns(sensed={"wrench": change(c.columns.sensed["wrench"])})


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


def once_while_carried(name: str, factor: float, share: float = 0.5) -> Fault:
    """One frame of carrying, in the midst or later, where no motor is at its limit."""

    def fault(c: Changed) -> Changed:
        carried = np.flatnonzero(np.array(c.columns.phase) == "transport")
        rows = np.array(c.columns.sensed[name] if name in c.columns.sensed else getattr(c.columns, name))
        rows[carried[int(share * len(carried))]] *= factor
        return c.with_columns(**({"sensed": {name: rows}} if name in c.columns.sensed else {name: rows}))

    return fault


def loose_once(c: Changed) -> Changed:
    """One frame of carrying in which the fingers' motors give nothing."""
    effort = c.columns.joint_effort.copy()
    carried = np.flatnonzero(np.array(c.columns.phase) == "transport")
    effort[carried[len(carried) // 2], 7:] = 0.0
    return c.with_columns(joint_effort=effort)


def held_on(c: Changed) -> Changed:
    """Where the force on the fingers ends it stays for three frames more."""
    force = c.columns.contact_force.copy()
    last = np.flatnonzero((force[:-1] > 1) & (force[1:] == 0))[-1]
    force[last + 1 : last + 4] = force[last]
    return c.with_columns(contact_force=force)


def woken_early(c: Changed) -> Changed:
    """The cube jumps by 5 mm between the open fingers, before they close."""
    first = int(np.flatnonzero(c.columns.contact_force > 0)[0])
    return cube(plus(np.s_[first - 4 : first - 2, 2], 0.005))(c)


def leaps_to_the_fingers(c: Changed) -> Changed:
    """The cube is 12 mm aside, until shortly before they close."""
    first = int(np.flatnonzero(c.columns.contact_force > 0)[0])
    return cube(plus(np.s_[: first - 4, 1], 0.012))(c)


def one_joint(index: int, change: Callable[[Rows], Rows]) -> Callable[[Rows], Rows]:
    """Other values of one column."""
    return lambda rows: np.column_stack([rows[:, :index], change(rows[:, index]), rows[:, index + 1 :]])


CASES: list[tuple[str, Fault, str]] = [
    ("efforts filtered", column("joint_effort", lambda r: filtered(filtered(r))), "effort_in_each_frame"),
    ("efforts late", column("joint_effort", lambda r: late(late(late(r)))), "effort_in_each_frame"),
    ("a sample of the wrench inverted", once_while_carried("wrench", -1.0, 0.95), "force_spikes"),
    ("a sample of the efforts a tenth", once_while_carried("joint_effort", 0.1, 0.95), "force_spikes"),
    ("an effort of zero", column("joint_effort", one_joint(6, np.zeros_like)), "stuck_sensors"),
    ("contact force beyond the release", held_on, "touches_nothing"),
    ("a cube that moves before it is touched", woken_early, "object_motion"),
    ("a cube that leaps to the fingers", leaps_to_the_fingers, "object_motion"),
    ("contact force two frames late", column("contact_force", lambda r: late(late(r))), "contact_lag"),
    ("contact force doubled once", once_while_carried("contact_force", 2.0), "force_spikes"),
    ("a sample of the contact force lost", once_while_carried("contact_force", 0.0), "force_spikes"),
    ("a sample of the wrench lost", once_while_carried("wrench", 0.0), "force_spikes"),
    ("a sample of the efforts lost", once_while_carried("joint_effort", 0.0), "force_spikes"),
    ("a sample of the fingers' efforts lost", loose_once, "force_spikes"),
    ("wrench filtered", wrench(filtered), "wrench_lag"),
    ("the cube slips in the hand", slipping, "slips"),
    ("colours exchanged", info(instruction="put the green cube on the red target"), "instruction_fits_scene"),
    ("actions late", columns(late, "action_joint_target", "action_gripper", "action_base_from_tcp"), "action_lag"),
    ("commands late", columns(late, "command_joint_target", "command_base_from_tcp"), "command_lag"),
    ("commands early", column("command_joint_target", early), "command_lag"),
    ("commands of the gripper late", column("command_gripper", six_frames_late), "gripper_lag"),
    ("joints exchanged", column("joint_position", first_two_exchanged), "forward_kinematics"),
    ("velocities exchanged", column("joint_velocity", first_two_exchanged), "velocity_matches_position"),
    ("hand in millimetres", column("base_from_tcp", lambda r: r * [*[1000] * 3, *[1] * 4]), "forward_kinematics"),
    ("hand with its scalar first", column("base_from_tcp", scalar_first), "forward_kinematics"),
    ("pose of the flange", column("base_from_tcp", plus(np.s_[:, 2], 0.105)), "forward_kinematics"),
    ("cube with its scalar first", cube(scalar_first), "starts_as_scene_says"),
    ("quaternions of another length", cube(lambda r: r * [*[1] * 3, *[1.01] * 4]), "unit_quaternions"),
    ("degrees", column("joint_position", np.degrees), "joint_limits"),
    ("opening in millimetres", column("gripper_width", lambda r: r * 1000), "gripper_width"),
    ("random actions", column("action_joint_target", random_targets), "action_lag"),
    ("random labels", column("action_joint_target", random_targets), "action_matches_command"),
    ("commands of another motion", column("command_joint_target", backwards), "command_tracking"),
    ("commands of a joint that are off for ten frames", column("command_joint_target", plus(np.s_[40:50, 1], 0.13)),
     "command_tracking"),
    ("effort that is no number", column("joint_effort", plus(np.s_[40, 3], math.nan)), "finite_numbers"),
    ("wrench that is no number", wrench(plus(np.s_[40, 5], math.nan)), "finite_numbers"),
    ("wrench of the load", wrench(inverted), "wrench_bears_the_hand"),
    ("torque before force", wrench(lambda r: r[:, [3, 4, 5, 0, 1, 2]]), "wrench_bears_the_hand"),
    ("wrench along other axes", wrench(lambda r: r[:, [2, 0, 1, 5, 3, 4]]), "wrench_bears_the_hand"),
    ("torque of the wrench zero", wrench(lambda r: r * [1, 1, 1, 0, 0, 0]), "wrench_turns_the_wrist"),
    ("torque of the wrench inverted", wrench(lambda r: r * [1, 1, 1, -1, -1, -1]), "wrench_turns_the_wrist"),
    ("torque of the wrench in N mm", wrench(lambda r: r * [1, 1, 1, *[1000] * 3]), "wrench_turns_the_wrist"),
    ("wrench two frames late", wrench(lambda r: late(late(r))), "wrench_turns_the_wrist"),
    ("force of the wrench two frames late", wrench(force_late), "wrench_lag"),
    ("wrench not tared", wrench(plus(np.s_[:, 2], 3.0)), "wrench_bears_the_hand"),
    ("torque of the wrench not tared", wrench(plus(np.s_[:, 4], 0.5)), "wrench_bears_the_hand"),
    ("efforts 30 % too small", column("joint_effort", lambda r: 0.7 * r), "effort_matches_dynamics"),
    ("efforts of light joints exchanged", column("joint_effort", lambda r: r[:, [0, 1, 2, 3, 6, 5, 4, 7, 8]]),
     "effort_matches_dynamics"),
    ("efforts three frames late", column("joint_effort", lambda r: late(late(late(r)))), "wrench_turns_the_wrist"),
    ("velocities 8 % too small", column("joint_velocity", lambda r: 0.92 * r), "velocity_follows_servo"),
    ("velocity of a joint too small", column("joint_velocity", lambda r: r * [1, 0.92, *[1] * 7]),
     "velocity_follows_servo"),
    ("velocities two frames late", column("joint_velocity", lambda r: late(late(r))), "velocity_lag"),
    ("velocities a frame early", column("joint_velocity", early), "velocity_lag"),
    ("three frames cut off at the head", cut(np.s_[3:]), "starts_at_rest"),
    ("five frames cut off at the tail", cut(np.s_[:-5]), "ends_at_rest"),
    ("a rotation that jumps", cube(rotation_jumps), "spins"),
    ("a rotation that jumps while untouched", cube(rotation_jumps), "object_motion"),
    ("a limit of the tilt that is another", condition("tilt", limit=0.2), "conditions_as_known"),
    ("passed beyond the limit", condition("speed", value=0.2), "conditions_as_known"),
    ("touched, and passed", condition("touched_by_robot", value=1.0), "conditions_as_known"),
    ("no condition of the tilt", lambda c: c.with_outcome(
        checks=tuple(check for check in c.outcome.checks if check.name != "tilt")), "conditions_as_known"),
    ("a tilt that is not seen", condition("tilt", value=0.06), "final_state"),
    ("a height that is not seen", condition("height_error", value=0.0035), "final_state"),
    ("an opening that is not seen", condition("gripper_width", value=0.0735), "final_state"),
    ("a jump while untouched", cube(plus(np.s_[10:, 1], 0.02)), "object_motion"),
    ("a drift while untouched", cube(plus(np.s_[:30, 0], np.linspace(-0.15, 0, 30))), "object_motion"),
    ("a jump in the hand", cube(jump_in_the_hand), "teleports"),
    ("sunk into the table", cube(plus(np.s_[:, 2], -0.012)), "penetration"),
    ("at rest a millimetre inside the table", cube(plus(np.s_[:, 2], -0.001)), "penetration"),
    ("carried without a grip", column("contact_force", lambda r: r * 0), "carried_by_gripper"),
    ("carried by an open hand", open_hand, "carried_by_gripper"),
    ("fingers in the cube", fingers_in_the_cube, "finger_depth"),
    ("beside the middle of the fingers", beside_the_middle_of_the_fingers, "finger_depth"),
    ("a spike of velocity", column("joint_velocity", plus(np.s_[60, 2], 9.0)), "joint_speed"),
    ("trembling labels", column("action_joint_target", plus(np.s_[::2], 0.02)), "action_acceleration"),
    ("trembling velocities", column("joint_velocity", trembling), "joint_acceleration"),
    ("a success that was none", lambda c: c.with_outcome(checks=(*c.outcome.checks, SuccessCheck(
        name="tilt", value=1.2, limit=0.087, unit="rad", passed=False))), "outcome_consistent"),
    ("a failure without a reason", outcome(success=False), "outcome_consistent"),
    ("the end of another episode", cube(plus(np.s_[-3:, 0], 0.05)), "final_state"),
    ("still rolling in the end", cube(plus(np.s_[-5:, 0], 0.004 * np.arange(5))), "at_rest_in_the_end"),
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
    ("wrench frozen", wrench(frozen), "stuck_sensors"),
    ("wrench halved", wrench(halved), "wrench_bears_the_hand"),
    ("wrench doubled", wrench(doubled), "wrench_bears_the_hand"),
    ("wrench in another unit", wrench(lambda rows: rows / 9.81), "wrench_bears_the_hand"),
    ("wrench of zero", wrench(lambda rows: rows * 0), "wrench_bears_the_hand"),
    ("wrench of exchanged axes", wrench(lambda r: r[:, [2, 1, 0, 5, 4, 3]]), "wrench_bears_the_hand"),
    ("wrench in the world's axes", wrench(lambda r: r * [1, -1, -1, 1, -1, -1]), "wrench_bears_the_hand"),
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


@pytest.mark.parametrize("share", [0.5, 1.5])
def test_a_wrench_of_another_size_while_a_jaw_carries(share: float, tmp_path: Path) -> None:
    path = simulate(tmp_path / "e.mcap", robot="so101", variation="none", fps=20, seed=5)
    assert judged(path, "wrench_bears_the_hand", replace).level == "pass"

    def spoilt(c: Changed) -> Changed:
        carries = np.isin(c.columns.phase, ("lift", "transport", "lower"))
        return wrench(lambda rows: np.where(carries[:, None], share * rows, rows))(c)

    assert judged(path, "wrench_bears_the_hand", spoilt).level == "fail"
