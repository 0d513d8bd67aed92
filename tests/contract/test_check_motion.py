"""Checks of motion and images on datasets of another writer, whose robot is known by its joints' names alone."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from support.check import checked, copy, edit_column, edit_json, simulate_run
from support.export import rewrite_video

from demorec.check.dataset import CheckedDataset
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
LAWS = ("joint_limits", "velocity_matches_position", "forward_kinematics", "frozen_sensors", "action_lag")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulate_run(tmp_path_factory.mktemp("motion") / "run", 3, seed=3, cameras=("front",))


@pytest.fixture(scope="module")
def foreign(run: Path) -> Path:
    """What LeRobot has of an export, without our sidecar."""
    dataset = run.parent / "ds"
    export_lerobot([run], dataset, ExportOptions(verify=False))
    shutil.rmtree(dataset / "demorec")
    return dataset


def exchanged(rows: Rows) -> Rows:
    return rows[:, [1, 0, *range(2, rows.shape[1])]]


def late(rows: Rows) -> Rows:
    return np.concatenate([np.repeat(rows[:1], 3, axis=0), rows[:-3]])


def frozen(rows: Rows) -> Rows:
    """For four seconds."""
    rows[40:160] = rows[40]
    return rows


def frozen_joint(rows: Rows) -> Rows:
    return np.concatenate([rows[:, :1], frozen(rows[:, 1:2]), rows[:, 2:]], axis=1)


FAULTS: dict[str, tuple[str, Callable[[Rows], Rows], str]] = {
    "degrees": (STATE, np.degrees, "joint_limits"),
    "joints exchanged": (STATE, exchanged, "forward_kinematics"),
    "a quaternion that begins with w": (EE_POSE, lambda rows: rows[:, [0, 1, 2, 6, 3, 4, 5]], "forward_kinematics"),
    "millimetres": (EE_POSE, lambda rows: rows * [1000, 1000, 1000, 1, 1, 1, 1], "forward_kinematics"),
    "late actions": (ACTION, late, "action_lag"),
    "velocities of another joint": (VELOCITY, exchanged, "velocity_matches_position"),
    "velocities in degrees": (VELOCITY, np.degrees, "velocity_matches_position"),
    "frozen velocities": (VELOCITY, frozen, "frozen_sensors"),
    "a frozen encoder": (STATE, frozen_joint, "frozen_sensors"),
}


def level(path: Path, check: str) -> str:
    (result,) = checked(path, "dataset", only=(check,)).results
    return result.level


def test_a_good_one_passes(foreign: Path) -> None:
    levels = {result.check: result.level for result in checked(foreign, "dataset").results}
    assert levels.pop("dataset_sidecar") == "skip"
    assert set(levels.values()) == {"pass"}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault(foreign: Path, fault: str, tmp_path: Path) -> None:
    feature, change, check = FAULTS[fault]
    spoilt = copy(foreign, tmp_path / "ds")
    edit_column(spoilt, feature, change)
    assert level(spoilt, check) == "fail"


def filtered(rows: Rows) -> Rows:
    """Velocities as drivers smooth them: 50 ms late."""
    for t in range(1, len(rows)):
        rows[t] = rows[t - 1] + (rows[t] - rows[t - 1]) / 2.5
    return rows


def from_elsewhere(rows: Rows) -> Rows:
    """Poses in the frame of a table's corner, by a base that is mounted upside down."""
    turned = rows.copy()  # half a turn about x: y and z change their sign, and q becomes (1, 0, 0, 0) * q
    turned[:, :3] = rows[:, :3] * [1, -1, -1] + [0.3, 0.2, 1.5]
    x, y, z, w = rows[:, 3:].T
    turned[:, 3:] = np.stack([w, -z, y, -x], axis=1)
    return turned


