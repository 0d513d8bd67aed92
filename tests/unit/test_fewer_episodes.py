"""A run of which fewer episodes are wanted than there are: what its dataset holds."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
from support.export import export, info, make_run

from demorec.check.report import CheckOptions, check_subjects, find_subjects
from demorec.core.config import GenerateConfig
from demorec.datasets.lerobot import ExportOptions
from demorec.generate import export_step
from demorec.runs.run_file import Generation, RunFile, inspect_recording, save_run_file


def test_the_dataset_has_what_was_asked_for_last(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(export_step, "ExportOptions", partial(ExportOptions, verify=False))
    folder = make_run(tmp_path / "run", [9, 11, 10, 12], failures=[1, 3], cameras=())
    lines = []
    for path in folder.rglob("*.mcap"):
        line = replace(inspect_recording(path)[0], file=path.relative_to(folder).as_posix())
        # A success after a failed attempt is the second one; the made-up recordings call all of them the first.
        lines.append(replace(line, attempt=1) if line.success and line.episode_index in (1, 3) else line)
    run = RunFile(generation=Generation(config=GenerateConfig(), versions={}, num_episodes=2)).with_attempts(lines)
    assert len(run.beyond) == 3  # episode 2, and both attempts at episode 3
    save_run_file(run, folder)
    recordings = {path: path.read_bytes() for path in folder.rglob("*.mcap")}
    record, report = export_step.export_run(folder, repo_id="me/cubes")
    assert report is not None
    alone = make_run(tmp_path / "alone", [9, 11], failures=[1], cameras=())
    assert record.dataset_digest == export(alone, tmp_path / "dataset").digest
    assert (report.num_episodes, report.skipped_failures) == (2, 1)
    assert info(folder / "dataset")["total_episodes"] == 2
    assert {path: path.read_bytes() for path in folder.rglob("*.mcap")} == recordings
    assert levels(folder, "run_dataset", "run_files") == {"run_dataset": "pass", "run_files": "pass"}
    save_run_file(run.with_generation(num_episodes=4).with_attempts(lines), folder)
    assert levels(folder, "run_dataset")["run_dataset"] == "fail", "the dataset is of two"


def levels(folder: Path, *checks: str) -> dict[str, str]:
    """check -> level, for the run."""
    subject = find_subjects([folder])[0]
    (report,) = check_subjects([subject], CheckOptions(only=checks))
    return {result.check: result.level for result in report.results}
