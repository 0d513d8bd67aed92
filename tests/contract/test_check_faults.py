"""Faults, one at a time, in good recordings: each is caught by the check that is meant for it."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from support.check import Message, Spoilt, checked, flip_bits, level_of, rewrite_messages, simulate

from demorec.check.rows import matrices
from demorec.episode.episode import SuccessCheck
from demorec.mcap import channels, messages

Fault = Callable[[Spoilt], None]


@pytest.fixture(scope="session")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One pick-and-place without pictures."""
    return simulate(tmp_path_factory.mktemp("good") / "good.mcap", seed=7)


@pytest.fixture(scope="session")
def filmed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One pick-and-place with two cameras."""
    return simulate(tmp_path_factory.mktemp("filmed") / "filmed.mcap", seed=7, cameras=("front", "wrist"))


def test_the_good_ones_pass_without_a_warning(good: Path, filmed: Path) -> None:
    for path in (good, filmed):
        report = checked(path)
        assert [r for r in report.results if r.level in ("warn", "fail")] == []
        assert report.count("pass") > 25


# ------------------------------------------------------------------------------------------------- numbers


def shift(rows: np.ndarray[Any, Any], by: int) -> np.ndarray[Any, Any]:
    """Rows of `by` frames earlier (the first is repeated)."""
    return np.concatenate([np.repeat(rows[:1], by, axis=0), rows[:-by]])


def actions_one_frame_late(s: Spoilt) -> None:
    c = s.columns
    s.set(
        action_joint_target=shift(c.action_joint_target, 1),
        action_gripper=shift(c.action_gripper, 1),
        action_base_from_tcp=shift(c.action_base_from_tcp, 1),
    )


def commands_one_frame_late(s: Spoilt) -> None:
    c = s.columns
    s.set(
        command_joint_target=shift(c.command_joint_target, 1),
        command_base_from_tcp=shift(c.command_base_from_tcp, 1),
    )


def commands_one_frame_early(s: Spoilt) -> None:
    c = s.columns
    s.set(command_joint_target=shift(c.command_joint_target[::-1], 1)[::-1].copy())


def gripper_commands_late(s: Spoilt) -> None:
    # The opening moves before anybody asks for it.
    s.set(command_gripper=shift(s.columns.command_gripper, 6))


def swapped_joints(s: Spoilt) -> None:
    order = [1, 0, *range(2, s.columns.joint_position.shape[1])]
    s.set(joint_position=s.columns.joint_position[:, order])


def swapped_velocities(s: Spoilt) -> None:
    order = [1, 0, *range(2, s.columns.joint_velocity.shape[1])]
    s.set(joint_velocity=s.columns.joint_velocity[:, order])


def millimetres_for_metres(s: Spoilt) -> None:
    poses = s.columns.base_from_tcp.copy()
    poses[:, :3] *= 1000
    s.set(base_from_tcp=poses)


def quaternion_scalar_first(s: Spoilt) -> None:
    s.set(base_from_tcp=s.columns.base_from_tcp[:, [0, 1, 2, 6, 3, 4, 5]])


def object_quaternion_scalar_first(s: Spoilt) -> None:
    s.pose_of("red_cube", s.columns.object_poses["red_cube"][:, [0, 1, 2, 6, 3, 4, 5]])


def quaternions_of_another_length(s: Spoilt) -> None:
    poses = s.columns.object_poses["red_cube"].copy()
    poses[:, 3:] *= 1.01
    s.pose_of("red_cube", poses)


def pose_of_the_flange(s: Spoilt) -> None:
    poses = s.columns.base_from_tcp.copy()
    poses[:, 2] += 0.105
    s.set(base_from_tcp=poses)


def degrees_for_radians(s: Spoilt) -> None:
    s.set(joint_position=np.degrees(s.columns.joint_position))


def gripper_in_millimetres(s: Spoilt) -> None:
    s.set(gripper_width=s.columns.gripper_width * 1000)


def wrong_fps(s: Spoilt) -> None:
    s.info = replace(s.info, fps=24)


def random_actions(s: Spoilt) -> None:
    rng = np.random.default_rng(0)
    low, high = s.info.robot.position_lower, s.info.robot.position_upper
    s.set(action_joint_target=rng.uniform(low, high, s.columns.action_joint_target.shape))


def commands_of_another_motion(s: Spoilt) -> None:
    s.set(command_joint_target=s.columns.command_joint_target[::-1].copy())


def not_a_number(s: Spoilt) -> None:
    effort = s.columns.joint_effort.copy()
    effort[40, 3] = np.nan
    s.set(joint_effort=effort)


def wrench_not_a_number(s: Spoilt) -> None:
    wrench = s.columns.sensed["wrench"].copy()
    wrench[40, 5] = np.nan
    s.set(sensed={"wrench": wrench})


def wrench_of_the_load(s: Spoilt) -> None:
    # What the hand does to the arm, in place of what the arm does to the hand.
    s.set(sensed={"wrench": -s.columns.sensed["wrench"]})


def torque_before_force(s: Spoilt) -> None:
    s.set(sensed={"wrench": s.columns.sensed["wrench"][:, [3, 4, 5, 0, 1, 2]]})


def wrench_along_other_axes(s: Spoilt) -> None:
    s.set(sensed={"wrench": s.columns.sensed["wrench"][:, [2, 0, 1, 5, 3, 4]]})


def a_jump_while_untouched(s: Spoilt) -> None:
    poses = s.columns.object_poses["red_cube"].copy()
    poses[10:, 1] += 0.02
    s.pose_of("red_cube", poses)


def a_drift_while_untouched(s: Spoilt) -> None:
    poses = s.columns.object_poses["red_cube"].copy()
    poses[:30, 0] += np.linspace(-0.15, 0, 30)
    s.pose_of("red_cube", poses)


def a_jump_in_the_hand(s: Spoilt) -> None:
    poses = s.columns.object_poses["red_cube"].copy()
    middle = len(poses) // 2
    poses[middle : middle + 5, 0] += 0.12
    s.pose_of("red_cube", poses)


def sunk_into_the_table(s: Spoilt) -> None:
    poses = s.columns.object_poses["red_cube"].copy()
    poses[:, 2] -= 0.012
    s.pose_of("red_cube", poses)


def carried_without_a_grip(s: Spoilt) -> None:
    s.set(contact_force=np.zeros_like(s.columns.contact_force))


def carried_by_an_open_hand(s: Spoilt) -> None:
    fingers = np.full_like(s.columns.joint_position[:, -2:], 0.001)
    s.set(
        joint_position=np.concatenate([s.columns.joint_position[:, :-2], fingers], axis=1),
        gripper_width=fingers.sum(axis=1),
    )


def held(s: Spoilt) -> NDArray[np.bool_]:
    """(T,) whether the cube is lifted and carried."""
    return np.isin(s.columns.phase, ["lift", "transport"])


def fingers_in_the_cube(s: Spoilt) -> None:
    joints = s.columns.joint_position.copy()
    joints[held(s), -2:] -= 0.0025
    s.set(joint_position=joints, gripper_width=joints[:, -2:].sum(axis=1))


def a_cube_beside_the_middle_of_the_fingers(s: Spoilt) -> None:
    poses = s.columns.object_poses["red_cube"].copy()
    rows = np.flatnonzero(held(s))
    hands = matrices(s.columns.base_from_tcp[rows])  # the robot's base is the origin of the world
    poses[rows, :3] += 0.003 * hands[:, :3, 1]
    s.pose_of("red_cube", poses)


def long_standstill(s: Spoilt) -> None:
    still = [len(s.frames) - 1] * (len(s.frames) * 2)
    s.frames = s.frames + still
    velocity = s.columns.joint_velocity.copy()
    velocity[-1] = 0.0
    s.set(joint_velocity=velocity)


def a_velocity_spike(s: Spoilt) -> None:
    velocity = s.columns.joint_velocity.copy()
    velocity[60, 2] = 9.0
    s.set(joint_velocity=velocity)


def trembling_labels(s: Spoilt) -> None:
    targets = s.columns.action_joint_target.copy()
    targets[::2] += 0.02
    s.set(action_joint_target=targets)


def trembling_velocities(s: Spoilt) -> None:
    velocity = s.columns.joint_velocity.copy()
    velocity[40:60:2, 0] += 8.0
    velocity[41:60:2, 0] -= 8.0
    s.set(joint_velocity=velocity)


def success_that_was_none(s: Spoilt) -> None:
    assert s.outcome is not None
    failed = SuccessCheck(name="tilt", value=1.2, limit=0.087, unit="rad", passed=False)
    s.outcome = replace(s.outcome, checks=(*s.outcome.checks, failed))


def failure_without_a_reason(s: Spoilt) -> None:
    assert s.outcome is not None
    s.outcome = replace(s.outcome, success=False)


def end_of_another_episode(s: Spoilt) -> None:
    poses = s.columns.object_poses["red_cube"].copy()
    poses[-3:, 0] += 0.05
    s.pose_of("red_cube", poses)


def still_rolling_in_the_end(s: Spoilt) -> None:
    poses = s.columns.object_poses["red_cube"].copy()
    poses[-5:, 0] += 0.004 * np.arange(5)
    s.pose_of("red_cube", poses)


def cut_off_in_mid_motion(s: Spoilt) -> None:
    s.frames = s.frames[: len(s.frames) * 3 // 5]


NUMBERS: list[tuple[Fault, str]] = [
    (actions_one_frame_late, "action_lag"),
    (commands_one_frame_late, "command_lag"),
    (commands_one_frame_early, "command_lag"),
    (gripper_commands_late, "gripper_lag"),
    (swapped_joints, "forward_kinematics"),
    (swapped_velocities, "velocity_matches_position"),
    (millimetres_for_metres, "forward_kinematics"),
    (quaternion_scalar_first, "forward_kinematics"),
    (pose_of_the_flange, "forward_kinematics"),
    (object_quaternion_scalar_first, "starts_as_scene_says"),
    (quaternions_of_another_length, "unit_quaternions"),
    (degrees_for_radians, "joint_limits"),
    (gripper_in_millimetres, "gripper_width"),
    (wrong_fps, "velocity_matches_position"),
    (random_actions, "action_lag"),
    (random_actions, "action_matches_command"),
    (commands_of_another_motion, "command_tracking"),
    (not_a_number, "finite_numbers"),
    (wrench_not_a_number, "finite_numbers"),
    (wrench_of_the_load, "wrench_holds_the_hand"),
    (torque_before_force, "wrench_holds_the_hand"),
    (wrench_along_other_axes, "wrench_holds_the_hand"),
    (a_jump_while_untouched, "object_motion"),
    (a_drift_while_untouched, "object_motion"),
    (a_jump_in_the_hand, "teleports"),
    (sunk_into_the_table, "penetration"),
    (carried_without_a_grip, "carried_by_gripper"),
    (carried_by_an_open_hand, "carried_by_gripper"),
    (fingers_in_the_cube, "finger_depth"),
    (a_cube_beside_the_middle_of_the_fingers, "finger_depth"),
    (long_standstill, "idle_frames"),
    (a_velocity_spike, "joint_speed"),
    (trembling_labels, "action_acceleration"),
    (trembling_velocities, "joint_acceleration"),
    (success_that_was_none, "outcome_consistent"),
    (failure_without_a_reason, "outcome_consistent"),
    (end_of_another_episode, "final_state"),
    (still_rolling_in_the_end, "at_rest_in_the_end"),
    (cut_off_in_mid_motion, "final_state"),
]


@pytest.mark.parametrize(("fault", "check"), NUMBERS, ids=[f"{f.__name__}-{c}" for f, c in NUMBERS])
def test_spoilt_numbers(fault: Fault, check: str, good: Path, tmp_path: Path) -> None:
    assert level_of(good, check) == "pass"
    spoilt = Spoilt(good)
    fault(spoilt)
    assert level_of(spoilt.write(tmp_path / "spoilt.mcap"), check) == "fail"


# ------------------------------------------------------------------------------------------------- the file


def test_a_truncated_file(good: Path, tmp_path: Path) -> None:
    data = good.read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: len(data) // 2])
    report = checked(tmp_path / "cut.mcap")
    assert report.level == "fail"
    assert report.results[0].check == "opens"
    assert report.results[0].level == "fail"
    assert all(result.level == "skip" for result in report.results[1:])


@pytest.mark.parametrize("place", [0.2, 0.5, 0.8])
def test_flipped_bits(place: float, good: Path, tmp_path: Path) -> None:
    size = good.stat().st_size
    spoilt = flip_bits(good, tmp_path / "flipped.mcap", offset=int(size * place))
    assert checked(spoilt, only=["opens", "checksums"]).level == "fail"


def test_an_index_with_flipped_bits(good: Path, tmp_path: Path) -> None:
    assert level_of(flip_bits(good, tmp_path / "flipped.mcap", offset=-200), "opens") == "fail"


def test_a_missing_topic(good: Path, tmp_path: Path) -> None:
    spoilt = rewrite_messages(good, tmp_path / "s.mcap", lambda m: [] if m[0] == channels.ACTION else [m])
    assert level_of(spoilt, "topics") == "fail"
    assert level_of(spoilt, "readable") == "fail"


def test_a_lost_message(good: Path, tmp_path: Path) -> None:
    def edit(m: Message) -> list[Message]:
        return [] if m[0] == channels.COMMAND and m[3] == 2_000_000_000 else [m]

    assert level_of(rewrite_messages(good, tmp_path / "s.mcap", edit), "topics") == "fail"


def test_times_that_are_off(good: Path, tmp_path: Path) -> None:
    def edit(m: Message) -> list[Message]:
        late = m[0] == channels.GRIPPER and m[3] > 1_000_000_000
        return [(m[0], m[1], m[2], m[3] + 1_000_000)] if late else [m]

    spoilt = rewrite_messages(good, tmp_path / "s.mcap", edit)
    assert level_of(spoilt, "frame_times") == "fail"


def test_stale_stamps(good: Path, tmp_path: Path) -> None:
    def edit(m: Message) -> list[Message]:
        if m[0] != channels.EE_POSE or m[3] < 1_000_000_000:
            return [m]
        return [(m[0], m[1], m[2][:4] + struct.pack("<iI", 1, 0) + m[2][12:], m[3])]

    spoilt = rewrite_messages(good, tmp_path / "s.mcap", edit)
    assert level_of(spoilt, "stamps") == "fail"
    assert level_of(spoilt, "frame_times") == "pass"


def test_other_joint_names(good: Path, tmp_path: Path) -> None:
    def edit(m: Message) -> list[Message]:
        return [(m[0], m[1], m[2].replace(b"panda_joint3", b"panda_jointX"), m[3])]

    assert level_of(rewrite_messages(good, tmp_path / "s.mcap", edit), "readable") == "fail"


def test_a_recovered_recording_is_a_warning(good: Path, tmp_path: Path) -> None:
    from demorec.mcap import recover

    part = tmp_path / "cut.mcap.part"
    part.write_bytes(good.read_bytes()[: int(good.stat().st_size * 0.7)])
    recover(part, tmp_path / "cut.mcap")
    assert level_of(tmp_path / "cut.mcap", "complete") == "warn"


def test_joint_states_off_the_physics_clock(tmp_path: Path) -> None:
    fine = simulate(tmp_path / "fine.mcap", seed=7, joint_rate="physics")
    assert level_of(fine, "joint_sample_times") == "pass"
    frames = {index * 1_000_000_000 // 30 for index in range(400)}

    def edit(m: Message) -> list[Message]:
        between = m[0] == channels.JOINT_STATES and all(abs(m[3] - time) > 1000 for time in frames)
        return [] if between and 1_000_000_000 < m[3] < 1_020_000_000 else [m]

    assert level_of(rewrite_messages(fine, tmp_path / "s.mcap", edit), "joint_sample_times") == "fail"


# ------------------------------------------------------------------------------------------------- pictures


def upside_down(s: Spoilt) -> None:
    s.picture("front", lambda t, p: p[::-1])


def mirrored(s: Spoilt) -> None:
    s.picture("front", lambda t, p: p[:, ::-1])


def mirrored_wrist(s: Spoilt) -> None:
    s.picture("wrist", lambda t, p: p[:, ::-1])


def blue_for_red(s: Spoilt) -> None:
    for camera in ("front", "wrist"):
        s.picture(camera, lambda t, p: p[..., ::-1])


def names_exchanged(s: Spoilt) -> None:
    front = [images["front"].color for images in s.pictures]
    wrist = [images["wrist"].color for images in s.pictures]
    s.picture("front", lambda t, p: wrist[t])
    s.picture("wrist", lambda t, p: front[t])


def one_camera_twice(s: Spoilt) -> None:
    front = [images["front"].color for images in s.pictures]
    s.picture("wrist", lambda t, p: front[t])


def other_field_of_view(s: Spoilt) -> None:
    cameras = tuple(replace(camera, fov_y=camera.fov_y * 0.7) for camera in s.info.scene.cameras)
    s.info = replace(s.info, scene=replace(s.info.scene, cameras=cameras))


def shifted_pictures(s: Spoilt) -> None:
    s.picture("front", lambda t, p: np.roll(p, 10, axis=1))


def frozen_camera(s: Spoilt) -> None:
    first = s.pictures[40]["wrist"].color
    s.picture("wrist", lambda t, p: first if 40 <= t < 60 else p)


def dropped_pictures(s: Spoilt) -> None:
    before = [images["wrist"].color for images in s.pictures]
    s.picture("wrist", lambda t, p: before[t - 1] if t in (14, 20, 26, 32, 38, 104, 110, 116, 122) else p)


def black_pictures(s: Spoilt) -> None:
    s.picture("front", lambda t, p: p * 0 if 30 <= t < 33 else p)


def white_pictures(s: Spoilt) -> None:
    s.picture("front", lambda t, p: p * 0 + 255 if t > 100 else p)


def burnt_pictures(s: Spoilt) -> None:
    s.picture(
        "front",
        lambda t, p: np.where(np.arange(p.shape[1])[None, :, None] < p.shape[1] * 0.97, 255, p).astype(np.uint8),
    )


def pictures_two_frames_late(s: Spoilt) -> None:
    for camera in ("front", "wrist"):
        before = [images[camera].color for images in s.pictures]
        s.picture(camera, lambda t, p, before=before: before[max(t - 2, 0)])  # type: ignore[misc]


def pictures_one_frame_late(s: Spoilt) -> None:
    before = [images["wrist"].color for images in s.pictures]
    s.picture("wrist", lambda t, p: before[max(t - 1, 0)])


def extrinsics_of_another_place(s: Spoilt) -> None:
    poses = {name: rows.copy() for name, rows in s.columns.world_from_camera.items()}
    poses["front"][:, 1] += 0.02
    s.set(world_from_camera=poses)


def camera_axes_of_opengl(s: Spoilt) -> None:
    # y up and z backward: half a turn about x.
    poses = {name: rows.copy() for name, rows in s.columns.world_from_camera.items()}
    x, y, z, w = poses["front"][:, 3:].T
    poses["front"][:, 3:] = np.stack([w, z, -y, -x], axis=1)
    s.set(world_from_camera=poses)


PICTURES: list[tuple[Fault, str]] = [
    (upside_down, "projection"),
    (mirrored, "projection"),
    # Not projection: what the hand goes for and holds is in the middle of the wrist's pictures.
    (mirrored_wrist, "pictures_as_drawn"),
    (blue_for_red, "projection"),
    (names_exchanged, "projection"),
    (shifted_pictures, "projection"),
    (one_camera_twice, "distinct_cameras"),
    (other_field_of_view, "projected_size"),
    (frozen_camera, "frozen"),
    (dropped_pictures, "repeated_pictures"),
    (black_pictures, "pictures_exposed"),
    (white_pictures, "pictures_exposed"),
    (burnt_pictures, "exposure"),
    (pictures_two_frames_late, "picture_lag"),
    (pictures_one_frame_late, "picture_lag"),
    (extrinsics_of_another_place, "extrinsics"),
    (camera_axes_of_opengl, "extrinsics"),
]


def pictures_with_slow_ones() -> Iterator[Any]:
    """Each fault with its check; of a check's faults the first one is quick enough to stand for it in `make test`."""
    known = set[str]()
    for fault, check in PICTURES:
        marks = pytest.mark.slow if check in known else ()
        known.add(check)
        yield pytest.param(fault, check, id=f"{fault.__name__}-{check}", marks=marks)


