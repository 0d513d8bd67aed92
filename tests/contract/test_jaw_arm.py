"""An arm of five joints with a turning jaw does every task; unreachable poses are described in words."""

from __future__ import annotations

import json
import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from support.commands import exit_code
from support.jaw_arm.my_arms import JAW_ARM, opening

from demorec.cli import generate_dataset_main
from demorec.core.geometry import Pose
from demorec.core.plain import from_json, to_json
from demorec.episode.mesh import SolidMesh, encode_mesh
from demorec.episode.scene import Shape
from demorec.robots.kinematics import ArmKinematics, Freedom
from demorec.robots.motion import MotionLimits, plan_straight
from demorec.robots.panda import PANDA
from demorec.robots.robot import JawGripper, RobotSpec
from demorec.robots.so101 import SO101
from demorec.robots.urdf import Urdf
from demorec.tasks.grasping import found_grasps, hand_down
from demorec.tasks.pick import PickPlace
from demorec.tasks.sampling import Sampler
from demorec.testing import RobotContract, run_expert

FOLDER = Path(__file__).parents[1] / "support" / "jaw_arm"
assert isinstance(JAW_ARM.gripper, JawGripper)
JAW, HOME = JAW_ARM.gripper, np.array(JAW_ARM.home_q)
ARM = ArmKinematics(
    Urdf.load(FOLDER / "jaw_arm.urdf"),
    arm_joints=JAW_ARM.arm_joints,
    tcp_link="tcp",
    lower=JAW_ARM.position_lower,
    upper=JAW_ARM.position_upper,
)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("task", "index"),
    [
        ("sort_by_color", 96),  # at the nearest yaw the open jaw would land on the rim of a tray
        ("pick_shapes", 49),  # the roll's limit is between the grasp's yaw and the mark
        ("pick_shapes", 165),  # a mug that rocks after its release
    ],
)
def test_a_small_arm_finds_a_clear_grasp_a_reachable_yaw_and_waits_for_rocking_objects(task: str, index: int) -> None:
    _, outcome = run_expert(task, "so101", 0, index)
    assert outcome.success
    assert outcome.num_retries == 0


@pytest.mark.parametrize(("robot", "least"), [(PANDA, 0.015), (SO101, 0.0022 + 0.38 * 0.015)])
def test_the_minimum_width_of_an_object_scales_with_the_hand(robot: RobotSpec, least: float) -> None:
    def found(width: float) -> bool:
        box = trimesh.creation.box(extents=(0.12, width, 0.03))
        corners, faces = np.array(box.vertices), np.array(box.faces)
        mesh = encode_mesh(SolidMesh(points=corners, faces=faces, parts=(np.arange(8),)))
        shape = Shape(kind="mesh", mesh=mesh, size=(0.12, width, 0.03))
        return bool(found_grasps(shape, robot, np.array([0.0, 0.0, 1.0])))

    assert found(least + 0.001)
    assert not found(least - 0.001)


def test_tasks_open_a_jaw_less_than_it_turns() -> None:
    half = replace(JAW, open_width=0.5 * JAW.max_width)
    assert half.stroke_seconds() < JAW.stroke_seconds()
    assert half.scaled(2.0).open_width == JAW.max_width
    assert replace(JAW_ARM, gripper=half) == from_json(to_json(replace(JAW_ARM, gripper=half)), RobotSpec)
    assert SO101.gripper.joint_position(SO101.gripper.open_width) == pytest.approx([0.25])
    assert SO101.gripper.joint_position(SO101.gripper.max_width) == pytest.approx([1.74533])  # the URDF's stop


@given(q=st.floats(-0.33, 0.45), speed=st.floats(-1.0, 1.0))
def test_the_jaw_opens_as_far_as_its_tip_is_away(q: float, speed: float) -> None:
    joints = np.array([[q]])
    width = JAW.width(joints)
    assert width == pytest.approx(opening(q), abs=2e-5)
    np.testing.assert_allclose(JAW.joint_position(width), joints, atol=1e-9)
    rate = (opening(q + 1e-6) - opening(q - 1e-6)) / 2e-6 * speed
    assert JAW.width_velocity(joints, np.array([[speed]])) == pytest.approx(rate, abs=2e-3)


@pytest.mark.parametrize("rows", [(), ((0.0, 0.01),), ((0.0, 0.02), (0.1, 0.01)), ((0.0, 0.0), (0.2, 0.1), (0.1, 0.2))])
def test_an_ambiguous_opening_is_refused(rows: tuple[tuple[float, float], ...]) -> None:
    with pytest.raises(ValueError, match="from closed to open"):
        replace(JAW, opening=rows)
    plain = json.loads(to_json(JAW_ARM))
    plain["gripper"]["opening"] = [list(row) for row in rows]
    with pytest.raises(ValueError, match=r"RobotSpec\.gripper"):
        from_json(json.dumps(plain), RobotSpec)


