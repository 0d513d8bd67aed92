"""Faults of one episode among others, and of actions that are no targets, in datasets of which only names are known."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage
from support import loose
from support.check import level_of, simulate_run
from support.dataset_edits import (
    FRONT,
    WRIST,
    alike,
    blurred,
    both,
    columns,
    film,
    frozen,
    halved,
    late,
    numbers,
    pixels,
    stats,
)
from support.dataset_particular import held, repeats
from support.export import export
from support.foreign_dataset import write_foreign
from support.params import first_of_each_kind

pytestmark = pytest.mark.slow

Fault = Callable[[Path], None]
Images = NDArray[Any]
WORLD = "observation.environment_state"
LAWS = (
    "actions_go_with_states", "motion_follows_action", "whole_episodes", "velocity_matches_position", "missing_frames",
    "mounts_alike", "encoder_steps", "quaternions_keep_sign", "duplicates", "effort_lag", "same_by_name",
    "action_steps", "repeated_frames", "steps_as_velocities", "effort_matches_dynamics", "actions_agree",
)  # fmt: skip


@pytest.fixture(scope="module")
def increments(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four episodes of increments, nothing of demorec beside them."""
    folder = tmp_path_factory.mktemp("likeness")
    run = simulate_run(folder / "run", 4, seed=3, fps=10, cameras=())
    features = tuple(f"observation.{name}" for name in ("velocity", "effort", "ee_pose", "environment_state"))
    export(run, folder / "dataset", action="joint_increment", features=(*features, "next.done"), privileged=True)
    shutil.rmtree(folder / "dataset" / "demorec")
    return folder / "dataset"


