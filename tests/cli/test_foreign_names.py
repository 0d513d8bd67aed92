"""Names inside files run no code: recordings, runs, datasets and policies name a module that would mark its import."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from support.check import Spoilt
from support.commands import ON_A_PATH, exit_code, words_of

from demorec.core.config import GenerateConfig
from demorec.core.errors import NotAllowedError
from demorec.core.plain import to_plain
from demorec.datasets.lerobot.export import export_lerobot
from demorec.datasets.lerobot.options import ExportOptions
from demorec.episode.simulated import with_simulation
from demorec.runs.recorded import inspect_recording
from demorec.runs.run_file import GeneratedRun, save_run_file

SAMPLE = next((Path(__file__).parents[2] / "recordings" / "sample").glob("*.mcap"))
MODULE = "names_of_a_stranger"
SOURCE = '''
from pathlib import Path
from demorec.tasks.pick import PickPlace

Path(__file__).with_name("marker").touch()

class Mine(PickPlace):
    """A task like another."""
'''
HARMFUL = ["os:abort", "demorec.core.errors:DemorecError", "a:b:c", ""]


@pytest.fixture
def marker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Path that exists once the untrusted module, which is importable, has been imported."""
    folder = tmp_path / "somewhere"
    folder.mkdir()
    (folder / f"{MODULE}.py").write_text(SOURCE)
    monkeypatch.syspath_prepend(str(folder))
    monkeypatch.chdir(folder)
    yield folder / "marker"
    sys.modules.pop(MODULE, None)


def recording_of(name: str, path: Path) -> Path:
    """Record an episode whose task, robot, camera and renderer are named `name`; its camera is not at its pose."""
    spoilt = Spoilt(SAMPLE)
    camera = spoilt.info.simulated.scene.cameras[0].name
    config = GenerateConfig(task=name, robot=name, cameras=(name,), width=64, height=64, variation="full")
    spoilt.info = with_simulation(
        spoilt.info,
        task=name,
        config=to_plain(config),
        behaviour={**spoilt.info.simulated.behaviour, f"calibration_{camera}_x": 0.01},
    )
    spoilt.frames = spoilt.frames[:8]
    path.parent.mkdir(parents=True, exist_ok=True)
    return spoilt.write(path)


def run_of(name: str, folder: Path) -> Path:
    file = "episodes/episode_000000.mcap"
    attempt = replace(inspect_recording(recording_of(name, folder / file))[0], file=file, success=True)
    config = GenerateConfig(task=name, robot=name, cameras=(name,))
    save_run_file(GeneratedRun(config=config, versions={}, num_episodes=1, attempts=(attempt,)), folder)
    return folder


def dataset_of(name: str, folder: Path, source: Path) -> Path:
    export_lerobot([source], folder, ExportOptions(verify=False, include_failures=True))
    (table_path,) = (folder / "demorec" / "episodes").rglob("*.parquet")
    table = pq.read_table(table_path)
    (described,) = table.column("episode_info").to_pylist()
    assert json.loads(described)["simulation"]["task"] == name  # the export kept the untrusted name
    assert isinstance(table, pa.Table)
    return folder


COMMANDS = {
    **ON_A_PATH,
    "check": "check PATH --deep --no-images",
}
"""Every command that reads third-party files."""


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["recording", "run", "dataset"])
def test_no_command_imports_what_a_file_names(
    kind: str, tmp_path: Path, marker: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    name = f"{MODULE}:Mine"
    path = recording_of(name, tmp_path / "alone.mcap") if kind == "recording" else run_of(name, tmp_path / "run")
    if kind == "dataset":
        path = dataset_of(name, tmp_path / "dataset", path)
    refused = set()
    for command, call in COMMANDS.items():
        (tmp_path / "out" / command).mkdir(parents=True)
        code = exit_code(*words_of(call, path, tmp_path / "out" / command / "new"))
        told = capsys.readouterr()
        assert not marker.exists(), command
        assert MODULE not in sys.modules, command
        assert "Traceback" not in told.err, command
        if f"add --allow {MODULE}" in told.err:
            refused.add(command)
            assert code == 2, command
            assert not list((tmp_path / "out" / command).rglob("*")), "a refused request leaves nothing behind"
    assert refused == (set() if kind == "dataset" else {"replay", "generate"})


@pytest.mark.slow
@pytest.mark.parametrize(
    "words",
    [["check", "--no-images", "--deep"], ["replay"]],
    ids=lambda words: words[0],
)
def test_allowed_modules_are_imported(
    words: list[str], tmp_path: Path, marker: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = recording_of(f"{MODULE}:Mine", tmp_path / "alone.mcap")
    exit_code(*words, path, "--allow", MODULE)
    assert marker.exists()
    assert "add --allow" not in capsys.readouterr().err


def without_notes(told: str) -> list[str]:
    """Lines except notes about different versions."""
    return [line for line in told.splitlines() if not line.startswith("Note: ")]


@pytest.mark.parametrize("name", HARMFUL)
def test_harmful_names_are_one_sentence_even_if_their_module_is_allowed(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = run_of(name, tmp_path / "run")
    for call in (COMMANDS["replay"], COMMANDS["generate"]):
        assert exit_code(*words_of(call, run, tmp_path / "out")) == 2
        told = capsys.readouterr().err
        assert len(without_notes(told)) == 1, told
    assert exit_code("replay", run, "--allow", name.partition(":")[0] or "a") == 2
    told = capsys.readouterr().err
    assert len(without_notes(told)) == 1, told
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["my_tasks:Mine", "my tasks", "", "../my_tasks", "my_tasks.py:"])
def test_invalid_module_names_are_refused(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_code("replay", tmp_path / "any.mcap", "--allow", name) == 2
    assert "--allow names a module or package, for example my_tasks, found" in capsys.readouterr().err


def test_a_policy_cannot_name_the_code_of_its_steps_nor_its_cameras(tmp_path: Path, marker: Path) -> None:
    from demorec.extensions.policies.rollouts import settings_for

    policy = tmp_path / "policy"
    policy.mkdir()
    shape = {"type": "VISUAL", "shape": [3, 64, 64]}
    config = {"type": "act", "input_features": {f"observation.images.{MODULE}:Mine": shape}}
    (policy / "config.json").write_text(json.dumps(config))
    with pytest.raises(NotAllowedError, match=f"add --allow {MODULE}"):
        settings_for(policy, GenerateConfig(cameras=()), action="joint")
    (policy / "config.json").write_text(json.dumps({"type": "act", "input_features": {}}))
    steps = [{"registry_name": "to_batch_processor"}, {"class": f"{MODULE}.Mine"}, 7, {"class": 3}]
    (policy / "policy_preprocessor.json").write_text(json.dumps({"steps": steps}))
    with pytest.raises(NotAllowedError, match=f"add --allow {MODULE}"):
        settings_for(policy, GenerateConfig(cameras=()), action="joint")
    (policy / "policy_preprocessor.json").write_text(json.dumps({"steps": steps[:2]}))
    assert settings_for(policy, GenerateConfig(cameras=()), action="joint", allowed=[MODULE]).policy_type == "act"
    assert not marker.exists()


@pytest.mark.parametrize(
    "file", ["/etc/hostname", "../../secret.urdf", "demorec:../robots/panda.py", "stranger:abort.urdf"]
)
def test_models_named_by_a_file_must_be_in_known_folders(file: str) -> None:
    from demorec.core.errors import DemorecError
    from demorec.robots.assets import asset_path

    with pytest.raises(DemorecError, match=r"is outside|add --allow stranger\."):
        asset_path(file)
