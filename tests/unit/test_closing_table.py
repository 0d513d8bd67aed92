"""The commands printed at the end of a run: quoted for the shell."""

from __future__ import annotations

import shlex
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from support.check import simulate_run

from demorec.cli.generate_report import check_run, next_commands
from demorec.core.config import GenerateConfig
from demorec.generate.options import RunResult
from demorec.runs.run_file import GeneratedRun, load_run_file, save_run_file


def result_of(folder: Path) -> RunResult:
    run = GeneratedRun(config=GenerateConfig(), versions={}, num_episodes=1)
    return RunResult(folder=folder, run=run, made=(), seconds=0.0, interrupted=False)


@pytest.mark.parametrize("folder", ["/data/cubes", "/my data/it's; rm -rf $HOME `x`"])
def test_a_shell_parses_the_commands_correctly(monkeypatch: pytest.MonkeyPatch, folder: str) -> None:
    monkeypatch.setattr(shutil, "which", lambda name: f"/bin/{name}")
    view, check = (shlex.split(line) for line in next_commands(result_of(Path(folder))))
    assert view == ["demorec", "view", folder]
    assert check == ["demorec", "check", folder]


def test_the_users_modules_are_allowed_in_them() -> None:
    config = GenerateConfig(task="mytask:Mine", robot="lab.arms:A1", cameras=("front", "lab.arms:CORNER"))
    result = result_of(Path("/data"))
    result = replace(result, run=replace(result.run, config=config))
    for line in next_commands(result):
        assert shlex.split(line)[2:] == ["/data", "--allow", "mytask", "--allow", "lab.arms"]


@pytest.mark.slow
def test_the_checks_that_warned_are_named(tmp_path: Path) -> None:
    folder = simulate_run(tmp_path / "run", 1, seed=6)
    run = load_run_file(folder)
    complete = RunResult(folder=folder, run=run, made=(), seconds=0.0, interrupted=False)
    assert check_run(complete, progress=lambda done, total: None) == ("none failed, 0 warnings", [])
    save_run_file(replace(run, num_episodes=2), folder)
    summary, failures = check_run(complete, progress=lambda done, total: None)
    assert summary == "none failed, 1 warning (run_complete)"
    assert failures == []