GOOD: dict[str, tuple[str, Callable[[Rows], Rows]]] = {
    "increments as actions": (ACTION, lambda rows: np.gradient(rows, axis=0)),
    "actions in percent of a range": (ACTION, lambda rows: rows * 100 / np.pi),
    "smoothed velocities": (VELOCITY, filtered),
    "an arm that hangs by 0.02 rad": (STATE, lambda rows: rows - 0.02 * (np.arange(rows.shape[1]) == 3)),
    "encoders of 4096 steps": (STATE, lambda rows: np.round(rows * 2048 / np.pi) * np.pi / 2048),
    "a state that is measured at 10 Hz": (STATE, lambda rows: rows[np.arange(len(rows)) // 3 * 3]),
    "poses in another frame": (EE_POSE, from_elsewhere),
    "a larger arm": (EE_POSE, lambda rows: rows * [1.9, 1.9, 1.9, 1, 1, 1, 1]),
    "a smaller arm": (EE_POSE, lambda rows: rows * [0.6, 0.6, 0.6, 1, 1, 1, 1]),
}


@pytest.mark.parametrize("kind", GOOD)
def test_what_robots_do_is_no_fault(foreign: Path, kind: str, tmp_path: Path) -> None:
    feature, change = GOOD[kind]
    other = copy(foreign, tmp_path / "ds")
    edit_column(other, feature, change)
    report = checked(other, "dataset", only=LAWS)
    assert [(result.check, result.detail) for result in report.results if result.level == "fail"] == []


def test_a_wrong_rate(foreign: Path, tmp_path: Path) -> None:
    spoilt = copy(foreign, tmp_path / "ds")
    edit_json(spoilt / "meta/info.json", lambda data: data.update(fps=20))
    assert level(spoilt, "velocity_matches_position") == "fail"


def test_a_state_that_is_its_own_action(foreign: Path, tmp_path: Path) -> None:
    """As when the action was read from the robot instead of being what it was sent."""
    import pyarrow.parquet as pq

    spoilt = copy(foreign, tmp_path / "ds")
    states = np.array(pq.read_table(next((spoilt / "data").rglob("*.parquet"))).column(STATE).to_pylist())
    edit_column(spoilt, ACTION, lambda _: states)
    assert level(spoilt, "action_lag") == "fail"


def test_a_frozen_camera(foreign: Path, tmp_path: Path) -> None:
    spoilt = copy(foreign, tmp_path / "spoilt")
    rewrite_video(spoilt, FRONT, lambda images: [*images[:40], *[images[40]] * 80, *images[120:]])
    assert level(spoilt, "frozen_images") == "fail"


def test_frozen_images_in_a_dataset_that_lerobot_wrote(run: Path, tmp_path: Path) -> None:
    """LeRobot's own encoder, and numbers without any file of demorec."""
    from lerobot.datasets import LeRobotDataset

    joints = [f"panda_joint{n}" for n in range(1, 8)]
    vector = {"dtype": "float32", "shape": (7,)}
    features = {
        STATE: {**vector, "names": [f"{joint}.pos" for joint in joints]},
        ACTION: {**vector, "names": [f"{joint}.pos" for joint in joints]},
        FRONT: {"dtype": "video", "shape": (96, 96, 3), "names": ["height", "width", "channels"]},
    }
    for name, stuck in (("clean", range(0)), ("frozen", range(20, 80))):
        dataset = LeRobotDataset.create("local/foreign", 30, features, root=tmp_path / name)
        for path in sorted((run / "episodes").glob("*.mcap")):
            with Recording(path) as recording:
                trajectory, images = recording.trajectory(), list(recording.images("front"))
            for t in range(trajectory.num_frames):
                dataset.add_frame(
                    {
                        STATE: trajectory.joint_position[t, :7].astype(np.float32),
                        ACTION: trajectory.action_joint_target[t].astype(np.float32),
                        FRONT: images[stuck.start if t in stuck else t],
                        "task": "pick it up",
                    }
                )
            dataset.save_episode()
        dataset.finalize()
    failed = [result.check for result in checked(tmp_path / "clean", "dataset").results if result.level == "fail"]
    assert failed == []
    assert level(tmp_path / "frozen", "frozen_images") == "fail"


def test_a_description_that_the_user_names(foreign: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Elements of other names are those of the description's joints in their order."""

    def told(*flags: str) -> tuple[object, str]:
        with pytest.raises(SystemExit) as ended:
            main(["check", str(other), "--no-images", "--only", "joint_limits", "forward_kinematics", *flags])
        return ended.value.code, capsys.readouterr().out

    other = copy(foreign, tmp_path / "ds")
    names = [*(f"axis_{n}" for n in range(1, 8)), "gripper.width"]

    def renamed(data: dict[str, Any]) -> None:
        for key in (STATE, ACTION, VELOCITY):
            data["features"][key].update(names=names)

    edit_json(other / "meta/info.json", renamed)
    code, text = told()
    assert "not measured  joint_limits: it needs a robot whose URDF is known (--urdf FILE)" in text
    description = tmp_path / "arm.urdf"
    joints = robot_description(PANDA.urdf, 1.0)
    fixed = re.sub(r'(<joint name="panda_finger_joint\d" type=)"prismatic"', r'\1"fixed"', joints)
    assert fixed != joints
    description.write_text(fixed)
    code, text = told("--urdf", str(description))
    assert (code, "2 passed" in text) == (0, True), text
    edit_column(other, STATE, np.degrees)
    assert told("--urdf", str(description))[0] == 1
    description.write_text("<robot")
    assert told("--urdf", str(description))[0] == 2


def test_frames_without_a_number_do_not_stop_a_law(foreign: Path, tmp_path: Path) -> None:
    spoilt = copy(foreign, tmp_path / "ds")
    count = CheckedDataset(spoilt).folder.listed[0].length

    def gap(rows: Rows) -> Rows:
        rows[20:25] = np.nan
        return rows

    edit_column(spoilt, STATE, gap)
    assert count > 25
    for check in LAWS:
        assert level(spoilt, check) == "pass", check
