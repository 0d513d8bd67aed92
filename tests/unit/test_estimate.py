"""The size estimated by a dry run, compared with that of a whole run and its dataset."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.export import export, make_run

from demorec.core.config import EpisodePlan, GenerateConfig
from demorec.generate import estimate as estimating
from demorec.generate.executor import Made
from demorec.generate.options import RunOptions
from demorec.runs.run_file import Attempt

LENGTHS = [40] * 8


def bytes_in(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def made(file: Path, folder: Path) -> Made:
    attempt = Attempt(
        episode_index=0, attempt=0, seed=0, success=True, file=file.relative_to(folder).as_posix(), sha256="",
        digest="", num_frames=40, num_bytes=file.stat().st_size,
    )  # fmt: skip
    return Made(plan=EpisodePlan(config=GenerateConfig(), episode_index=0), attempt=attempt, peak_bytes=0)


@pytest.mark.slow
@pytest.mark.parametrize("cameras", [(), ("front",)])
@pytest.mark.parametrize("exports", [True, False])
def test_the_size_is_about_that_of_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cameras: tuple[str, ...], exports: bool
) -> None:
    run = make_run(tmp_path / "run", LENGTHS, cameras=cameras)
    files = sorted((run / "episodes").glob("*.mcap"))
    blind = make_run(tmp_path / "blind", LENGTHS, cameras=())

    def make(folder: Path, config: GenerateConfig, count: int, *, workers: int) -> list[Made]:
        source = run if config.cameras == cameras else blind
        for file in files[:count]:
            (folder / "episodes" / file.name).write_bytes((source / "episodes" / file.name).read_bytes())
        return [made(folder / "episodes" / file.name, folder) for file in files[:count]]

    monkeypatch.setattr(estimating, "_make", make)
    options = RunOptions(out=tmp_path / "new", num_episodes=len(LENGTHS), export=exports)
    measured, _, dataset_bytes = estimating.estimate(GenerateConfig(cameras=cameras), options)
    size = bytes_in(run / "episodes")
    if exports:
        export(run, tmp_path / "dataset")
        export(files[0], tmp_path / "first")  # including the fixed size of every dataset
        growth = bytes_in(tmp_path / "dataset") - bytes_in(tmp_path / "first")
        size += growth * len(files) // (len(files) - 1)
    told = len(LENGTHS) * (measured[-1].attempt.num_bytes + dataset_bytes)
    assert told == pytest.approx(size, rel=0.15)
    assert bool(dataset_bytes) == exports


def test_pilots_with_and_without_images_stay_apart(tmp_path: Path) -> None:
    config = GenerateConfig(cameras=("front",), width=32, height=32)
    options = RunOptions(out=tmp_path / "new", num_episodes=2, export=False, workers=1)
    measured, tried, _ = estimating.estimate(config, options)
    assert measured[-1].attempt.num_bytes > max(pilot.attempt.num_bytes for pilot in tried)
