"""Estimate of a run's cost, from pilot episodes on this machine: `--dry-run`."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path

from demorec.core.config import EpisodePlan, GenerateConfig
from demorec.core.processes import available_cores
from demorec.datasets.lerobot.export import export_lerobot
from demorec.datasets.lerobot.options import ExportOptions
from demorec.generate.executor import MAKE_EPISODE, Made, Raised
from demorec.generate.local import LocalExecutor
from demorec.generate.options import RunOptions
from demorec.runs.run_file import EPISODES, FAILED, UNFINISHED

_MEASURED = 2
"""Number of pilot attempts with images: a worker's first one compiles, loads and fills caches, the second counts."""
_TRIED = 20
"""Number of pilot episodes without images, to estimate the success rate: images do not affect the physics."""


def estimate(config: GenerateConfig, options: RunOptions) -> tuple[list[Made], list[Made], int]:
    """Make pilot episodes in a temporary folder.

    Returns:
        Attempts with images, of which the last is measured and the first has a worker's start-up time; attempts without
        images, for the success rate; and bytes that an episode adds to the dataset (0 without one).

    Raises:
        ConfigError, GenerationError: A pilot episode could not be made.
    """
    workers = options.workers or available_cores()
    with tempfile.TemporaryDirectory(prefix="demorec-pilot-") as temporary:
        folder = _new_run(Path(temporary) / "with_images")
        measured = _make(folder, config, _MEASURED, workers=1)
        recordings = [folder / report.attempt.file for report in measured if report.attempt.file]
        dataset_bytes = _added_to_dataset(recordings, folder) if options.export else 0
        count = min(_TRIED, options.num_episodes)
        folder = _new_run(Path(temporary) / "without_images")
        tried = _make(folder, replace(config, cameras=()), count, workers=min(workers, available_cores()))
    return measured, tried, dataset_bytes


def _new_run(folder: Path) -> Path:
    """Create the folders of a run; returns the run."""
    for name in (EPISODES, FAILED, UNFINISHED):
        (folder / name).mkdir(parents=True)
    return folder


def _make(folder: Path, config: GenerateConfig, count: int, *, workers: int) -> list[Made]:
    """Make the first episodes, in order of their ends."""
    made: list[Made] = []
    plans = (EpisodePlan(config=config, episode_index=index) for index in range(count))
    with LocalExecutor(MAKE_EPISODE, folder, workers=workers, recycle_after=count) as executor:
        for report in chain.from_iterable(executor.carry_out(partial(next, plans, None))):
            if isinstance(report, Raised):
                raise report.error(f"The pilot episode cannot be made: {report.message}")
            made.append(report)
    return made


def _added_to_dataset(recordings: Sequence[Path], folder: Path) -> int:
    """Compute the bytes that the last recording adds to a dataset, excluding the fixed size of any dataset."""
    sizes = [0, 0]
    for count in range(max(1, len(recordings) - 1), len(recordings) + 1):
        dataset = folder / f"dataset_of_{count}"
        options = ExportOptions(repo_id="local/pilot", verify=False, include_failures=True)
        export_lerobot(recordings[:count], dataset, options)
        sizes.append(sum(path.stat().st_size for path in dataset.rglob("*") if path.is_file()))
    return max(0, sizes[-1] - sizes[-2])
