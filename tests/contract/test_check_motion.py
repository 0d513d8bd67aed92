"""Laws of motion on datasets that say nothing of their robot but the names of its joints: one fault at a time."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from support import loose
from support.check import checked, copy, edit_column, edit_json, simulate_run
from support.export import rewrite_video

from demorec.check.dataset import Dataset
from demorec.check.evidence import quaternion_places
from demorec.cli import main
from demorec.datasets.lerobot.export import export_lerobot
from demorec.datasets.lerobot.options import ExportOptions
from demorec.mcap import Recording
from demorec.mcap.description import robot_description
from demorec.robots.panda import PANDA

pytestmark = pytest.mark.slow

EE_POSE = "observation.ee_pose"
STATE, ACTION, VELOCITY, FRONT = "observation.state", "action", "observation.velocity", "observation.images.front"
Rows = NDArray[Any]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulate_run(tmp_path_factory.mktemp("motion") / "run", 3, seed=3, cameras=("front",))


@pytest.fixture(scope="module")
def strange(run: Path) -> Path:
    """What LeRobot has of an export, without our sidecar."""
    dataset = run.parent / "ds"
    export_lerobot([run], dataset, ExportOptions(verify=False))
    shutil.rmtree(dataset / "demorec")
    return dataset


def offset(rows: Rows) -> Rows:
    return np.asarray(rows + 0.4 * (np.arange(rows.shape[1]) == 3))


def exchanged(rows: Rows) -> Rows:
    return rows[:, [1, 0, *range(2, rows.shape[1])]]


def late(rows: Rows) -> Rows:
    return np.concatenate([np.repeat(rows[:1], 3, axis=0), rows[:-3]])


def interpolated(rows: Rows) -> Rows:
    """Every second frame, and the gripper as it was."""
    out = rows.copy()
    out[1:-1:2, :7] = (rows[:-2:2, :7][: len(rows[1:-1:2])] + rows[2::2, :7][: len(rows[1:-1:2])]) / 2
    return out


def repeats(rows: Rows) -> Rows:
    """Every fifth frame is the one before."""
    out = rows.copy()
    out[5::5] = rows[4:-1:5]
    return out


def slips(rows: Rows) -> Rows:
    """One encoder loses 0.08 rad in the middle."""
    return np.asarray(rows - 0.08 * (np.arange(rows.shape[1]) == 2) * (np.arange(len(rows)) > len(rows) // 2)[:, None])


def late_when_opening(rows: Rows) -> Rows:
    """The gripper alone, by eight frames."""
    out = rows.copy()
    for frame in np.flatnonzero(np.diff(rows[:, 7]) > 0.01) + 1:
        out[frame : frame + 8, 7] = rows[frame - 1, 7]
    return out


def slower(data: dict[str, Any]) -> None:
    data["fps"] = 15


FAULTS: dict[str, tuple[str, Callable[[Rows], Rows], str]] = {
    "a zero that is off": (STATE, offset, "state_reaches_action"),
    "joints exchanged": (STATE, exchanged, "actions_in_order"),
    "actions exchanged": (ACTION, exchanged, "actions_in_order"),
    "late actions": (ACTION, late, "state_follows_action"),
    "actions of another course": (ACTION, lambda rows: rows[::-1], "targets_go_along"),
    "degrees": (STATE, np.degrees, "joint_limits"),
    "a dead encoder": (STATE, lambda rows: rows * (np.arange(rows.shape[1]) != 2), "elements_alive"),
    "an encoder that slips": (STATE, slips, "steps_as_velocities"),
    "velocities of another joint": (VELOCITY, exchanged, "velocity_matches_position"),
    "states by interpolation": (STATE, interpolated, "interpolated_frames"),
    "a gripper that opens before it is told": (ACTION, late_when_opening, "gripper_waits_for_action"),
    "velocities in degrees": (VELOCITY, np.degrees, "velocity_matches_position"),
}


def level(path: Path, check: str, *, images: bool = False) -> str:
    found = {result.check: result.level for result in checked(path, "dataset", images=images, only=(check,)).results}
    return found[check]


@pytest.mark.usefixtures("without_lerobot")
def test_a_good_one_has_nothing_that_is_odd(strange: Path) -> None:
    report = checked(strange, "dataset", images=True)
    assert [result for result in report.results if result.level in ("warn", "fail")] == []
    passed = {result.check for result in report.results if result.level == "pass"}
    assert {check for _, _, check in FAULTS.values()} | {"joint_speed", "frozen_images"} <= passed


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_found_by_the_law_that_it_breaks(strange: Path, fault: str, tmp_path: Path) -> None:
    feature, change, check = FAULTS[fault]
    spoilt = copy(strange, tmp_path / "ds")
    edit_column(spoilt, feature, change)
    assert level(spoilt, check) in ("warn", "fail")


def filtered(rows: Rows) -> Rows:
    """Velocities as drivers smooth them: 50 ms late."""
    for t in range(1, len(rows)):
        rows[t] = rows[t - 1] + (rows[t] - rows[t - 1]) / 2.5
    return rows


GOOD: dict[str, tuple[str, Callable[[Rows], Rows]]] = {
    "velocities as actions": (ACTION, lambda rows: np.gradient(rows, axis=0) * 30),
    "increments as actions": (ACTION, lambda rows: np.gradient(rows, axis=0)),
    "actions in percent of a range": (ACTION, lambda rows: rows * 100 / np.pi),
    "smoothed velocities": (VELOCITY, filtered),
    "an arm that hangs by 0.05 rad": (STATE, lambda rows: rows - 0.05 * (np.arange(rows.shape[1]) == 3)),
    "encoders of 4096 steps": (STATE, lambda rows: np.round(rows * 2048 / np.pi) * np.pi / 2048),
}


@pytest.mark.parametrize("kind", GOOD)
def test_what_robots_do_is_no_fault(strange: Path, kind: str, tmp_path: Path) -> None:
    feature, change = GOOD[kind]
    other = copy(strange, tmp_path / "ds")
    edit_column(other, feature, change)
    laws = tuple({check for _, _, check in FAULTS.values()})
    report = checked(other, "dataset", only=laws)
    assert [(result.check, result.detail) for result in report.results if result.level in ("warn", "fail")] == []


@pytest.mark.parametrize("fault", ["coarse", "play"])
def test_a_dead_band_is_told_of(strange: Path, fault: str, tmp_path: Path) -> None:
    """An encoder of 7 bits, and one that follows its joint only at the end of a play of 0.08 rad."""

    def change(rows: Rows) -> Rows:
        out = rows.copy()
        if fault == "coarse":
            out[:, 1] = np.round(rows[:, 1] / 0.049) * 0.049
            return out
        for frame in range(1, len(out)):
            out[frame, 1] = np.clip(out[frame - 1, 1], rows[frame, 1] - 0.04, rows[frame, 1] + 0.04)
        return out

    spoilt = copy(strange, tmp_path / "spoilt")
    edit_column(spoilt, STATE, change)
    assert level(strange, "dead_band") == "pass"
    assert level(spoilt, "dead_band") == "fail"


def test_a_state_that_is_measured_less_often_than_frames_are_is_no_dead_band(strange: Path, tmp_path: Path) -> None:
    held = copy(strange, tmp_path / "held")
    edit_column(held, STATE, lambda rows: rows[np.arange(len(rows)) // 3 * 3])
    assert level(held, "dead_band") == "pass"


def test_a_joint_that_waits_and_goes_has_no_dead_band_at_few_frames_a_second(tmp_path: Path) -> None:
    run = simulate_run(tmp_path / "run", 5, seed=91, task="stack", robot="so101", variation="full", fps=10, cameras=())
    export_lerobot([run], tmp_path / "ds", ExportOptions(verify=False))
    assert level(tmp_path / "ds", "dead_band") == "pass"


def test_a_wrong_rate_is_found(strange: Path, tmp_path: Path) -> None:
    spoilt = copy(strange, tmp_path / "ds")
    edit_json(spoilt / "meta/info.json", slower)
    assert level(spoilt, "velocity_matches_position") == "fail"
    edit_json(spoilt / "meta/info.json", lambda data: data.update(fps=90))
    assert level(spoilt, "joint_speed") in ("warn", "fail")


def test_a_state_that_is_its_own_action_is_found(strange: Path, tmp_path: Path) -> None:
    """As when the action was read from the robot instead of being what it was sent."""
    import pyarrow.parquet as pq

    spoilt = copy(strange, tmp_path / "ds")
    for file in (spoilt / "data").rglob("*.parquet"):
        table = pq.read_table(file)
        place = table.schema.get_field_index(ACTION)
        pq.write_table(table.set_column(place, table.schema.field(ACTION), table.column(STATE)), file)
    assert level(spoilt, "state_follows_action") == "fail"


def test_an_action_that_is_the_next_observation_is_found(strange: Path, tmp_path: Path) -> None:
    spoilt = copy(strange, tmp_path / "ds")
    import pyarrow.parquet as pq

    file = next((spoilt / "data").rglob("*.parquet"))
    states = np.array(pq.read_table(file).column(STATE).to_pylist())
    edit_column(spoilt, ACTION, lambda _: np.concatenate([states[1:], states[-1:]]))
    assert level(strange, "action_is_no_observation") == "pass"
    assert level(spoilt, "action_is_no_observation") == "warn"


def test_frames_that_repeat_others_are_found(strange: Path, tmp_path: Path) -> None:
    """As where a gap was filled with what came before."""
    spoilt = copy(strange, tmp_path / "ds")
    described = json.loads((spoilt / "meta/info.json").read_text())["features"]
    for name, feature in described.items():
        if name == ACTION or (name.startswith("observation.") and feature["dtype"] == "float32"):
            edit_column(spoilt, name, repeats)
    assert level(strange, "repeated_frames") == "pass"
    assert level(spoilt, "repeated_frames") == "warn"


def test_frames_that_repeat_others_of_an_arm_that_settles(strange: Path, tmp_path: Path) -> None:
    """Before it begins to move; by billionths of a metre, as a simulated one does."""
    settles = copy(strange, tmp_path / "ds")
    described = json.loads((settles / "meta/info.json").read_text())["features"]
    for name, feature in described.items():
        if name == ACTION or (name.startswith("observation.") and feature["dtype"] == "float32"):
            rows = loose.rows_of(settles, name)
            rows[:20] = rows[0]
            if name == STATE:
                rows[:20, -1] *= 1 + 2e-7 * (np.arange(20) // 2)
            loose.put_rows(settles, name, rows)
    states = loose.rows_of(settles, STATE)
    assert [bool((states[k] == states[k + 1]).all()) for k in range(4)] == [True, False, True, False]
    assert level(settles, "repeated_frames") == "pass"


def make_by_lerobot(run: Path, root: Path, *, frozen: range = range(0)) -> Path:
    """A dataset that LeRobot itself wrote from the numbers and images of our recordings."""
    from lerobot.datasets import LeRobotDataset

    joints = [f"panda_joint{n}" for n in range(1, 8)]
    vector = {"dtype": "float32", "shape": (7,)}
    features = {
        STATE: {**vector, "names": [f"{joint}.pos" for joint in joints]},
        VELOCITY: {**vector, "names": [f"{joint}.vel" for joint in joints]},
        ACTION: {**vector, "names": [f"{joint}.pos" for joint in joints]},
        FRONT: {"dtype": "video", "shape": (96, 96, 3), "names": ["height", "width", "channels"]},
    }
    dataset = LeRobotDataset.create("local/strange", 30, features, root=root)
    for path in sorted((run / "episodes").glob("*.mcap")):
        with Recording(path) as recording:
            columns, images = recording.columns(), list(recording.images("front"))
        for t in range(columns.num_frames):
            shown = images[frozen.start if t in frozen else t]
            dataset.add_frame(
                {
                    STATE: columns.joint_position[t, :7].astype(np.float32),
                    VELOCITY: columns.joint_velocity[t, :7].astype(np.float32),
                    ACTION: columns.action_joint_target[t].astype(np.float32),
                    FRONT: shown[:96, :96],
                    "task": "pick it up",
                }
            )
        dataset.save_episode()
    dataset.finalize()
    return root


@pytest.mark.timeout(300)
def test_faults_in_a_dataset_that_lerobot_wrote(run: Path, tmp_path: Path) -> None:
    """An offset, a lag, exchanged joints, a wrong rate and a frozen camera, without any file of ours beside it."""
    clean = make_by_lerobot(run, tmp_path / "clean")
    odd = [result for result in checked(clean, "dataset").results if result.level in ("warn", "fail")]
    assert all(result.check == "dataset_statistics" and "LeRobot's merge" in result.detail for result in odd), odd
    for number, (feature, change, check) in enumerate(
        ((STATE, offset, "state_reaches_action"),
         (ACTION, late, "state_follows_action"),
         (STATE, exchanged, "actions_in_order"))
    ):  # fmt: skip
        spoilt = copy(clean, tmp_path / f"spoilt_{number}")
        edit_column(spoilt, feature, change)
        assert level(spoilt, check) == "fail"
    spoilt = copy(clean, tmp_path / "rate")
    edit_json(spoilt / "meta/info.json", slower)
    assert level(spoilt, "velocity_matches_position") == "fail"
    frozen = make_by_lerobot(run, tmp_path / "frozen", frozen=range(20, 80))
    assert level(frozen, "frozen_images", images=True) == "fail"


LAWS = ("joint_limits", "joint_speed", "velocity_matches_position", "gripper_follows")


def test_every_law_runs_where_its_needs_are(strange: Path) -> None:
    """The same laws judge our recording and a dataset that says nothing of its robot but the names of its joints."""
    recording = next((strange.parent / "run" / "episodes").glob("*.mcap"))
    for path, kind in ((recording, "recording"), (strange, "dataset")):
        report = checked(path, kind, images=False, only=LAWS)
        assert {result.check: result.level for result in report.results} == dict.fromkeys(LAWS, "pass"), kind
    assert level(strange, "pose_follows_joints") == "pass"


HAND: dict[str, tuple[str, Callable[[Rows], Rows], str]] = {
    "joints exchanged": (STATE, lambda rows: rows[:, [1, 0, *range(2, rows.shape[1])]], "pose_follows_joints"),
    "a quaternion that begins with w": (EE_POSE, lambda rows: rows[:, [0, 1, 2, 6, 3, 4, 5]], "pose_follows_joints"),
    "millimetres": (EE_POSE, lambda rows: rows * [1000, 1000, 1000, 1, 1, 1, 1], "pose_follows_joints"),
    "an opening that is inverted": (STATE, lambda rows: of_gripper(rows, lambda w: w.max() - w), "gripper_follows"),
    "an opening that stands still": (STATE, lambda rows: of_gripper(rows, lambda w: w * 0), "gripper_follows"),
}


def of_gripper(rows: Rows, change: Callable[[Rows], Rows]) -> Rows:
    return np.concatenate([rows[:, :-1], change(rows[:, -1:])], axis=1)


@pytest.mark.parametrize("fault", HAND)
def test_a_fault_of_a_strangers_hand_is_found(strange: Path, fault: str, tmp_path: Path) -> None:
    feature, change, check = HAND[fault]
    spoilt = copy(strange, tmp_path / "ds")
    edit_column(spoilt, feature, change)
    assert level(spoilt, check) == "fail"


def test_a_closed_command_that_trembles_opens_nothing(run: Path, tmp_path: Path) -> None:
    """Episodes in which something was in the hand all the time, and keeps it from closing."""
    held = tmp_path / "ds"
    export_lerobot([run], held, ExportOptions(verify=False))
    edit_column(held, ACTION, lambda rows: of_gripper(rows, lambda w: 1e-5 * (np.arange(len(w)) % 2)[:, None]))
    edit_column(held, STATE, lambda rows: of_gripper(rows, lambda w: 0 * w + 0.04))
    assert level(held, "gripper_follows") == "pass"


def test_a_hand_in_the_frame_of_another_base_is_no_fault(strange: Path, tmp_path: Path) -> None:
    """As when the base is mounted upside down, and poses are those of a table's corner."""

    def from_elsewhere(rows: Rows) -> Rows:
        turned = rows.copy()  # half a turn about x: y and z change their sign, and q becomes (1, 0, 0, 0) * q
        turned[:, :3] = rows[:, :3] * [1, -1, -1] + [0.3, 0.2, 1.5]
        x, y, z, w = rows[:, 3:].T
        turned[:, 3:] = np.stack([w, -z, y, -x], axis=1)
        return turned

    other = copy(strange, tmp_path / "ds")
    edit_column(other, EE_POSE, from_elsewhere)
    assert level(other, "pose_follows_joints") == "pass"


