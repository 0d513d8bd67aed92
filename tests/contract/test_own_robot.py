"""The robot and camera of examples/own_robot, used outside of this repository as docs/robots.md describes."""

from __future__ import annotations

import os
import re
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from support.commands import exit_code

from demorec.cli import generate_dataset_main
from demorec.core.config import EpisodePlan, GenerateConfig, deciding_versions
from demorec.core.errors import ConfigError, SceneError
from demorec.core.own_versions import changed_sources, own_versions, source_digest
from demorec.generate.options import RunOptions
from demorec.generate.run import generate
from demorec.generate.worker import make_episode
from demorec.mcap import Recording
from demorec.robots.assets import allow_models, asset_path, data_folder, model_name
from demorec.runs.run_file import load_run_file

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples" / "own_robot"
XARM6 = "my_robots:XARM6"


def forget(*modules: str) -> None:
    for name in modules:
        sys.modules.pop(name, None)
    source_digest.cache_clear()


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The example's folder is the current folder but is not importable, as for the installed commands."""
    folder = tmp_path / "mine"
    shutil.copytree(EXAMPLE, folder)
    monkeypatch.chdir(folder)
    before = list(sys.path)
    sys.path[:] = [entry for entry in sys.path if entry not in ("", str(folder))]
    forget("my_robots")
    yield folder
    sys.path[:] = before
    forget("my_robots")