@pytest.mark.parametrize(("fault", "check"), pictures_with_slow_ones())
def test_spoilt_pictures(fault: Fault, check: str, filmed: Path, tmp_path: Path) -> None:
    spoilt = Spoilt(filmed)
    fault(spoilt)
    assert level_of(spoilt.write(tmp_path / "spoilt.mcap"), check) == "fail"


def test_decoding_and_coding_again_alone_is_no_fault(filmed: Path, tmp_path: Path) -> None:
    # What the faults above do besides their fault.
    assert checked(Spoilt(filmed).write(tmp_path / "again.mcap")).level == "pass"


def test_a_wrong_k(filmed: Path, tmp_path: Path) -> None:
    def edit(m: Message) -> list[Message]:
        if m[0] != channels.camera_topic("front", "camera_info"):
            return [m]
        k = messages.read_camera_info(m[2]).intrinsics
        old, new = struct.pack("<d", k[0, 2]), struct.pack("<d", k[0, 2] * 1.2)
        return [(m[0], m[1], m[2].replace(old, new), m[3])]

    spoilt = rewrite_messages(filmed, tmp_path / "s.mcap", edit)
    assert level_of(spoilt, "intrinsics") == "fail"
    assert level_of(spoilt, "projection") == "fail"


def test_a_lost_packet(filmed: Path, tmp_path: Path) -> None:
    topic = channels.video_topic("front", "h264")

    def edit(m: Message) -> list[Message]:
        return [] if m[0] == topic and m[3] == 2_000_000_000 else [m]

    spoilt = rewrite_messages(filmed, tmp_path / "s.mcap", edit)
    assert level_of(spoilt, "video_frames") == "fail"