@pytest.mark.parametrize("size", [0.6, 1.3, 1.9])
def test_an_arm_that_is_built_larger_or_smaller_is_no_fault(strange: Path, size: float, tmp_path: Path) -> None:
    """With all links so many times as long, the same joints take the hand so many times as far from the base."""
    other = copy(strange, tmp_path / "ds")
    edit_column(other, EE_POSE, lambda rows: rows * [size, size, size, 1, 1, 1, 1])
    assert level(other, "pose_follows_joints") == "pass"


def test_a_description_that_the_user_names_makes_laws_applicable(
    strange: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Elements of other names are those of the description's joints in their order."""

    def told(*flags: str) -> tuple[object, str]:
        with pytest.raises(SystemExit) as ended:
            main(["check", str(other), "--no-images", "--only", "joint_limits", "pose_follows_joints", *flags])
        return ended.value.code, capsys.readouterr().out

    other = copy(strange, tmp_path / "ds")
    names = [*(f"axis_{n}" for n in range(1, 8)), "gripper.width"]

    def renamed(data: dict[str, Any]) -> None:
        for key in (STATE, ACTION, VELOCITY):
            data["features"][key].update(names=names)

    edit_json(other / "meta/info.json", renamed)
    code, text = told()
    assert "1 needs a robot whose URDF is known (--urdf FILE)" in text
    description = tmp_path / "arm.urdf"
    joints = robot_description(PANDA.urdf, 1.0)
    description.write_text(re.sub(r'<joint name="panda_finger_joint\d" type="prismatic"', _fixed, joints))
    code, text = told("--urdf", str(description))
    assert (code, "2 checks passed" in text or "2 passed" in text) == (0, True), text
    edit_column(other, STATE, np.degrees)
    assert told("--urdf", str(description))[0] == 1
    description.write_text("<robot")
    assert told("--urdf", str(description))[0] == 2


def _fixed(match: re.Match[str]) -> str:
    return match[0].replace("prismatic", "fixed")


def test_exposure_that_drifts(strange: Path, tmp_path: Path) -> None:
    spoilt = copy(strange, tmp_path / "spoilt")

    def brighter(images: list[Any]) -> list[Any]:
        gains = np.linspace(0.9, 1.0, len(images))
        return [(image * gain).astype(np.uint8) for image, gain in zip(images, gains, strict=True)]

    length = Dataset(spoilt).places[0].length
    rewrite_video(spoilt, FRONT, lambda images: [*brighter(images[:length]), *images[length:]])
    assert level(strange, "steady_exposure", images=True) == "pass"
    assert level(spoilt, "steady_exposure", images=True) == "warn"


def test_images_of_an_episode_that_run_backwards(strange: Path, tmp_path: Path) -> None:
    spoilt = copy(strange, tmp_path / "spoilt")
    length = Dataset(spoilt).places[0].length
    rewrite_video(spoilt, FRONT, lambda images: [*images[:length][::-1], *images[length:]])
    assert level(strange, "images_follow_state", images=True) == "pass"
    assert level(spoilt, "images_follow_state", images=True) == "fail"


def test_only_quaternions_are_left_out_of_the_order_of_actions() -> None:
    joints = [f"arm.q{number}" for number in range(1, 8)]
    pose = ["position.x", "position.y", "position.z", *(f"orientation.{axis}" for axis in "xyzw")]
    assert quaternion_places([*joints, *pose]) == [len(joints) + 3]
    assert quaternion_places(["x", "y", "z", "qx", "qy", "qz", "qw", "gripper.width"]) == [3]
    assert quaternion_places(["qw", "qx", "qy", "qz", "w"]) == [0]
    assert quaternion_places(joints) == []
