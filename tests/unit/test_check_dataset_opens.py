"""What LeRobot says of a dataset that it cannot open, in words that help."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any

import pytest
from support.export import export

from demorec.check import dataset_files
from demorec.check.base import Measurement
from demorec.check.dataset import Dataset

SAMPLE = Path(__file__).parents[2] / "recordings" / "sample" / "format_1.mcap"
_OF_LEROBOT = "OfflineModeIsEnabled: Cannot reach the Hub: please unset the `HF_HUB_OFFLINE` environment variable."
"""What LeRobot 0.6.1 ends with where a file of the dataset is missing: it asks the Hub for it."""


def test_a_missing_file_is_named_and_not_the_hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    export(SAMPLE, tmp_path / "d")
    video = next((tmp_path / "d" / "videos").rglob("*.mp4"))
    video.unlink()

    def run(command: list[str], **_: Any) -> subprocess.CompletedProcess[str]:
        return subprocess.CompletedProcess(command, 1, stdout="", stderr=_OF_LEROBOT)

    monkeypatch.setattr(dataset_files, "lerobot_is_installed", lambda: True)
    monkeypatch.setattr(subprocess, "run", run)
    found = dataset_files.dataset_opens.measure(Dataset(tmp_path / "d"))
    assert isinstance(found, Measurement)
    assert found.value == 1
    assert str(video.relative_to(tmp_path / "d")) in found.detail
    assert "HF_HUB_OFFLINE" not in found.detail
