"""A complete run with the real simulator: its digest depends on neither workers nor order, and it can be reproduced."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.commands import exit_code

from demorec.cli import generate_dataset_main
from demorec.core.config import GenerateConfig
from demorec.datasets.lerobot.export import export_lerobot
from demorec.datasets.lerobot.options import ExportOptions
from demorec.datasets.lerobot.verify import Verifier
from demorec.extensions.datasets.folder import LeRobotFolder
from demorec.generate.export_step import export_run
from demorec.generate.options import RunObserver, RunOptions, RunResult
from demorec.generate.run import generate
from demorec.mcap import Recording
from demorec.runs.run_file import load_run_file

CONFIG = GenerateConfig(seed=11, width=48, height=32)
NUM_EPISODES = 3


def make(out: Path, *, workers: int, episodes: list[int] | None = None, num_episodes: int = NUM_EPISODES) -> RunResult:
    options = RunOptions(out=out, num_episodes=num_episodes, workers=workers)
    return generate(CONFIG, options, progress=RunObserver(), episodes=episodes)


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> RunResult:
    """A run by one worker, in order."""
    return make(tmp_path_factory.mktemp("reference") / "run", workers=1)


@pytest.mark.slow
def test_two_workers_in_reversed_order_make_the_same_bytes(tmp_path: Path, reference: RunResult) -> None:
    result = make(tmp_path / "run", workers=2, episodes=list(reversed(range(NUM_EPISODES))))
    assert result.run.digest == reference.run.digest
    assert [a.sha256 for a in result.run.attempts] == [a.sha256 for a in reference.run.attempts]
    for attempt in result.run.attempts:
        assert (result.folder / attempt.file).read_bytes() == (reference.folder / attempt.file).read_bytes()


def test_recordings_contain_the_data_of_their_run(tmp_path: Path, reference: RunResult) -> None:
    """Everything in run.json that matters can be restored from the recordings."""
    out = tmp_path / "run"
    shutil.copytree(reference.folder, out)
    (out / "run.json").unlink()
    result = make(out, workers=1)
    assert result.made == ()
    assert result.run.digest == reference.run.digest
    assert [a.sha256 for a in result.run.attempts] == [a.sha256 for a in reference.run.attempts]


@pytest.mark.slow
@pytest.mark.usefixtures("without_lerobot")
def test_runs_are_regenerated_and_differences_found(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], reference: RunResult
) -> None:
    source = tmp_path / "source"
    shutil.copytree(reference.folder, source)
    assert reproduce(source, tmp_path / "copy") == 0
    assert capsys.readouterr().out.endswith(f"The same as {source}: {NUM_EPISODES} episodes, bit for bit.\n")
    text = (source / "run.json").read_text()
    first = reference.run.attempts[0].digest
    (source / "run.json").write_text(text.replace(first, "0" * len(first)))
    assert reproduce(source, tmp_path / "copy") == 1
    assert f"Not the same as {source}: 1 of {NUM_EPISODES} episodes differ: 0 (attempt 0)." in capsys.readouterr().out


@pytest.mark.usefixtures("without_lerobot")
def test_a_dataset_of_few_features_can_be_shown(tmp_path: Path, reference: RunResult) -> None:
    from demorec.extensions.datasets.playback import open_dataset_episode

    few = ExportOptions(features=("observation.images.wrist",), action="ee_delta", verify=False)
    export_lerobot([reference.folder], tmp_path / "few", few)
    with open_dataset_episode(LeRobotFolder(tmp_path / "few"), 1) as shown:
        assert shown.motion.base_from_tcp is None
        assert not {"velocity", "ee", "target"} & shown.curves.keys()
        assert tuple(shown.videos) == ("wrist",)
    export_lerobot([reference.folder], tmp_path / "all", ExportOptions(verify=False))
    with (
        Recording(reference.folder / "episodes" / "episode_000001.mcap") as recording,
        open_dataset_episode(LeRobotFolder(tmp_path / "all"), 1) as shown,
    ):
        recorded = recording.trajectory().world_from_camera["wrist"]
        # the simulator's pose against that of the TCP, which the dataset stores as float32
        assert np.allclose(shown.motion.world_from_camera["wrist"][:, :3], recorded[:, :3], atol=1e-5)


def reproduce(source: Path, out: Path) -> int:
    return exit_code("generate", "--config", source, "--out", out, "--workers", "1", "--no-check")


@pytest.mark.usefixtures("without_lerobot")
def test_the_export_is_made_once_and_again_when_the_run_has_grown(tmp_path: Path) -> None:
    out = tmp_path / "run"
    make(out, workers=1, num_episodes=NUM_EPISODES - 1)
    first, report = export_run(out, repo_id="me/cubes")
    assert report is not None
    assert report.num_episodes == NUM_EPISODES - 1
    again, report = export_run(out, repo_id="me/cubes")
    assert (again, report) == (first, None)
    make(out, workers=1, num_episodes=NUM_EPISODES)
    grown, report = export_run(out, repo_id="me/cubes")
    assert report is not None
    assert report.num_episodes == NUM_EPISODES
    assert grown.dataset_digest != first.dataset_digest


def test_the_command_generates_checks_and_exports(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    verified: list[int] = []

    def remember(verifier: Verifier, *arguments: Any) -> int:
        verified.append(verify(verifier, *arguments))
        return verified[-1]

    verify = Verifier.verify
    monkeypatch.setattr(Verifier, "verify", remember)
    out = tmp_path / "run"
    args = ["--out", str(out), "--num-episodes", "1", "--workers", "1", "--seed", "11", "--cameras", "wrist"]
    args += ["--width", "48", "--height", "32"]
    for made in (1, 0):
        assert exit_code(*args, program=generate_dataset_main) == 0
        told = capsys.readouterr().out
        assert f"1 of 1 asked, {made} attempt{'s' if made != 1 else ''} made now" in told
        assert load_run_file(out).digest in told
        for word in ("success", "frames", "recordings", "dataset", "checks"):
            assert word in told
    assert verified == [2], "once, two frames of the episode"
    assert exit_code(*args, "--fps", "60", program=generate_dataset_main) == 2
    assert "fps is 30 there and 60 here" in capsys.readouterr().err
