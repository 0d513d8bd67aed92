"""The commands at the end of a run: quoted for the shell, and only those that start."""

from __future__ import annotations

import shlex
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from demorec.cli import generate_report
from demorec.cli.generate_report import next_commands
from demorec.core.config import GenerateConfig
from demorec.generate.contents import set_aside
from demorec.generate.options import RunResult
from demorec.runs.run_file import ExportRecord, Generation, RunFile


def result_of(folder: Path, *, cameras: tuple[str, ...] = ("front",)) -> RunResult:
    run = RunFile(generation=Generation(config=GenerateConfig(cameras=cameras), versions={}, num_episodes=1))
    return RunResult(folder=folder, run=run, made=(), interrupted=False)


EXPORT = ExportRecord(run_digest="12", repo_id="me/cubes")


@pytest.mark.parametrize("folder", ["/data/cubes", "/my data/it's; rm -rf $HOME `x`"])
def test_a_shell_reads_them_as_they_are_meant(monkeypatch: pytest.MonkeyPatch, folder: str) -> None:
    monkeypatch.setattr(shutil, "which", lambda name: f"/bin/{name}")
    view, check, train = (shlex.split(line) for line in next_commands(result_of(Path(folder)), EXPORT))
    assert view == ["demorec", "view", folder]
    assert check == ["demorec", "check", folder]
    assert train[:3] == ["lerobot-train", "--dataset.repo_id=me/cubes", f"--dataset.root={folder}/dataset"]


def test_modules_of_the_users_own_are_allowed_in_them() -> None:
    config = GenerateConfig(task="mytask:Mine", robot="lab.arms:A1", cameras=("front", "lab.arms:CORNER"))
    result = result_of(Path("/data"))
    result = replace(result, run=result.run.with_generation(config=config))
    for line in next_commands(result, None):
        assert shlex.split(line)[2:] == ["/data", "--allow", "mytask", "--allow", "lab.arms"]


@pytest.mark.parametrize("without", ["a dataset", "images", "torch"])
def test_no_training_is_offered_that_would_not_start(monkeypatch: pytest.MonkeyPatch, without: str) -> None:
    if without == "torch":
        monkeypatch.setattr(generate_report, "find_spec", lambda name: None)
    result = result_of(Path("/data"), cameras=() if without == "images" else ("front",))
    lines = next_commands(result, None if without == "a dataset" else EXPORT)
    assert len(lines) == 2
    assert "lerobot-train" not in " ".join(lines)


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
                "1 unfinished recording (demorec recover keeps what is whole)",
                "1 unfinished recording in which nothing was written",
                "1 error report",
            ],
        ),
        (("README.md", "README.md.1"), ["2 edited dataset cards"]),
        (("notes.txt", "episode_notes.txt", "draft.part", "error_list.txt", "mine/episode_000001.mcap"), []),
    ],
)
def test_what_was_set_aside_is_told_by_what_it_is(tmp_path: Path, names: Sequence[str], words: list[str]) -> None:
    for name in names:
        file = tmp_path / "unfinished" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(b"" if "000005" in name else b"something")
    assert set_aside(tmp_path) == words
