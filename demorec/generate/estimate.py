"""What a run would take, from pilot episodes on this machine: `--dry-run`."""

from __future__ import annotations

import math
import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from pathlib import Path

from demorec.core.config import EpisodePlan, GenerateConfig
from demorec.core.processes import available_cores
from demorec.datasets.lerobot import ExportOptions, export_lerobot
from demorec.generate.executor import MAKE_EPISODE, Made, Raised
from demorec.generate.local import LocalExecutor
from demorec.generate.options import RunOptions
from demorec.runs.run_file import EPISODES, FAILED, STARTING, UNFINISHED

_MEASURED = 2
"""Attempts with images: the first of a worker compiles, loads and fills caches, the second is what counts."""
_TRIED = 20
"""Episodes made without images, to see how often they succeed: images do not touch the physics."""


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """What is expected of a run.

    Attributes:
        attempts: Episodes that were tried.
        successes: How many of them succeeded.
        num_frames: Of the measured attempt.
        cpu_seconds: stage -> CPU seconds of the measured attempt.
        start_seconds: CPU seconds that a worker needs before its first frame.
        num_bytes: Of the measured attempt's recording.
        dataset_bytes: That it adds to the dataset; 0 without one.
        peak_worker_bytes: Memory of a worker.
        num_episodes, workers: Of the run.
        free_bytes: On the disk of the output folder.
    """

    attempts: int
    successes: int
    num_frames: int
    cpu_seconds: dict[str, float]
    start_seconds: float
    num_bytes: int
    dataset_bytes: int
    peak_worker_bytes: int
    num_episodes: int
    workers: int
    free_bytes: int

    @property
    def seconds(self) -> float:
        """Wall-clock seconds of the run with a core for each worker, without the export."""
        attempts = self.num_episodes * self.attempts / max(self.successes, 1)
        return self.start_seconds + sum(self.cpu_seconds.values()) * math.ceil(attempts / self.workers)

    @property
    def total_bytes(self) -> float:
        """Recordings and dataset."""
        return (self.num_bytes + self.dataset_bytes) * self.num_episodes


def estimate(config: GenerateConfig, options: RunOptions, *, maker: str = MAKE_EPISODE) -> Estimate:
    """Make pilot episodes in a temporary folder and count up.

    Raises:
        ConfigError, GenerationError: A pilot could not be made.
    """
    assert options.out is not None
    workers = options.workers or available_cores()
    with tempfile.TemporaryDirectory(prefix="demorec-pilot-") as temporary:
        folder = Path(temporary)
        for name in (EPISODES, FAILED, UNFINISHED):
            (folder / name).mkdir()
        measured = _make(maker, folder, config, _MEASURED, workers=1)
        recordings = [folder / report.attempt.file for report in measured if report.attempt.file]
        dataset_bytes = _added_to_dataset(recordings, folder) if options.export else 0
        # Last, since these have the names of the measured ones, and no images.
        count = min(_TRIED, options.num_episodes)
        tried = _make(maker, folder, replace(config, cameras=()), count, workers=min(workers, available_cores()))
    last, out = measured[-1].attempt, options.out.absolute()
    return Estimate(
        attempts=len(tried),
        successes=sum(report.attempt.success for report in tried),
        num_frames=last.num_frames,
        cpu_seconds=dict(last.seconds),
        start_seconds=measured[0].attempt.seconds.get(STARTING, 0.0),
        num_bytes=last.num_bytes,
        dataset_bytes=dataset_bytes,
        peak_worker_bytes=max(report.peak_bytes for report in measured),
        num_episodes=options.num_episodes,
        workers=workers,
        free_bytes=shutil.disk_usage(next(place for place in (out, *out.parents) if place.exists())).free,
    )


def _make(maker: str, folder: Path, config: GenerateConfig, count: int, *, workers: int) -> list[Made]:
    """The first episodes, in order of their ends."""
    made: list[Made] = []
    plans = (EpisodePlan(config=config, episode_index=index) for index in range(count))
    with LocalExecutor(maker, folder, workers=workers, recycle_after=count) as executor:
        for report in chain.from_iterable(executor.carry_out(partial(next, plans, None))):
            if isinstance(report, Raised):
                raise report.error(f"The pilot episode cannot be made: {report.message}")
            made.append(report)
    return made


def _added_to_dataset(recordings: Sequence[Path], folder: Path) -> int:
    """Bytes by which the last of some recordings makes their dataset larger: what every dataset has counts once."""
    sizes = [0, 0]
    for count in range(max(1, len(recordings) - 1), len(recordings) + 1):
        dataset = folder / f"dataset_of_{count}"
        options = ExportOptions(repo_id="local/pilot", verify=False, include_failures=True)
        export_lerobot(recordings[:count], dataset, options)
        sizes.append(sum(path.stat().st_size for path in dataset.rglob("*") if path.is_file()))
    return max(0, sizes[-1] - sizes[-2])