@pytest.mark.parametrize("yaw", [-0.8, 0.0, 0.8])
@pytest.mark.parametrize("z", [0.012, 0.06, 0.08])
@pytest.mark.parametrize("xy", [(0.14, 0.0), (0.2, -0.1), (0.2, 0.1), (0.26, -0.1), (0.26, 0.1)])
def test_position_and_roll_are_reached_and_the_hand_leans_within_the_cone(
    xy: tuple[float, float], z: float, yaw: float
) -> None:
    wanted = hand_down((*xy, z), yaw)
    rest = ARM.turned_towards(HOME, wanted.position)
    q = ARM.inverse(wanted, start=rest, rest=rest)
    assert q is not None
    found = ARM.forward(q)
    assert math.dist(found.position, wanted.position) < 2e-5
    lean, _ = Rotation.align_vectors(wanted.rotation[:, 2:].T, found.rotation[:, 2:].T)
    assert lean.magnitude() <= ARM.freedom.cone + 1e-9
    upright = lean * Rotation.from_matrix(found.rotation)
    assert (upright * Rotation.from_matrix(wanted.rotation).inv()).magnitude() <= ARM.freedom.roll + 1e-6
    assert (np.array(JAW_ARM.position_lower) <= q).all()
    assert (q <= np.array(JAW_ARM.position_upper)).all()


@pytest.mark.parametrize(
    ("wanted", "freedom", "words"),
    [
        (hand_down((0.6, 0.0, 0.02), 0.0), None, "short of the position"),
        (hand_down((0.2, 0.0, 0.25), 0.0), None, "rad off the approach, allowed are 0.262 rad"),
        (hand_down((0.2, 0.0, 0.02), 3.0), None, "rad off the roll, allowed are 0.035 rad"),
        (hand_down((0.2, 0.0, 0.02), 3.0), Freedom(cone=0.2, roll=math.pi), ""),
        (hand_down((0.2, 0.0, 0.25), 0.0), Freedom(cone=math.pi, roll=math.pi), ""),
    ],
)
def test_unreachable_poses_are_explained(wanted: Pose, freedom: Freedom | None, words: str) -> None:
    rest = ARM.turned_towards(HOME, wanted.position)
    why = ARM.why_unreachable(wanted, start=rest, rest=rest, freedom=freedom)
    assert (words in why) if words else why == ""
    assert (ARM.inverse(wanted, start=rest, rest=rest, freedom=freedom) is None) == bool(words)


def test_a_motion_that_takes_a_joint_to_its_limit_is_slowed_down_until_it_fits() -> None:
    start = np.array([0.0294, 0.0749, 0.3795, 1.1461, -0.0056])
    goal, limits = (
        hand_down((0.241, -0.0668, 0.0547), -0.3297),
        MotionLimits(joint_velocity=np.full(5, 2.4), joint_acceleration=np.full(5, 16.0)),
    )
    rest = ARM.turned_towards(HOME, goal.position)
    path = plan_straight(ARM, start=start, goal=goal, rest=rest, speed=0.6, limits=limits, dt=1 / 30)
    assert path is not None
    assert path[:, 3].max() == pytest.approx(JAW_ARM.position_upper[3] - 0.01, abs=1e-3)
    assert np.abs(np.diff(path, axis=0)).max() * 30 <= 2.4
    assert np.abs(np.diff(path, 2, axis=0)).max() * 900 <= 16.0


@pytest.mark.parametrize(
    ("home", "is_low"), [(JAW_ARM.home_q, True), ((0.0, -0.0426, 0.0715, 1.5419, 0.0), False)], ids=["low", "high"]
)
def test_objects_are_not_placed_below_a_low_resting_hand(
    home: tuple[float, ...], *, is_low: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("demorec.robots.assets._modules_with_models", {"my_arms"})
    monkeypatch.syspath_prepend(FOLDER)
    robot = replace(JAW_ARM, urdf="my_arms:jaw_arm.urdf", home_q=home)
    gaps = []
    for seed in range(100):
        scene = PickPlace().sample_scene(robot, Sampler(np.random.default_rng(seed)))
        cube = scene.body("red_cube")
        # The fingers' boxes in jaw_arm.urdf, at home: the fixed one is 12 mm thick and begins at y = 0.010 m.
        point, outline = cube.world_from_body.position[:2], ((0.153, 0.167), (0.010 - JAW.max_width - 0.01, 0.022))
        beyond = [max(low - v, v - high, 0.0) for v, (low, high) in zip(point, outline, strict=True)]
        gaps.append(math.hypot(*beyond) - math.sqrt(0.5) * cube.shape.size[0])
    if is_low:
        assert min(gaps) > 0.008, "0.05 rad of a joint are 8 mm of the hand"
    else:
        assert min(gaps) < 0, "the place below a high hand is used"


@pytest.mark.slow
@pytest.mark.usefixtures("without_lerobot")
def test_it_makes_and_checks_a_dataset_with_the_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(FOLDER)
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.delitem(sys.modules, "my_arms", raising=False)
    out = tmp_path / "run"
    flags = ["--robot", "my_arms:JAW_ARM", "--cameras", "none", "--seed", "3", "--workers", "1", "--out", out]
    assert exit_code(*flags, "--num-episodes", "3", program=generate_dataset_main) == 0
    assert exit_code("replay", out / "episodes" / "episode_000000.mcap", "--allow", "my_arms") == 0
    told = capsys.readouterr().out
    assert "3 of 3 asked" in told
    assert "none failed, 0 warnings" in told
    assert "identical, succeeds" in told


@pytest.mark.usefixtures("_in_its_folder")
class TestJawArm(RobotContract):
    robot = "my_arms:JAW_ARM"
    seed = 3

    @pytest.fixture
    @staticmethod
    def _in_its_folder(monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.syspath_prepend(FOLDER)