def cut_off(dataset: Path) -> None:
    parts = [np.arange(part.start, part.stop) for part in loose.parts_of(dataset)]
    loose.reframe(dataset, [parts[0], parts[1][: 2 * len(parts[1]) // 3], *parts[2:]])


def at_half_the_rate(dataset: Path) -> None:
    parts = [np.arange(part.start, part.stop) for part in loose.parts_of(dataset)]
    loose.reframe(dataset, [parts[0], parts[1][::2], *parts[2:]])


def without_a_second(dataset: Path) -> None:
    parts = [np.arange(part.start, part.stop) for part in loose.parts_of(dataset)]
    loose.reframe(dataset, [parts[0], np.delete(parts[1], range(29, 39)), *parts[2:]])


def filled_up(dataset: Path) -> None:
    parts = [np.arange(part.start, part.stop) for part in loose.parts_of(dataset)]
    loose.reframe(dataset, [parts[0], np.concatenate([np.repeat(parts[1][:1], 20), parts[1]]), *parts[2:]])


def twice(dataset: Path) -> None:
    parts = [np.arange(part.start, part.stop) for part in loose.parts_of(dataset)]
    loose.reframe(dataset, [parts[0], parts[0][:-1], *parts[2:]])


def with_a_piece_twice(dataset: Path) -> None:
    parts = [np.arange(part.start, part.stop) for part in loose.parts_of(dataset)]
    loose.reframe(dataset, [np.concatenate([parts[0][:40], parts[0][25:]]), *parts[1:]])


def other_sign(poses: Images) -> Images:
    """The same poses, with the quaternions from the 20th on negated."""
    return np.concatenate([poses[:20], poses[20:] * [1, 1, 1, -1, -1, -1, -1]])


FAULTS: dict[str, tuple[Fault, str, str]] = {
    "zeros for the actions of one episode": (
        numbers("action", np.zeros_like, only=(1,)), "actions_go_with_states", "fail"
    ),
    "actions of one episode backwards": (
        numbers("action", lambda rows: rows[::-1], only=(2,)), "actions_go_with_states", "fail"
    ),
    "actions eight frames late": (numbers("action", lambda rows: late(rows, 8)), "motion_follows_action", "fail"),
    "a joint's actions of the other sign": (
        numbers("action", lambda rows: columns(rows, 3, np.negative)), "motion_follows_action", "fail"
    ),
    "a joint's actions of the other sign in one episode": (
        numbers("action", lambda rows: columns(rows, 3, np.negative), only=(2,)), "actions_agree", "fail"
    ),
    "a joint's actions left out in one episode": (
        numbers("action", lambda rows: columns(rows, 1, np.zeros_like), only=(0,)), "actions_agree", "fail"
    ),
    "torques four frames late": (
        numbers("observation.effort", lambda rows: late(rows, 4)), "effort_lag", "warn"
    ),
    "objects of another episode": (
        lambda dataset: loose.put_rows(dataset, WORLD, loose.rows_of(dataset, WORLD)[::-1]), "same_by_name", "warn"
    ),
    "objects that never move": (numbers(WORLD, lambda rows: 0 * rows + rows[:1]), "same_by_name", "warn"),
    "a zero that is moved in one episode": (
        numbers("observation.state", lambda rows: rows + 0.1 * (np.arange(8) == 1), only=(2,)), "mounts_alike", "warn"
    ),
    "a gripper that nobody tells to close": (
        numbers("action", lambda rows: columns(rows, -1, lambda width: 0 * width + 0.08)), "elements_alive", "fail"
    ),
    "an encoder of eight bits": (
        numbers("observation.state", lambda rows: np.round(rows * 40) / 40), "encoder_steps", "warn"
    ),
    "a quaternion that becomes its own negative": (
        numbers("observation.ee_pose", other_sign),
        "quaternions_keep_sign",
        "warn",
    ),
    "an episode that was filled up in front": (filled_up, "whole_episodes", "warn"),
    "an episode that was cut off": (cut_off, "whole_episodes", "warn"),
    "an episode twice, once without its last row": (twice, "duplicates", "fail"),
    "a piece of an episode twice": (with_a_piece_twice, "duplicates", "fail"),
    "a second that is missing": (without_a_second, "missing_frames", "warn"),
    "a second that is missing, by velocities": (without_a_second, "steps_as_velocities", "fail"),
    "rows that were lost and held": (
        alike(
            lambda rows: frozen(rows, len(rows) // 6, 8),
            "action", *(f"observation.{name}" for name in ("state", "velocity", "effort", "ee_pose")), only=(1,),
        ),
        "repeated_frames",
        "warn",
    ),
    "torques of half the size in one episode": (
        numbers("observation.effort", lambda rows: rows / 2, only=(1,)), "effort_matches_dynamics", "warn"
    ),
    "another tool in half of the episodes": (
        numbers("observation.ee_pose", lambda rows: rows + 0.1 * (np.arange(7) == 2), only=(0, 1)),
        "mounts_alike",
        "warn",
    ),
    "increments of a few bits": (
        numbers("action", lambda rows: np.round(rows * 20) / 20), "action_steps", "warn"
    ),
    "an episode of half the rate": (at_half_the_rate, "velocity_matches_position", "fail"),
}  # fmt: skip


def test_good_ones_pass(increments: Path) -> None:
    assert [level_of(increments, law, "dataset") for law in LAWS] == ["pass"] * len(LAWS)


def test_a_gripper_that_is_not_used_may_tremble(increments: Path, tmp_path: Path) -> None:
    dataset = Path(shutil.copytree(increments, tmp_path / "dataset"))
    numbers("action", lambda rows: columns(rows, -1, lambda width: 0 * width + 0.08))(dataset)
    noise = np.random.default_rng(0)
    numbers("observation.state", lambda rows: columns(rows, -1, lambda w: noise.normal(0.08, 3e-4, w.shape)))(dataset)
    assert level_of(dataset, "elements_alive", "dataset") == "pass"


@pytest.mark.parametrize("name", first_of_each_kind(FAULTS, 1))
def test_one_episode_unlike_the_others(name: str, increments: Path, tmp_path: Path) -> None:
    fault, law, level = FAULTS[name]
    dataset = Path(shutil.copytree(increments, tmp_path / "dataset"))
    fault(dataset)
    assert level_of(dataset, law, "dataset") == level


VIEWS = (
    "steady_sharpness",
    "stray_images",
    "image_cuts",
    "images_stay_upright",
    "exchanged_cameras",
    "distinct_cameras",
    "dataset_image_statistics",
    "views_upright",
    "views_alike",
    "views_stay",
    "stale_images",
    "frozen_images",
    "films_differ",
    "gripper_follows",
    "action_is_no_observation",
    "interpolated_images",
    "offsets_alike",
    "targets_as_named",
)
FAILS = (
    "frozen_images",
    "gripper_follows",
    "images_stay_upright",
    "exchanged_cameras",
    "distinct_cameras",
    "dataset_image_statistics",
    "stray_images",
)


@pytest.fixture(scope="module")
def filmed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ten episodes with two cameras, nothing of demorec beside them."""
    folder = tmp_path_factory.mktemp("filmed")
    cameras = ("front", "wrist")
    run = simulate_run(folder / "run", 10, robot="so101", variation="mild", seed=3601, fps=20, cameras=cameras)
    export(run, folder / "dataset")
    shutil.rmtree(folder / "dataset" / "demorec")
    return folder / "dataset"


def one_film_twice(dataset: Path) -> None:
    images, parts = loose.images_of(dataset, WRIST), loose.parts_of(dataset)
    count = min(part.stop - part.start for part in parts[1:3])
    images[parts[2].start : parts[2].start + count] = images[parts[1].start : parts[1].start + count]
    loose.put_images(dataset, WRIST, images)


def states_for_actions(dataset: Path) -> None:
    actions, part = loose.rows_of(dataset, "action"), loose.parts_of(dataset)[1]
    actions[part] = loose.rows_of(dataset, "observation.state")[part]
    loose.put_rows(dataset, "action", actions)


def bars(images: Images) -> Images:
    images[:, :12] = images[:, -12:] = 0
    return images


def gray(images: Images) -> Images:
    return np.repeat(images.mean(axis=3, keepdims=True), 3, axis=3)


def of_another_moment(images: Images) -> Images:
    images[-8] = images[len(images) // 2]
    return images


def nearly_the_same_colours(dataset: Path) -> None:
    """Brighter by seven levels: little more than encoding and a sample of the images make of them."""
    loose.put_images(dataset, WRIST, (np.minimum(loose.images_of(dataset, FRONT), 248) + 7).astype(np.uint8))
    assert level_of(dataset, "dataset_image_statistics", "dataset") == "pass"
    stats(lambda data: data.update({FRONT: data[WRIST], WRIST: data[FRONT]}))(dataset)


FILMED_FAULTS: dict[str, tuple[Fault, str]] = {
    "a camera that hangs upside down in one episode": (film(FRONT, lambda r: r[:, ::-1, ::-1]), "views_alike"),
    "red for blue in one episode": (film(WRIST, lambda r: r[..., ::-1]), "views_upright"),
    "a wrist camera that hangs upside down in one episode": (film(WRIST, lambda r: r[:, ::-1, ::-1]), "views_upright"),
    "a focus that is lost for a second": (
        film(FRONT, lambda r: np.concatenate([r[:20], blurred(r[20:40]), r[40:]])), "steady_sharpness"
    ),
    "gray images from the middle of an episode on": (
        film(FRONT, pixels(lambda r: np.concatenate([r[: len(r) // 2], gray(r[len(r) // 2 :])])), only=(3,)),
        "images_stay_upright",
    ),
    "a camera that is tilted from the sixth episode on": (
        film(FRONT, lambda r: np.roll(r, 24, axis=1), only=range(5, 10)), "views_stay"
    ),
    "a gain in one episode": (film(FRONT, pixels(lambda r: 0.7 * r)), "views_alike"),
    "increments that are called positions": (
        numbers("action", lambda r: np.diff(r, axis=0, prepend=r[:1])), "targets_as_named"
    ),
    "a leader that drifts in one episode": (
        numbers("action", lambda r: r + np.linspace(0, 0.6, len(r))[:, None] * (np.arange(6) == 1), only=(1,)),
        "offsets_alike",
    ),
    "a tenth of the images repeats the one before": (
        film(WRIST, lambda r: repeats(r, 10), only=None), "stale_images"
    ),
    "a camera that hangs for two seconds": (film(WRIST, lambda r: frozen(r, 30, 40)), "frozen_images"),
    "a camera of a third of the rate": (film(FRONT, lambda r: held(r, 3), only=None), "stale_images"),
    "one film in two episodes": (one_film_twice, "films_differ"),
    "bars of black in one episode": (film(WRIST, bars), "views_upright"),
    "a gripper that sticks": (
        numbers("observation.state", lambda r: columns(r, -1, lambda w: 0 * w + w[0]), only=(1,)), "gripper_follows"
    ),
    "a gripper that is told the contrary": (
        numbers("action", lambda r: columns(r, -1, lambda w: w.max() + w.min() - w), only=(1,)), "gripper_follows"
    ),
    "actions that are the states of one episode": (states_for_actions, "action_is_no_observation"),
    "cameras exchanged in one episode": (both(lambda a, b: (b, a)), "exchanged_cameras"),
    "one camera under both names in one episode": (both(lambda a, b: (a, a)), "distinct_cameras"),
    "a camera that is hit": (
        film(FRONT, lambda r: np.concatenate([r[:30], np.roll(r[30:], 24, axis=1)])), "image_cuts"
    ),
    "a last image from elsewhere": (
        film(FRONT, lambda r: np.concatenate([r[:-1], np.roll(r[-1:], 24, axis=1)])), "image_cuts"
    ),
    "an image of another moment, by a camera that stands": (film(FRONT, of_another_moment), "stray_images"),
    "gray images in one episode": (film(FRONT, pixels(gray)), "views_upright"),
    "statistics of two cameras exchanged": (
        stats(lambda data: data.update({FRONT: data[WRIST], WRIST: data[FRONT]})), "dataset_image_statistics"
    ),
    "statistics of two cameras exchanged that show nearly the same colours": (
        nearly_the_same_colours, "dataset_image_statistics"
    ),
    "every second image is made of its neighbours": (
        film(FRONT, lambda r: halved(r.astype(np.float32)), only=None), "interpolated_images"
    ),
}  # fmt: skip


def test_good_targets_and_images_pass(filmed: Path) -> None:
    assert [level_of(filmed, law, "dataset") for law in VIEWS] == ["pass"] * len(VIEWS)


@pytest.mark.parametrize("name", first_of_each_kind(FILMED_FAULTS, 1))
def test_targets_and_images_unlike_the_others(name: str, filmed: Path, tmp_path: Path) -> None:
    fault, law = FILMED_FAULTS[name]
    dataset = Path(shutil.copytree(filmed, tmp_path / "dataset"))
    fault(dataset)
    assert level_of(dataset, law, "dataset") == ("fail" if law in FAILS else "warn")


@pytest.mark.long
def test_a_fixed_camera_that_turned_by_five_degrees_before_one_episode(tmp_path: Path) -> None:
    """Most of what it shows, a floor and a table, looks the same."""
    run = simulate_run(tmp_path / "run", 5, variation="none", seed=3601, fps=10, cameras=("front",))
    export(run, tmp_path / "dataset")
    assert level_of(tmp_path / "dataset", "views_alike", "dataset") == "pass"
    film(FRONT, lambda r: ndimage.rotate(r, 5, axes=(1, 2), reshape=False, order=1, mode="nearest"))(
        tmp_path / "dataset"
    )
    assert level_of(tmp_path / "dataset", "views_alike", "dataset") == "warn"


@pytest.mark.long
def test_noise_moves_the_course_of_increments_by_more_than_a_frame_or_two(tmp_path: Path) -> None:
    """At 48 frames a second by four; what is two frames early is by six."""
    run = simulate_run(tmp_path / "run", 8, task="tutorial", variation="full", seed=84301, fps=48, cameras=())
    export(run, tmp_path / "dataset", action="ee_delta", features=("observation.ee_pose",))
    assert level_of(tmp_path / "dataset", "dataset_action_lag", "dataset") == "pass"
    numbers("action", lambda r: late(r, -2), only=None)(tmp_path / "dataset")
    assert level_of(tmp_path / "dataset", "dataset_action_lag", "dataset") == "fail"


def falls_away(images: Images) -> Images:
    """Something that covers half of the image, and is gone within three frames."""
    width, images = images.shape[2], images.copy()
    for rows, share in ((slice(0, 30), 0.5), (slice(30, 31), 0.3), (slice(31, 32), 0.1)):
        images[rows, :, : int(share * width)] = (200, 20, 20)
    return images


def plain_for_a_while(images: Images) -> Images:
    """A view that fades into nothing, and little by little shows something again."""
    shown = np.interp(np.arange(len(images)), [20, 30, 55, 75], [1, 0, 0, 1])[:, None, None, None]
    noise = np.random.default_rng(1).normal(0, 1.0, images.shape)
    return np.asarray(shown * images + (1 - shown) * (120 + noise))


def test_a_camera_that_sees_nothing_for_a_while_does_not_hang(filmed: Path, tmp_path: Path) -> None:
    dataset = Path(shutil.copytree(filmed, tmp_path / "dataset"))
    film(WRIST, plain_for_a_while)(dataset)
    assert level_of(dataset, "frozen_images", "dataset") == "pass"


def test_what_falls_away_before_a_camera_is_no_cut(filmed: Path, tmp_path: Path) -> None:
    dataset = Path(shutil.copytree(filmed, tmp_path / "dataset"))
    film(FRONT, falls_away)(dataset)
    assert level_of(dataset, "image_cuts", "dataset") == "pass"


def test_views_of_different_instructions_are_not_compared(filmed: Path, tmp_path: Path) -> None:
    dataset = Path(shutil.copytree(filmed, tmp_path / "dataset"))
    loose.put_rows(dataset, "task_index", loose.rows_of(dataset, "episode_index"))
    assert [level_of(dataset, law, "dataset") for law in ("views_alike", "views_stay")] == ["skip", "skip"]


def test_a_joint_that_only_trembles_does_not_move_the_other_way(tmp_path: Path) -> None:
    """Its increments take back the noise of the frame before."""
    run = simulate_run(tmp_path / "run", 3, task="tutorial", robot="iiwa", variation="mild", seed=654866, fps=15)
    export(run, tmp_path / "dataset", action="joint_increment")
    assert level_of(tmp_path / "dataset", "motion_follows_action", "dataset") == "pass"


def test_a_quick_gripper_and_a_rotation_of_the_other_sign_miss_no_frame(tmp_path: Path) -> None:
    """Two fingers shut within a frame of ten a second; a hand that points down turns its quaternion's sign."""

    def rows(moment: NDArray[Any]) -> dict[str, Any]:
        tilt, signs = 1e-5 * np.cos(moment), np.where(moment > 2, -1, 1)
        left = 0.04 - 0.01 * (moment > 1)
        quaternion = (np.cos(0.1 * np.sin(moment)), np.sin(0.1 * np.sin(moment)), tilt, np.abs(tilt))
        return {
            "x": 0.2 * np.sin(moment),
            "y": 0.1 * np.cos(moment),
            "left_finger": left,
            "right_finger": left + 1e-5 * moment,
            **{f"rotation.{axis}": signs * values for axis, values in zip("xyzw", quaternion, strict=True)},
        }

    moments = np.linspace(0, 3, 80)
    write_foreign(tmp_path / "good", length=80, episodes=1, state=rows(moments))
    assert level_of(tmp_path / "good", "missing_frames", "dataset") == "pass"
    write_foreign(tmp_path / "gap", length=60, episodes=1, state=rows(np.delete(moments, range(40, 60))))
    assert level_of(tmp_path / "gap", "missing_frames", "dataset") == "fail"


def test_an_arm_that_begins_to_move_has_no_dead_band(tmp_path: Path) -> None:
    """What is sent to an arm at rest is 0.02 rad away within one frame of ten a second."""
    run = simulate_run(tmp_path / "run", 3, robot="so101", variation="mild", seed=3604, fps=10)
    export(run, tmp_path / "dataset")
    assert level_of(tmp_path / "dataset", "dead_band", "dataset") == "pass"


def test_an_so101_in_metres_is_known_by_its_names(tmp_path: Path) -> None:
    """LeRobot's own arms call the gripper gripper.pos, in degrees or shares, and say nothing of lengths."""
    run = simulate_run(tmp_path / "run", 1, robot="so101", seed=3, fps=10)
    export(run, tmp_path / "dataset")
    shutil.rmtree(tmp_path / "dataset" / "demorec")
    assert level_of(tmp_path / "dataset", "joint_limits", "dataset") == "pass"
    numbers("observation.state", np.degrees)(tmp_path / "dataset")
    assert level_of(tmp_path / "dataset", "joint_limits", "dataset") == "fail"