@pytest.mark.slow
@pytest.mark.long
def test_the_example_makes_checks_and_replays_a_dataset(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    run = tmp_path / "run"
    flags = ["--robot", XARM6, "--cameras", "front", "my_robots:CORNER", "--width", "64", "--height", "64"]
    assert exit_code(*flags, "--num-episodes", "2", "--workers", "1", "--out", run, program=generate_dataset_main) == 0
    told = capsys.readouterr().out
    assert "2 of 2 asked" in told
    assert re.search(r"checks +none failed", told)
    recording = run / "episodes" / "episode_000000.mcap"
    with Recording(recording) as opened:
        assert opened.cameras == ("front", "corner")
        assert opened.info.simulated.robot.urdf == "my_robots:xarm6.urdf"  # and no path of this machine
        assert opened.info.versions == load_run_file(run).versions
    assert (run / "dataset" / "videos" / "observation.images.corner").is_dir()

    # Elsewhere, without the module: the recording suffices for viewing and checking, and names the module that a replay
    # needs.
    (folder / "xarm6.urdf").rename(tmp_path / "xarm6.urdf")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("demorec.robots.assets._modules_with_models", set())
    assert exit_code("check", recording, "--no-images") == 0
    assert exit_code("view", recording, "--save", tmp_path / "view.rrd") == 0
    capsys.readouterr()
    assert exit_code("replay", recording) == 2
    assert "add --allow my_robots." in capsys.readouterr().err

    (tmp_path / "xarm6.urdf").rename(folder / "xarm6.urdf")
    monkeypatch.chdir(folder)
    assert exit_code("replay", recording, "--allow", "my_robots") == 0
    assert "identical, succeeds" in capsys.readouterr().out

    # Once the file has changed, the run cannot continue, and replay prints a note.
    (folder / "my_robots.py").write_text((folder / "my_robots.py").read_text() + "\nFASTER = True\n")
    forget("my_robots")
    assert exit_code(*flags, "--num-episodes", "3", "--workers", "1", "--out", run, program=generate_dataset_main) == 2
    assert "holds another run (the source of my_robots has changed)" in capsys.readouterr().err
    assert exit_code("replay", recording, "--allow", "my_robots") == 0
    assert "Note: the source of my_robots has changed since this was recorded." in capsys.readouterr().err


def fixed_to_the_tool(origin: str) -> list[tuple[str, str]]:
    """Changes that move or turn the tcp relative to the example's."""
    joint = f'<parent link="true"/><child link="tcp"/><origin {origin}/>'
    link = f'<link name="true"/><joint name="t" type="fixed">{joint}</joint>'
    return [('<child link="tcp"/>', '<child link="true"/>'), ("</robot>", f"{link}</robot>")]


def edited(path: Path, *changes: tuple[str, str]) -> None:
    text = path.read_text()
    for old, new in changes:
        assert old in text, old
        text = text.replace(old, new)
    path.write_text(text)


@pytest.mark.parametrize(
    ("file", "changes", "words"),
    [
        (
            "my_robots.py",
            [('tcp_link="tcp"', 'tcp_link="tpc"')],
            r"does not fit its URDF: tcp_link names the link 'tpc', which the URDF lacks. Did you mean 'tcp'\?",
        ),
        ("my_robots.py", [('base_link="stand"', 'base_link="base"')], "the URDF's root is 'stand'; name that one"),
        ("my_robots.py", [('"joint5", "joint6"', '"joint6", "joint5"')], "name just these, in this order"),
        ("my_robots.py", [("50.0, 50.0, 32.0", "50.0, 32.0")], "torque_limit has 5 numbers for 6 arm joints"),
        ("my_robots.py", [("home_q=(0.0", "home_q=(9.0")], "home_q of joint1 is 9 rad; choose one within its limits"),
        ("my_robots.py", [("max_width=0.10", "max_width=0.20")], "set max_width to twice its stroke"),
        (
            "my_robots.py",
            [("urdf=", "task_scale=0.2,\n    urdf=")],
            "pointing down, takes .* of 81 poses 0.07 to 0.13 m",
        ),
        ("my_robots.py", [("finger_depth=0.010", "finger_depth=0.050")], "correct finger_depth"),
        (
            "xarm6.urdf",
            [('"prismatic"', '"revolute"')],
            r"'gripper_left_joint' is revolute, a ParallelGripper has two prismatic joints; docs/robots.md",
        ),
        (
            "xarm6.urdf",
            [('type="revolute">', 'type="revolute"><dynamics friction="90"/>')],
            "the friction of joint1 is 90",
        ),
        (
            "xarm6.urdf",
            [('<mass value="', '<mass value="-')],
            r"cannot be simulated, since its URDF lacks the masses of these links: 'link1' \(a mass of -",
        ),
        (
            "xarm6.urdf",
            fixed_to_the_tool('xyz="0 0 -0.06"'),
            r"the finger tips are 0\.0\d\d m beyond tcp_link 'tcp'; finger_depth is 0.01; move tcp_link by",
        ),
        (
            "xarm6.urdf",
            fixed_to_the_tool('xyz="0 0 0.1"'),
            r"the fingers end 0\.0\d\d m before tcp_link 'tcp'; place it between the finger tips",
        ),
        (
            "xarm6.urdf",
            fixed_to_the_tool('rpy="0 0 1.5708"'),
            "the fingers move along x of tcp_link 'tcp'; turn it about its z by 90 degrees",
        ),
    ],
)
def test_a_robot_that_does_not_fit_is_refused_before_anything_is_made(
    file: str,
    changes: list[tuple[str, str]],
    words: str,
    folder: Path,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    edited(folder / file, *changes)
    flags = ["--robot", XARM6, "--cameras", "none", "--num-episodes", "1", "--out", tmp_path / "run"]
    assert exit_code(*flags, program=generate_dataset_main) == 2
    told = capfd.readouterr()
    assert told.out == ""
    end = r"(: my_robots:xarm6\.urdf|: mend my_robots\.py:\d+: .*)\n"
    assert re.fullmatch(rf"generate-dataset: The .*{words}.*{end}", told.err)
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_a_plug_in_of_gazebo_is_not_a_mesh_and_ros_names_lead_to_the_package(folder: Path, tmp_path: Path) -> None:
    """A vendor's layout: my_arm_description/urdf/arm.urdf next to my_arm_description/meshes."""
    package = tmp_path / "my_arm_description"
    shutil.copytree(data_folder() / "xarm/xarm_description/meshes/xarm6", package / "meshes")
    (package / "urdf").mkdir()
    for name in ("my_robots.py", "xarm6.urdf"):
        shutil.move(folder / name, package / "urdf" / name)
    plugin = '<gazebo><plugin name="p" filename="libgazebo_ros_control.so"/></gazebo>'
    edited(
        package / "urdf" / "xarm6.urdf",
        (
            'mesh filename="xarm/xarm_description/meshes/xarm6/',
            'mesh scale="1 1 1" filename=\'package://my_arm_description/meshes/',
        ),
        ('.obj"', ".obj'"),
        ('.stl"', ".stl'"),
        ("</robot>", f"<!-- <mesh filename='old.stl'/> -->{plugin}</robot>"),
    )
    os.chdir(package / "urdf")
    config = GenerateConfig(robot=XARM6, cameras=())
    before = deciding_versions(config)
    options = RunOptions(out=tmp_path / "run", num_episodes=1, workers=1)
    assert len(generate(config, options).run.successes) == 1
    mesh = package / "meshes" / "visual" / "base.stl"
    mesh.write_bytes(mesh.read_bytes() + b" ")
    assert before != deciding_versions(config), "a mesh is part of the model"


def test_a_fresh_worker_does_not_mix_an_edited_module_in(folder: Path, tmp_path: Path) -> None:
    config = GenerateConfig(robot=XARM6, cameras=())
    plan = EpisodePlan(config=config, episode_index=0, versions=deciding_versions(config))
    (folder / "my_robots.py").write_text((folder / "my_robots.py").read_text() + "# faster\n")
    forget("my_robots")
    for place in ("episodes", "failed", "unfinished"):
        (tmp_path / "run" / place).mkdir(parents=True)
    with pytest.raises(ConfigError, match="have changed since its start: the source of my_robots has changed"):
        make_episode(plan, tmp_path / "run")


def test_a_model_that_changed_is_another_version(folder: Path) -> None:
    config = GenerateConfig(robot=XARM6, cameras=())
    before = deciding_versions(config)
    assert before.keys() - deciding_versions().keys() == {"source of my_robots", "source of my_robots:xarm6.urdf"}
    urdf = folder / "xarm6.urdf"
    urdf.write_text(urdf.read_text().replace('effort="50.0"', 'effort="40.0"'))
    after = deciding_versions(config)
    assert {name for name in after if after[name] != before[name]} == {"source of my_robots:xarm6.urdf"}
    assert changed_sources(before, ["my_robots"]) == ("the source of my_robots:xarm6.urdf has changed",)
    assert changed_sources(before, []) == ()  # unreadable
    assert deciding_versions(GenerateConfig()) == deciding_versions()


def test_a_module_counts_with_its_file_and_a_package_with_all_of_its_files(folder: Path) -> None:
    (folder / "my_tasks.py").write_text("A = 1\n")
    (folder / "arms" / "deep" / "__pycache__").mkdir(parents=True)
    files = ("arms/__init__.py", "arms/one.py", "arms/deep/two.py", "arms/deep/mug.obj")
    left_out = ("arms/.notes", "arms/deep/__pycache__/two.pyc")
    for name in (*files, *left_out):
        (folder / name).write_text("")

    def digests() -> tuple[str, str]:
        forget("my_tasks")
        versions = own_versions(["my_tasks", "arms.one"])
        return versions["source of my_tasks"], versions["source of arms.one"]

    before = first = digests()
    for name in ("my_robots.py", *left_out):  # next to the module, but not source code
        (folder / name).write_text((folder / name).read_text() + "# edited\n")
        assert digests() == first
    (folder / "my_tasks.py").write_text("A = 2\n")
    assert digests()[0] != first[0]
    for name in files:
        (folder / name).write_text("# edited\n")
        assert digests()[1] != before[1], name
        before = digests()
    (folder / "arms/deep/mug.obj").rename(folder / "arms/deep/cup.obj")
    assert digests()[1] != before[1]
    assert "arms.one" not in sys.modules  # read, not run


def test_models_are_found_in_every_allowed_place_and_nowhere_else(folder: Path, tmp_path: Path) -> None:
    panda = "franka_panda/panda.urdf"
    for name, wanted in {
        str(folder / "xarm6.urdf"): "my_robots:xarm6.urdf",
        panda: panda,
        str(data_folder() / panda): panda,
    }.items():
        assert model_name(name, "my_robots") == wanted
    shutil.copy(folder / "xarm6.urdf", tmp_path / "xarm6.urdf")
    with pytest.raises(ConfigError, match="put it next to the module, found "):
        model_name(str(tmp_path / "xarm6.urdf"), "my_robots")
    allow_models(["my_robots"])
    with pytest.raises(SceneError, match="is outside"):
        asset_path("my_robots:../xarm6.urdf")


def test_the_document_shows_the_files(folder: Path) -> None:
    text = (ROOT / "docs" / "robots.md").read_text()
    (shown,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    assert shown == (EXAMPLE / "my_robots.py").read_text()
