"""The robot's description in a dataset: other tools place the arm by it, and checks detect that of another robot."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pybullet
import pytest
from rerun.chunk import RrdReader
from support.check import verdict_of
from support.export import data_table, export
from support.external import TOP, URDF, Episode, make_external, write_external

from demorec.core.errors import MissingDependencyError
from demorec.datasets.lerobot.folder import LeRobotFolder
from demorec.datasets.lerobot.robots import portable_urdf, read_robot
from demorec.extensions.imports.dataset_import import import_lerobot
from demorec.mcap import Recording
from demorec.view import bodies as played_robot
from demorec.view.from_dataset import open_dataset_episode
from demorec.view.scene import save
from demorec.view.sources import find_episodes

SAMPLE = Path(__file__).parents[2] / "recordings" / "sample" / "pick_place.mcap"


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("robots") / "cubes"
    export(SAMPLE, folder)
    return folder


@pytest.fixture
def dataset(exported: Path, tmp_path: Path) -> Path:
    """A copy to be damaged."""
    return Path(shutil.copytree(exported, tmp_path / "cubes"))


def files_of(root: Path) -> tuple[Path, Path]:
    """The only JSON file and the only URDF."""
    (record,), (urdf,) = ((root / "demorec" / "robots").glob(f"*{kind}") for kind in (".json", ".urdf"))
    return record, urdf


def two_joints(**arguments: Any) -> Episode:
    return make_external(cameras=(TOP,), **arguments)


def test_another_program_places_the_arm_as_it_was_recorded(exported: Path, tmp_path: Path) -> None:
    """PyBullet's own URDF reader gets that file alone, and the element names of the JSON file."""
    record_file, urdf_file = files_of(exported)
    record = json.loads(record_file.read_text())
    alone = Path(shutil.copy(urdf_file, tmp_path))
    rows = data_table(exported).to_pylist()
    with Recording(SAMPLE) as recording:
        recorded = recording.trajectory().base_from_tcp
    client = pybullet.connect(pybullet.DIRECT)
    try:
        body = pybullet.loadURDF(str(alone), useFixedBase=True, physicsClientId=client)
        joints, links = {}, {}
        for index in range(pybullet.getNumJoints(body, physicsClientId=client)):
            told = pybullet.getJointInfo(body, index, physicsClientId=client)
            joints[told[1].decode()], links[told[12].decode()] = index, index
        drawn = {shape[1] for shape in pybullet.getVisualShapeData(body, physicsClientId=client)}
        tcp = links[record["spec"]["tcp_link"]]
        for frame in range(0, len(rows), 20):
            for feature, names in record["joints"].items():
                for name, value in zip(names, rows[frame][feature], strict=True):
                    if name:
                        pybullet.resetJointState(body, joints[name], value, physicsClientId=client)
            state = pybullet.getLinkState(body, tcp, computeForwardKinematics=True, physicsClientId=client)
            assert np.abs(np.array(state[4]) - recorded[frame, :3]).max() < 1e-5
            turned = np.array(state[5]) / np.linalg.norm(state[5])
            assert abs(abs(float(np.dot(turned, recorded[frame, 3:]))) - 1.0) < 1e-9
    finally:
        pybullet.disconnect(client)
    assert {-1, links["panda_link1"], links["panda_hand"]} <= drawn  # the base is -1


def test_meshes_are_not_copied(exported: Path) -> None:
    record_file, urdf_file = files_of(exported)
    record = json.loads(record_file.read_text())
    assert record["spec"]["urdf"] == "franka_panda/panda.urdf"
    assert "<mesh" not in urdf_file.read_text()
    assert {path.suffix for path in (exported / "demorec" / "robots").iterdir()} == {".json", ".urdf"}


def test_no_path_of_the_machine_gets_into_a_dataset() -> None:
    home, installed = "/home/somebody/ws", "/opt/ros/jazzy/share"
    mesh = '<link name="l{0}"><visual><geometry><mesh filename="{1}" scale="1 1 1"/></geometry></visual></link>'
    names = {
        "package://arm/link.stl": "package://arm/link.stl",
        "meshes/link.stl": "meshes/link.stl",
        f"file://{installed}/arm_description/meshes/link.dae": "package://arm_description/meshes/link.dae",
        f"{installed}/arm_description/meshes/link.dae": "package://arm_description/meshes/link.dae",
        f"file://{home}/src/arm/link.stl": "link.stl",
        f"{home}/link.stl": "link.stl",
        "~/arm/link.stl": "link.stl",
        "C:\\Users\\somebody\\link.stl": "link.stl",
    }
    links = "".join(mesh.format(number, name) for number, name in enumerate(names))
    joints = "".join(
        f'<joint name="j{n}" type="fixed"><parent link="l0"/><child link="l{n}"/></joint>' for n in range(1, len(names))
    )
    text = (
        f"<robot name='arm'><!-- autogenerated by xacro from {home}/arm.urdf.xacro -->{links}{joints}"
        f"<gazebo><parameters>{home}/controllers.yaml</parameters></gazebo></robot>"
    )
    found = portable_urdf(text)
    for word in ("somebody", "/opt", "xacro", "gazebo"):
        assert word in text
        assert word not in found
    for name in names.values():
        assert f'filename="{name}"' in found
    assert portable_urdf(found) == found


def spoil_text(root: Path) -> None:
    """Make a link a centimetre longer."""
    _, urdf = files_of(root)
    text = urdf.read_text()
    changed = text.replace('xyz="0 -0.316 0"', 'xyz="0 -0.326 0"')
    assert changed != text
    urdf.write_text(changed)


