"""The commands printed at the end of a run: quoted for the shell, and only those that work."""

from __future__ import annotations

import shlex
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
from support.check import simulate_run
from support.docs import ROOT

from demorec.cli import generate_report
from demorec.cli.generate_report import check_run, has_environment_state, next_commands
from demorec.core.config import GenerateConfig
from demorec.generate.contents import set_aside
from demorec.generate.options import RunResult
from demorec.mcap import Recording
from demorec.runs.run_file import Generation, RunFile, load_run_file, save_run_file


def result_of(folder: Path) -> RunResult:
    run = RunFile(generation=Generation(config=GenerateConfig(), versions={}, num_episodes=1))
    return RunResult(folder=folder, run=run, made=(), interrupted=False)


@pytest.mark.parametrize("folder", ["/data/cubes", "/my data/it's; rm -rf $HOME `x`"])
def test_a_shell_parses_the_commands_correctly(monkeypatch: pytest.MonkeyPatch, folder: str) -> None:
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(shutil, "which", lambda name: f"/bin/{name}")
    monkeypatch.setattr(generate_report, "has_environment_state", lambda result: True)
    view, check, export, train = (shlex.split(line) for line in next_commands(result_of(Path(folder))))
    assert view == ["demorec", "view", folder]
    assert check == ["demorec", "check", folder]
    assert export[:6] == ["demorec", "export", "lerobot", folder, "--out", f"{folder}/policy_data"]
    assert train == ["lerobot-train", "--config_path=examples/act_numbers.json", f"--dataset.root={folder}/policy_data"]


def test_they_are_those_of_the_readme(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(shutil, "which", lambda name: f"/bin/{name}")
    monkeypatch.setattr(generate_report, "has_environment_state", lambda result: True)
    readme = (ROOT / "README.md").read_text().replace("\\\n", " ")
    block = readme.partition("## Train now")[2].partition("```sh\n")[2].partition("```")[0]
    taught = {word for line in block.splitlines() for word in shlex.split(line)}
    *_, export, train = (shlex.split(line) for line in next_commands(result_of(Path("cubes"))))
    assert {*export, train[1]} <= taught


def test_the_users_modules_are_allowed_in_them() -> None:
    config = GenerateConfig(task="mytask:Mine", robot="lab.arms:A1", cameras=("front", "lab.arms:CORNER"))
    result = result_of(Path("/data"))
    result = replace(result, run=result.run.with_generation(config=config))
    for line in next_commands(result)[:2]:
        assert shlex.split(line)[2:] == ["/data", "--allow", "mytask", "--allow", "lab.arms"]


@pytest.mark.parametrize("without", ["the settings", "torch", "an environment state"])
def test_no_training_is_offered_that_would_not_start(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, without: str
) -> None:
    monkeypatch.chdir(tmp_path if without == "the settings" else ROOT)
    monkeypatch.setattr(generate_report, "has_environment_state", lambda result: without != "an environment state")
    if without == "torch":
        monkeypatch.setattr(generate_report, "find_spec", lambda name: None)
    lines = next_commands(result_of(Path("/data")))
    assert len(lines) == 2
    assert "lerobot-train" not in " ".join(lines)


@pytest.mark.slow
@pytest.mark.parametrize(("task", "varies"), [("pick_place", False), ("sort_by_color", True)])
def test_a_run_has_an_environment_state_if_its_scenes_have_as_many_objects(
    tmp_path: Path, task: str, varies: bool
) -> None:
    folder = simulate_run(tmp_path / "run", 2, task=task, seed=6)
    counts = set()
    for path in (folder / "episodes").iterdir():
        with Recording(path) as recording:
            counts.add(len(recording.info.simulated.scene.movable))
    assert (len(counts) > 1) == varies
    result = RunResult(folder=folder, run=load_run_file(folder), made=(), interrupted=False)
    assert has_environment_state(result) is not varies


@pytest.mark.parametrize(
    ("names", "words"),
    [
        ((), []),
        (
            ("dataset/meta/info.json", "dataset/README.md", "dataset.1/meta/info.json"),
            ["2 datasets that the run did not leave like this"],
        ),
        (
            (
                "episode_000003.mcap",
                "host-12-0/episode_000004.mcap.part",
                "host-12-0/episode_000005.mcap.part",
                "error_episode_000004.txt",
            ),
            [
                "1 recording not of this run, or damaged",
                "1 unfinished recording (demorec recover keeps the complete frames)",
                "1 unfinished recording in which nothing was written",
                "1 error report",
            ],
        ),
        (("README.md", "README.md.1"), ["2 edited dataset cards"]),
        (("notes.txt", "episode_notes.txt", "draft.part", "error_list.txt", "mine/episode_000001.mcap"), []),
    ],
)
def test_files_set_aside_are_described(tmp_path: Path, names: Sequence[str], words: list[str]) -> None:
    for name in names:
        file = tmp_path / "unfinished" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(b"" if "000005" in name else b"something")
    assert set_aside(tmp_path) == words


@pytest.mark.slow
def test_the_checks_that_warned_are_named(tmp_path: Path) -> None:
    folder = simulate_run(tmp_path / "run", 1, seed=6)
    run = load_run_file(folder)
    complete = RunResult(folder=folder, run=run, made=(), interrupted=False)
    assert check_run(complete, progress=lambda done, total: None) == ("none failed, 0 warnings", [])
    save_run_file(run.with_generation(num_episodes=2), folder)
    summary, failures = check_run(complete, progress=lambda done, total: None)
    assert summary == "none failed, 1 warning (run_complete)"
    assert failures == []
