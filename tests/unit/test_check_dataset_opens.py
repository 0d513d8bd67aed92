"""Helpful messages for datasets that LeRobot cannot open."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any

import pytest
from support.commands import exit_code
from support.export import export

from demorec.check.base import Finding
from demorec.extensions.doctor.checks import lerobot_opens
from demorec.extensions.doctor.from_dataset import ReadOptions, evidence_of_dataset

SAMPLE = Path(__file__).parents[2] / "recordings" / "sample" / "pick_place.mcap"
_OF_LEROBOT = "OfflineModeIsEnabled: Cannot reach the Hub: please unset the `HF_HUB_OFFLINE` environment variable."
"""LeRobot 0.6.1's last line when a file of the dataset is missing: it requests the file from the Hub."""


def opened(dataset: Path) -> tuple[Finding, ...]:
    """Findings of opening it with LeRobot."""
    evidence = evidence_of_dataset(dataset, ReadOptions(images=False, lerobot=True))
    result = lerobot_opens.lerobot_opens.run(evidence)
    assert result is not None
    return result.findings


def stand_in(module: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Make a package that is imported in place of LeRobot."""
    package = folder / "lerobot" / "datasets"
    package.mkdir(parents=True)
    (package.parent / "__init__.py").touch()
    (package / "__init__.py").touch()
    (package / "lerobot_dataset.py").write_text(module)
    monkeypatch.setenv("PYTHONPATH", str(folder))


def test_a_missing_file_is_named_and_not_the_hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    export(SAMPLE, tmp_path / "d")
    video = next((tmp_path / "d" / "videos").rglob("*.mp4"))
    video.unlink()

    def run(command: list[str], **_: Any) -> subprocess.CompletedProcess[str]:
        return subprocess.CompletedProcess(command, 1, stdout="loaded\n", stderr=_OF_LEROBOT)

    monkeypatch.setattr(lerobot_opens, "lerobot_is_installed", lambda: True)
    monkeypatch.setattr(subprocess, "run", run)
    (found,) = opened(tmp_path / "d")
    assert found.severity == "broken"
    assert str(video.relative_to(tmp_path / "d")) in found.message
    assert "HF_HUB_OFFLINE" not in found.message


@pytest.mark.parametrize(
    "module",
    [
        "raise ImportError('libtorch_cpu.so: failed to map segment from shared object')",
        "class LeRobotDataset:\n    def __init__(self, **_): raise MemoryError('Unable to allocate 3 GiB')",
        "class LeRobotDataset:\n    def __init__(self, **_): import os; os.kill(os.getpid(), 9)",
    ],
)
def test_too_little_memory_implies_nothing_about_the_dataset(
    module: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A stand-in LeRobot fails as under `ulimit -v`, and as when the kernel kills it."""
    export(SAMPLE, tmp_path / "d")
    stand_in(module, tmp_path / "fake", monkeypatch)
    assert exit_code("check", tmp_path / "d", "--lerobot", "--only", "lerobot_opens") == 1
    out, err = capsys.readouterr()
    assert "failed" not in out
    assert "free memory or raise its limit" in err
    assert len(err.splitlines()) == 1


def test_a_dataset_that_lerobot_refuses_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    export(SAMPLE, tmp_path / "d")
    module = "class LeRobotDataset:\n    def __init__(self, **_): raise ValueError('no')"
    stand_in(module, tmp_path / "fake", monkeypatch)
    (found,) = opened(tmp_path / "d")
    assert found.severity == "broken"


@pytest.mark.slow
def test_lerobot_opens_a_dataset_by_request(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = []

    def run(command: list[str], **_: Any) -> subprocess.CompletedProcess[str]:
        asked.append(command[-1])
        return subprocess.CompletedProcess(command, 0, stdout='loaded\n{"episodes": 1, "frames": 30}\n', stderr="")

    monkeypatch.setattr(lerobot_opens, "lerobot_is_installed", lambda: True)
    monkeypatch.setattr(subprocess, "run", run)
    export(SAMPLE, tmp_path / "d")
    assert exit_code("check", tmp_path / "d") == 0
    assert asked == []
    exit_code("check", tmp_path / "d", "--lerobot")
    assert len(asked) == 1