def test_a_video_that_does_not_decode(filmed: Path, tmp_path: Path) -> None:
    topic = channels.video_topic("front", "h264")
    rng = np.random.default_rng(0)

    def edit(m: Message) -> list[Message]:
        if m[0] != topic or m[3] < 3_000_000_000:
            return [m]
        # The bytes of the picture come last; what tells where they begin stays.
        return [(m[0], m[1], m[2][:-300] + rng.integers(0, 255, 300, dtype=np.uint8).tobytes(), m[3])]

    assert level_of(rewrite_messages(filmed, tmp_path / "s.mcap", edit), "pictures_decode") == "fail"


def test_histograms_of_the_other_camera(filmed: Path, tmp_path: Path) -> None:
    topics = [channels.camera_topic(name, "histogram") for name in ("front", "wrist")]

    def edit(m: Message) -> list[Message]:
        return [(topics[1 - topics.index(m[0])], *m[1:])] if m[0] in topics else [m]

    assert level_of(rewrite_messages(filmed, tmp_path / "s.mcap", edit), "pixel_statistics") == "fail"


@pytest.mark.slow
def test_depth_and_segmentation(tmp_path: Path) -> None:
    fine = simulate(tmp_path / "f.mcap", seed=7, cameras=("front",), depth=True, segmentation=True)
    assert level_of(fine, "depth_matches_scene") == "pass"
    assert level_of(fine, "segmentation_matches_scene") == "pass"
    faults: dict[str, Callable[[Any], Any]] = {
        "millimetres": lambda i: replace(i, depth=np.minimum(i.depth * 10, 60).astype(np.float32)),
        "upside down": lambda i: replace(i, depth=i.depth[::-1].copy()),
        "mirrored labels": lambda i: replace(i, segmentation=i.segmentation[::-1, ::-1].copy()),
    }
    for name, change in faults.items():
        spoilt = Spoilt(fine)
        spoilt.pictures = [{camera: change(image) for camera, image in images.items()} for images in spoilt.pictures]
        check = "segmentation_matches_scene" if "labels" in name else "depth_matches_scene"
        assert level_of(spoilt.write(tmp_path / f"{name}.mcap"), check) == "fail", name


def test_the_wrong_angle_of_a_quaternion_is_measured_in_radians() -> None:
    # Independent of any recording: the measure behind the kinematic checks.
    from demorec.check.rows import angle_between, matrices

    a = matrices(np.array([[0, 0, 0, 0, 0, 0, 1.0]]))
    b = matrices(np.array([[0, 0, 0, 0, 0, math.sin(0.05), math.cos(0.05)]]))
    assert angle_between(a, b)[0] == pytest.approx(0.1, abs=1e-12)