def spoil_record(root: Path) -> None:
    record, _ = files_of(root)
    text = record.read_text()
    assert '"panda_grasptarget"' in text
    record.write_text(text.replace('"panda_grasptarget"', '"panda_hand"'))


def swap_joints(root: Path) -> None:
    record, _ = files_of(root)
    text = record.read_text().replace("panda_joint1", "x").replace("panda_joint2", "panda_joint1")
    record.write_text(text.replace('"x"', '"panda_joint2"'))


FAULTS: dict[str, Callable[[Path], object]] = {
    "no URDF": lambda root: files_of(root)[1].unlink(),
    "no JSON": lambda root: files_of(root)[0].unlink(),
    "another URDF": spoil_text,
    "another TCP": spoil_record,
    "joints swapped": swap_joints,
    "no JSON in it": lambda root: files_of(root)[0].write_text("[1"),
    "no folder": lambda root: shutil.rmtree(root / "demorec" / "robots"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", FAULTS)
def test_a_description_that_changed_is_found(name: str, dataset: Path) -> None:
    FAULTS[name](dataset)
    assert verdict_of(dataset, "unreadable_episodes", "dataset") == "broken"


def test_an_arm_whose_model_is_not_installed_is_drawn_from_the_dataset(
    exported: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def missing(name: str) -> Path:
        raise MissingDependencyError("Loading robot models", "pybullet", "pip install pybullet")

    played_robot.robot_model.cache_clear()
    monkeypatch.setattr(played_robot, "asset_path", missing)
    save(find_episodes([exported])[0], tmp_path / "a.rrd")
    played_robot.robot_model.cache_clear()
    assert {"panda_link0", "panda_link6", "panda_hand"} <= meshes_in(tmp_path / "a.rrd")


def meshes_in(path: Path) -> set[str]:
    """Names of the links that a Rerun file draws."""
    return {
        chunk.entity_path.rsplit("/", 1)[-1]
        for chunk in RrdReader(path).stream()
        if "Mesh3D:vertex_positions" in chunk.to_record_batch().schema.names
    }


def test_an_external_arm_moves_by_its_numbers(tmp_path: Path) -> None:
    given = two_joints(num_frames=12)
    degrees = [replace(feature, units=("deg", "rad", "")) for feature in given.info.features[:1]]
    given = replace(given, info=replace(given.info, features=(*degrees, *given.info.features[1:])))
    export(write_external(tmp_path / "a.mcap", given), tmp_path / "d")
    with open_dataset_episode(LeRobotFolder(tmp_path / "d"), 0) as episode:
        assert episode.info.simulation is None
        state = np.array([frame.samples["observation.state"].vector for frame in given.frames])
        np.testing.assert_allclose(episode.motion.joint_position["shoulder"], np.deg2rad(state[:, 0]), atol=1e-7)
        np.testing.assert_array_equal(episode.motion.joint_position["elbow"], state[:, 1])
    save(find_episodes([tmp_path / "d"])[0], tmp_path / "a.rrd")
    assert meshes_in(tmp_path / "a.rrd") == {"base", "upper", "lower"}


def test_a_third_party_dataset_is_shown_with_the_arm_of_its_joint_names(exported: Path, tmp_path: Path) -> None:
    """Without demorec's files: numbers, outcome and instruction come from LeRobot's own tables."""
    strange = tmp_path / "strange"
    shutil.copytree(exported, strange)
    with open_dataset_episode(LeRobotFolder(exported), 0) as known:
        assert known.info.simulation is not None
        arm_joints = known.info.simulated.robot.arm_joints
    shutil.rmtree(strange / "demorec")
    with open_dataset_episode(LeRobotFolder(strange), 0) as episode:
        assert episode.info.simulation is None
        for name in arm_joints:
            np.testing.assert_array_equal(episode.motion.joint_position[name], known.motion.joint_position[name])
        assert (episode.info.instruction, episode.verdict) == (known.info.instruction, known.verdict)
        assert list(episode.videos) == list(known.videos)
    (source,) = find_episodes([strange])
    save(source, tmp_path / "a.rrd")
    assert {"panda_link0", "panda_link6", "panda_hand"} <= meshes_in(tmp_path / "a.rrd")


def test_one_dataset_holds_different_arms(tmp_path: Path) -> None:
    longer = URDF.replace('xyz="0.3 0 0"', 'xyz="0.4 0 0"')
    assert longer != URDF
    for number, urdf in enumerate((URDF, longer, URDF, "")):
        episode = two_joints(num_frames=10, urdf=urdf, episode_index=number)
        if not urdf:
            info = episode.info
            plain = tuple(replace(feature, joints=()) for feature in info.features)
            episode = replace(episode, info=replace(info, features=plain))
        export(write_external(tmp_path / f"{number}.mcap", episode), tmp_path / "d", append=True)
    tables = sorted((tmp_path / "d" / "demorec" / "episodes").rglob("*.parquet"))
    names = [name for table in tables for name in pq.read_table(table).column("robot_digest").to_pylist()]
    assert names[0] == names[2] != names[1]
    assert names[3] is None
    assert len(list((tmp_path / "d" / "demorec" / "robots").iterdir())) == 4
    assert 'xyz="0.4 0 0"' in read_robot(tmp_path / "d", names[1]).urdf
    imported = import_lerobot([tmp_path / "d"], None, tmp_path / "run")
    assert (imported.num_new, "demorec/robots" in imported.left_out) == (4, True)
    with open_dataset_episode(LeRobotFolder(tmp_path / "d"), 1) as played:
        assert played.info.simulation is None
        assert 'xyz="0.4 0 0"' in str(played.data.description())
