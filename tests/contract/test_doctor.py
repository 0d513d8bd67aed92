"""Dataset checks on simulated teleoperation: sound episodes are good, each planted fault is found by its check."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from demorec.core.geometry import Array
from demorec.episode.roles import NO_NAMES, Column, find_roles
from demorec.extensions.doctor.checks import all_checks
from demorec.extensions.doctor.diagnosis import Diagnosis, diagnose
from demorec.extensions.doctor.evidence import EpisodeEvidence, Evidence
from demorec.extensions.doctor.robust import held_period
from demorec.extensions.doctor.thumbnails import CameraThumbnails, EpisodeThumbnails

NAMES = ("pan.pos", "lift.pos", "elbow.pos", "wrist.pos", "gripper.pos")
FPS, LAG, EPISODES, BAD = 30, 3, 12, 5
ROLES = find_roles(
    {"observation.state": Column("float32", NAMES), "action": Column("float32", NAMES), "top": Column("video")},
    NO_NAMES,
)


def motion(number: int, count: int) -> tuple[Array, Array]:
    """State and action, degrees: from home through two places back to rest; the gripper closes and opens."""
    rng = np.random.default_rng(number)
    places = np.array([0.0, -60, 60, 10]) + np.vstack([np.zeros(4), rng.uniform(-30, 30, (3, 4))])
    at = np.minimum(np.linspace(0, 3.4, count), 3.0)
    leg = np.minimum(at.astype(int), 2)
    u = (at - leg)[:, None]
    arm = places[leg] + (places[leg + 1] - places[leg]) * (10 * u**3 - 15 * u**4 + 6 * u**5)
    gripper = 40 / (1 + np.exp(-20 * (np.abs(at - 1.5) - 0.5)))
    target = np.column_stack([arm, gripper])
    state = np.vstack([np.repeat(target[:1], LAG, axis=0), target[:-LAG]])
    return state + rng.normal(0, 0.03, state.shape), target + rng.normal(0, 0.03, target.shape)


def images_of(state: Array, number: int) -> EpisodeThumbnails:
    """A bright blob that follows the first two joints over a textured table."""
    rng = np.random.default_rng(number)
    table = np.random.default_rng(0).uniform(40, 120, (16, 16))
    y, x = np.mgrid[:16, :16]
    centres = np.column_stack([8 + state[:, 0] / 12, 8 + (state[:, 1] + 60) / 12])
    blob = 120 * np.exp(-((x - centres[:, :1, None]) ** 2 + (y - centres[:, 1:, None]) ** 2) / 60)
    shown = np.clip(table + blob + rng.normal(0, 0.5, blob.shape), 0, 255).astype(np.uint8)
    return as_images(shown)


def as_images(shown: np.ndarray) -> EpisodeThumbnails:  # type: ignore[type-arg]
    change = np.abs(np.diff(shown.astype(float), axis=0, prepend=shown[:1])).mean(axis=(1, 2))
    return EpisodeThumbnails(
        thumbnails=shown,
        change=change.astype(np.float32),
        colour=np.full(3, 0.3),
        frames=np.arange(len(shown)),
    )


def episode(number: int, state: Array, action: Array, instruction: str = "sort the cups") -> EpisodeEvidence:
    columns = {"observation.state": state.astype(np.float32), "action": action.astype(np.float32)}
    time_s = np.arange(len(state)) / FPS
    return EpisodeEvidence(
        number=number, instruction=instruction, columns=columns, state=state, action=action, time_s=time_s
    )


@pytest.fixture
def sound() -> Evidence:
    lengths = [120 + 7 * number for number in range(EPISODES)]
    motions = [motion(number, length) for number, length in enumerate(lengths)]
    shown = {number: images_of(state, number) for number, (state, _) in enumerate(motions)}
    return Evidence(
        path=Path("cups"),
        fps=FPS,
        roles=ROLES,
        episodes=[episode(number, *both) for number, both in enumerate(motions)],
        cameras={"top": CameraThumbnails(episodes=shown)},
    )


Change = Callable[[Array, Array], tuple[Array, Array]]


def frozen_elbow(state: Array, action: Array) -> tuple[Array, Array]:
    state[20:130, 2] = state[20, 2]
    return state, action


def jumping(state: Array, action: Array) -> tuple[Array, Array]:
    state[60, 0] += 40
    return state, action


def resting(state: Array, action: Array) -> tuple[Array, Array]:
    return np.vstack([state, np.repeat(state[-1:], 300, axis=0)]), np.vstack(
        [action, np.repeat(action[-1:], 300, axis=0)]
    )


NUMBERS: dict[str, tuple[Change, str]] = {
    "radians": (lambda s, a: (np.radians(s), np.radians(a)), "unit_mismatch"),
    "an action two frames late": (lambda s, a: (s, np.vstack([a[:1], a[:1], a[:-2]])), "action_lag"),
    "the action of another episode": (lambda s, a: (s, motion(99, len(s))[1] * (1, -1, -1, 1, 1)), "action_lag"),
    "an action that is the state": (lambda s, a: (s, s.copy()), "action_equals_state"),
    "exchanged actions": (lambda s, a: (s, a[:, [1, 0, 2, 3, 4]]), "swapped_elements"),
    "a gripper's action ten frames late": (
        lambda s, a: (s, np.column_stack([a[:, :4], np.repeat(a[:1, 4], 10).tolist() + a[:-10, 4].tolist()])),
        "gripper_action",
    ),
    "an inverted gripper": (lambda s, a: (s, np.column_stack([a[:, :4], 40 - a[:, 4]])), "gripper_action"),
    "a frozen elbow": (frozen_elbow, "frozen_state"),
    "a jump": (jumping, "state_jumps"),
    "half a minute's rest": (resting, "idle_ends"),
    "the end cut off": (lambda s, a: (s[: len(s) // 2], a[: len(a) // 2]), "cut_off_episodes"),
    "samples held for four frames": (lambda s, a: (s[np.arange(len(s)) // 4 * 4], a), "held_samples"),
}


def changed(sound: Evidence, change: Callable[[int, Array, Array], tuple[Array, Array]]) -> Evidence:
    """The set without images, with another state and action of each episode."""
    episodes = []
    for each in sound.episodes:
        assert each.state is not None
        assert each.action is not None
        episodes.append(episode(each.number, *change(each.number, each.state.copy(), each.action.copy())))
    return replace(sound, episodes=episodes, cameras={})


def spoilt(sound: Evidence, change: Change) -> Evidence:
    return changed(sound, lambda number, state, action: change(state, action) if number == BAD else (state, action))


def found(diagnosis: Diagnosis, check: str) -> set[int | None]:
    return {finding.episode for finding in diagnosis.findings if finding.check == check}


def test_sound_episodes_are_good(sound: Evidence) -> None:
    diagnosis = diagnose(sound)
    assert [(each.check, each.message) for each in diagnosis.findings] == []
    assert {each.verdict for each in diagnosis.episodes} == {"good"}
    assert min(each.score for each in diagnosis.episodes) > 0.5
    assert not {"action_lag", "swapped_elements", "frozen_images", "image_lag"} & diagnosis.not_measured.keys()


@pytest.mark.parametrize("name", NUMBERS)
def test_a_fault_of_numbers_is_found_in_its_episode(name: str, sound: Evidence) -> None:
    change, check = NUMBERS[name]
    diagnosis = diagnose(spoilt(sound, change))
    assert found(diagnosis, check) == {BAD}
    assert diagnosis.episodes[0].episode == BAD
    others = {each.episode for each in diagnosis.findings} - {BAD}
    assert others == set()


def held_by_dead_band(target: Array, dead_band: float) -> Array:
    """(T,) positions of a hobby servo in 0.1 degree steps: it moves only when the target leaves its dead band."""
    held = [target[0]]
    for wanted in target[1:]:
        excess = max(abs(wanted - held[-1]) - dead_band, 0.0)
        held.append(held[-1] + excess * np.sign(wanted - held[-1]))
    return np.round(np.array(held), 1)


def test_a_servo_that_holds_its_joint_within_the_dead_band_is_sound(sound: Evidence) -> None:
    def holding(number: int, state: Array, action: Array) -> tuple[Array, Array]:
        action[:, 3] = 10 + 3 * np.sin(np.arange(len(action)) / 15 + number)
        state[LAG:, 3] = held_by_dead_band(action[:-LAG, 3], 1.5)
        state[:LAG, 3] = state[LAG, 3]
        return state, action

    assert found(diagnose(changed(sound, holding)), "frozen_state") == set()


def test_a_resting_encoder_flickers_by_a_tick(sound: Evidence) -> None:
    tick = 360 / 4096

    def resting(number: int, state: Array, action: Array) -> tuple[Array, Array]:
        state[:, 3], action[:, 3] = 10 * tick, 10 * tick
        state[40:43, 3] = 11 * tick
        return state, action

    few = replace(sound, episodes=sound.episodes[:3])
    assert found(diagnose(changed(few, resting)), "state_jumps") == set()


@pytest.mark.parametrize("is_whole", [True, False])
def test_a_fast_start_of_the_whole_arm_is_not_a_jump(is_whole: bool, sound: Evidence) -> None:
    """The first joint moves within one frame, two others accelerate over five."""
    ramp = np.cumsum([6.0, 20, 30, 20, 6])[:, None]

    def start(state: Array, action: Array) -> tuple[Array, Array]:
        state[-8:, 0] += 40
        if is_whole:
            state[-10:, 1:3] += np.vstack([ramp, np.repeat(ramp[-1:], 5, axis=0)])
        return state, action

    assert found(diagnose(spoilt(sound, start)), "state_jumps") == (set() if is_whole else {BAD})


def test_a_stale_first_reading_of_a_joint_that_rests_is_worth_a_look(sound: Evidence) -> None:
    """The joint has another position in each episode, and hardly moves within one."""

    def stale(number: int, state: Array, action: Array) -> tuple[Array, Array]:
        state[:, 3] = 10 * number + np.random.default_rng(number).normal(0, 0.001, len(state))
        state[0, 3] += 30 * (number == BAD)
        return state, action

    findings = diagnose(changed(sound, stale)).findings
    assert [(f.episode, f.severity, f.value) for f in findings if f.check == "state_jumps"] == [
        (BAD, "look", "27% of its range")
    ]


def with_second_arm(sound: Evidence, arm: Callable[[int, int], tuple[Array, Array]]) -> Evidence:
    """Add a second arm with the state and action (T, 3) computed from number and length."""
    names = (*NAMES, *(f"left.joint_{number}.pos" for number in range(3)))
    roles = find_roles({"observation.state": Column("float32", names), "action": Column("float32", names)}, NO_NAMES)

    def both(number: int, state: Array, action: Array) -> tuple[Array, Array]:
        second_state, second_action = arm(number, len(state))
        return np.hstack([state, second_state]), np.hstack([action, second_action])

    return replace(changed(sound, both), roles=roles)


def test_a_resting_arm_that_shakes_by_a_few_encoder_steps_is_not_frozen(sound: Evidence) -> None:
    """It holds its weight while the operator's idle leader shakes, and sways once."""
    tick = 0.022

    def shaking(number: int, length: int) -> tuple[Array, Array]:
        rng = np.random.default_rng(number)
        held = np.tile(tick * rng.integers(0, 3, (length, 1)), 3)
        held[30:80] = held[30]
        leader = np.tile(0.2 * (np.arange(length)[:, None] // 25 % 2), 3)
        if number == BAD:
            held[50] += 30 * tick
        return held, leader

    diagnosis = diagnose(with_second_arm(sound, shaking))
    assert [(each.check, each.severity) for each in diagnosis.findings] == [("state_jumps", "look")]


def test_a_state_that_is_a_second_late_is_found_beside_a_resting_arm(sound: Evidence) -> None:
    def delay(number: int, state: Array, action: Array) -> tuple[Array, Array]:
        return np.vstack([np.repeat(state[:1], FPS, axis=0), state[:-FPS]]), action

    def resting(number: int, length: int) -> tuple[Array, Array]:
        flicker: Array = np.random.default_rng(number).integers(0, 3, (length, 3)).astype(np.float64)
        return 0.1 * flicker, np.zeros((length, 3))

    diagnosis = diagnose(with_second_arm(changed(sound, delay), resting))
    messages = [each.message for each in diagnosis.findings if each.check == "action_lag"]
    assert messages == ["the state follows its action by 0.70 s or more"]


@pytest.mark.parametrize("form", ["delta_{}", "{}.delta"])
def test_a_late_increment_is_found_in_both_notations(sound: Evidence, form: str) -> None:
    names = (*(form.format(name.removesuffix(".pos")) for name in NAMES[:4]), NAMES[4])
    columns = {"observation.state": Column("float32", NAMES), "action": Column("float32", names)}

    def incremental(number: int, state: Array, action: Array) -> tuple[Array, Array]:
        steps = np.diff(action[:, :4], axis=0, append=action[-1:, :4])
        return state, np.column_stack([np.roll(steps, 4 if number == BAD else 0, axis=0), action[:, 4]])

    diagnosis = diagnose(replace(changed(sound, incremental), roles=find_roles(columns, NO_NAMES)))
    assert found(diagnosis, "action_lag") == {BAD}
    assert "its action is 4" in next(each.message for each in diagnosis.findings if each.check == "action_lag")


def test_noisy_increments_of_another_episode_are_found(sound: Evidence) -> None:
    """The noise, of exploration or of a hand, exceeds the steps, and single ones explain nothing."""
    names = (*(f"delta_{name.removesuffix('.pos')}" for name in NAMES[:4]), NAMES[4])
    columns = {"observation.state": Column("float32", NAMES), "action": Column("float32", names)}

    def incremental(number: int, state: Array, action: Array) -> tuple[Array, Array]:
        place = 99 if number == BAD else number
        steps = np.diff(motion(place, len(state))[1][:, :4], axis=0, append=action[-1:, :4])
        noise = np.random.default_rng(number).normal(0, 1.5 * np.abs(steps[:-1]).mean(axis=0), steps.shape)
        return state, np.column_stack([steps + noise, action[:, 4]])

    diagnosis = diagnose(replace(changed(sound, incremental), roles=find_roles(columns, NO_NAMES)))
    assert found(diagnosis, "action_lag") == {BAD}
    assert "action_lag" not in diagnosis.not_measured


def test_a_gripper_with_one_wrong_reading_is_not_of_another_unit(sound: Evidence) -> None:
    def spiking(state: Array, action: Array) -> tuple[Array, Array]:
        state[70, 4] = 57.3 * state[:, 4].max()
        return state, action

    assert found(diagnose(spoilt(sound, spiking)), "unit_mismatch") == set()

    def in_degrees(state: Array, action: Array) -> tuple[Array, Array]:
        return state * (1, 1, 1, 1, 57.3), action * (1, 1, 1, 1, 57.3)

    assert found(diagnose(spoilt(sound, in_degrees)), "unit_mismatch") == {BAD}


@pytest.mark.parametrize("names", [("right_hand.joint_1.pos", "kRightHandIndex"), ("Wrist_Vel4", "LeftForce.fx")])
def test_fingers_snap_and_velocities_and_forces_may_change_within_a_frame(
    names: tuple[str, str], sound: Evidence
) -> None:
    states = Column("float32", (*NAMES[:3], *names))
    roles = find_roles({"observation.state": states, "action": Column("float32", NAMES)}, NO_NAMES)

    def snap(state: Array, action: Array) -> tuple[Array, Array]:
        state[60:, 3:] += 200
        return state, action

    assert found(diagnose(replace(spoilt(sound, snap), roles=roles)), "state_jumps") == set()


def test_numbered_elements_of_different_counts_have_nothing_in_common(sound: Evidence) -> None:
    """The state is a pose that rests, the action has joints."""
    states = Column("float32", tuple(map(str, range(4))))
    roles = find_roles({"observation.state": states, "action": Column("float32", tuple("01234"))}, NO_NAMES)
    resting = changed(sound, lambda n, s, a: (np.full((len(s), 4), 0.3) + np.eye(4)[3] * s[:, :1], a))
    assert found(diagnose(replace(resting, roles=roles)), "frozen_state") == set()


def test_attempts_that_were_written_as_one_episode(sound: Evidence) -> None:
    """Nothing marks where one rollout ends (strands-labs/robots#708)."""
    states = [each.state for each in sound.episodes[:6] if each.state is not None]
    whole = episode(0, np.vstack(states), np.vstack(states))
    assert found(diagnose(replace(sound, episodes=[whole], cameras={})), "joined_episodes") == {0}
    assert found(diagnose(replace(sound, episodes=sound.episodes[:1], cameras={})), "joined_episodes") == set()


def test_slow_motion_is_no_idle_end(sound: Evidence) -> None:
    """The arm moves on by less than a degree a frame, or its reading stays where it is."""

    def ending(rise: float) -> Change:
        slow = rise * np.arange(1.0, 301)[:, None] * np.array([1, 0, 0, 0, 0])
        return lambda s, a: (np.vstack([s, s[-1] + slow]), np.vstack([a, a[-1] + slow]))

    assert found(diagnose(spoilt(sound, ending(0.5))), "idle_ends") == set()
    assert found(diagnose(spoilt(sound, ending(0.0))), "idle_ends") == {BAD}


def test_an_episode_in_which_nothing_moves(sound: Evidence) -> None:
    diagnosis = diagnose(spoilt(sound, lambda s, a: (np.repeat(s[:1], 90, axis=0), np.repeat(a[:1], 90, axis=0))))
    messages = [(each.episode, each.message) for each in diagnosis.findings if each.check == "idle_ends"]
    assert messages == [(BAD, "nothing moves in it")]


def test_a_joint_that_hardly_moves_although_its_action_does_is_dead(sound: Evidence) -> None:
    """Its reading changes by a step once, in one episode, while the servo of a sound joint would follow."""

    def dead(number: int, state: Array, action: Array) -> tuple[Array, Array]:
        state[:, 3] = 10.0
        state[0, 3] += 0.1 * (number == 1)
        return state, action

    findings = diagnose(changed(replace(sound, episodes=sound.episodes[:3]), dead)).findings
    messages = [(each.severity, each.message) for each in findings if each.check == "frozen_state"]
    assert messages == [("broken", "wrist.pos: the state never changes although the action does")]


def test_measured_velocities_as_actions_are_worth_a_look(sound: Evidence) -> None:
    """A controller's feedback at t is centred on t; the motion that an action causes is centred on t + 1/2."""

    def measured(number: int, state: Array, action: Array) -> tuple[Array, Array]:
        weights = np.hanning(9) / np.hanning(9).sum()
        smooth = np.apply_along_axis(np.convolve, 0, action, weights, "same")[8:-8]
        return smooth, np.gradient(smooth, axis=0)

    findings = diagnose(changed(sound, measured)).findings
    assert {each.severity for each in findings if each.check == "action_lag"} == {"look"}


@pytest.mark.parametrize(("frame", "severity"), [(60, "broken"), (-8, "look")])
def test_a_gap_during_which_the_arm_rests_loses_nothing(frame: int, severity: str, sound: Evidence) -> None:
    each = sound.episodes[BAD]
    assert each.state is not None
    state = each.state.copy()
    state[-16:] = state[-1]
    time_s = np.arange(each.length) / FPS
    time_s[frame:] += 0.2
    episodes = [replace(each, state=state, time_s=time_s) if each.number == BAD else each for each in sound.episodes]
    diagnosis = diagnose(replace(sound, episodes=episodes, cameras={}))
    assert {e.severity for e in diagnosis.findings if e.check == "time_gaps"} == {severity}


@pytest.mark.parametrize("num_resting", [1, EPISODES])
def test_the_pose_of_an_object_rests_until_it_is_touched(num_resting: int, sound: Evidence) -> None:
    """In simulation an object rests bit-exactly; a sensor that rests in one episode alone is frozen."""
    roles = find_roles(
        {
            "observation.state": Column("float32", NAMES),
            "action": Column("float32", NAMES),
            "observation.object": Column("float32", ("x", "y", "yaw")),
        },
        NO_NAMES,
    )
    episodes = []
    for number, each in enumerate(sound.episodes):
        pose = np.random.default_rng(number).normal(size=(each.length, 3))
        if number < num_resting:
            pose[20:60] = pose[20]
        episodes.append(replace(each, columns={**each.columns, "observation.object": pose}))
    diagnosis = diagnose(replace(sound, roles=roles, episodes=episodes, cameras={}))
    assert found(diagnosis, "frozen_sensors") == ({0} if num_resting == 1 else set())


def test_a_copy_and_a_lone_instruction(sound: Evidence) -> None:
    twin = replace(sound.episodes[2], number=EPISODES)
    other = replace(sound.episodes[4], instruction="open the drawer")
    episodes = [other if each.number == 4 else each for each in sound.episodes]
    diagnosis = diagnose(replace(sound, episodes=[*episodes, twin], cameras={}))
    assert found(diagnosis, "copied_episodes") == {EPISODES}
    assert found(diagnosis, "odd_instructions") == {4}


IMAGES: dict[str, tuple[Callable[[np.ndarray], np.ndarray], str]] = {  # type: ignore[type-arg]
    "frozen": (
        lambda shown: np.concatenate([shown[:40], np.repeat(shown[40:41], 60, axis=0), shown[100:]]),
        "frozen_images",
    ),
    "black": (lambda shown: shown * 0, "blank_images"),
    "upside down": (lambda shown: shown[:, ::-1, ::-1], "camera_views"),
}  # fmt: skip


@pytest.mark.parametrize("name", IMAGES)
def test_a_fault_of_images_is_found_in_its_episode(name: str, sound: Evidence) -> None:
    change, check = IMAGES[name]
    shown = dict(sound.cameras["top"].episodes)
    shown[BAD] = as_images(np.ascontiguousarray(change(shown[BAD].thumbnails)))
    diagnosis = diagnose(replace(sound, cameras={"top": CameraThumbnails(episodes=shown)}))
    assert found(diagnosis, check) == {BAD}
    assert {each.episode for each in diagnosis.findings} == {BAD}


@pytest.mark.parametrize("speed", [0, 4])
def test_slow_motion_in_one_corner_is_not_frozen(speed: int, sound: Evidence) -> None:
    """A hand that comes into view darkens one cell by a few levels an image, while all others stay as they are."""
    shown = dict(sound.cameras["top"].episodes)
    thumbnails = shown[BAD].thumbnails.copy()
    thumbnails[60:90] = thumbnails[60]
    thumbnails[60:90, 15, 0] = 130 - speed * np.arange(30)
    shown[BAD] = as_images(thumbnails)
    diagnosis = diagnose(replace(sound, cameras={"top": CameraThumbnails(episodes=shown)}))
    assert found(diagnosis, "frozen_images") == (set() if speed else {BAD})


def test_images_that_every_episode_repeats_now_and_then_are_a_fault_of_the_camera(sound: Evidence) -> None:
    """A recorder that polls a slow camera copies about a third of the images, every second one for a while."""
    shown = {}
    for number, images in sound.cameras["top"].episodes.items():
        count = len(images.thumbnails)
        is_copy = np.random.default_rng(number).random(count) < 0.35
        if number == BAD:
            is_copy = np.arange(count) % 2 == 1
        copied = as_images(images.thumbnails[np.maximum.accumulate(np.where(is_copy, 0, np.arange(count)))])
        shown[number] = replace(copied, change=4 * copied.change)  # a camera close to the arm
    diagnosis = diagnose(replace(sound, cameras={"top": CameraThumbnails(episodes=shown)}))
    assert found(diagnosis, "repeated_images") == {None}


def test_keyframes_do_not_hide_a_camera_at_a_third_of_the_rate() -> None:
    """Every second image is a keyframe, which differs from an image that was new before it."""
    frames, moving = np.arange(60), np.ones(60, dtype=np.bool_)
    is_new = (frames % 3 == 0) | ((frames % 2 == 0) & (frames % 3 == 1))
    assert held_period(~is_new, moving) == 3
    assert held_period(np.random.default_rng(0).random(60) < 0.6, moving) == 1


def test_another_set_that_holds_the_same_episode(sound: Evidence) -> None:
    train = replace(sound, episodes=sound.episodes[:8], cameras={})
    held_out = replace(sound, episodes=sound.episodes[7:], cameras={}, earlier=(train,))
    assert found(diagnose(held_out), "leakage") == {7}


def test_every_check_explains_itself() -> None:
    for check in all_checks():
        assert check.page, check.name
        assert check.why.endswith("."), check.name
        assert check.do, check.name
        assert len(check.name) + 2 + len(check.measures) <= 80, check.name
