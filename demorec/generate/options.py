"""How a run is carried out (where, how many, by whom), who watches it, and what it comes to.

None of it decides what an episode contains.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from demorec.core.errors import ConfigError, check_option
from demorec.core.targets import OptionalTarget
from demorec.datasets.lerobot.options import check_repo_id
from demorec.runs.run_file import MAX_EPISODES, Attempt, RunFile


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """Everything about a run that leaves the data alone."""

    out: OptionalTarget = None
    """Folder of the run (auto: recordings/TASK). Run the same command again to continue where it stopped."""
    num_episodes: int = 50
    """How many successful episodes to make; a larger number extends the run, a smaller one leaves the rest out."""
    workers: int | None = None
    """Processes that simulate (auto: one per core; with Ray, as many as the cluster has room for)."""
    executor: Literal["local", "ray"] = "local"
    """Processes on this machine, or tasks on a Ray cluster."""
    address: str = "local"
    """Ray: the cluster, for example auto (the one that this machine belongs to) or HOST:6379; local: this machine
    only."""
    cpus_per_worker: float = 1.0
    """Ray: CPUs that each worker reserves."""
    gpus_per_worker: float = 0.0
    """Ray: GPUs that each worker reserves (for --renderer egl)."""
    recycle_after: int = 500
    """Replace a worker process by a fresh one after this many episodes."""
    export: bool = True
    """Export the successful episodes to a LeRobot dataset in OUT/dataset."""
    repo_id: str | None = None
    """Name of the dataset, OWNER/NAME (auto: local/TASK)."""
    overwrite: bool = False
    """Delete the run in the output folder and start again."""

    def validate(self) -> None:
        """Raise ConfigError for impossible values."""
        check_option("num_episodes", self.num_episodes, 1, MAX_EPISODES)
        check_option("workers", self.workers, 1, 100_000)
        check_option("recycle_after", self.recycle_after, 1, 1_000_000)
        check_option("cpus_per_worker", self.cpus_per_worker, 0.01, 1024)
        check_option("gpus_per_worker", self.gpus_per_worker, 0, 64)
        for name in ("address", "cpus_per_worker", "gpus_per_worker"):
            if self.executor == "local" and getattr(self, name) != getattr(RunOptions, name):
                flag = f"--{name.replace('_', '-')}"
                raise ConfigError(f"{flag} is for Ray: add --executor ray, or leave it out.")
        if self.repo_id is not None:
            check_repo_id(self.repo_id)
            if not self.export:
                raise ConfigError("--repo-id names the exported dataset, but --no-export leaves it out: drop one.")


class RunObserver:
    """Told how a run goes; does nothing itself."""

    def verifying(self, done: int, total: int) -> None:
        """Recordings of an earlier session are being verified."""

    def started(self, run: RunFile, workers: int) -> None:
        """The work begins; `run` knows what is there already."""

    def ended(self, attempt: Attempt) -> None:
        """An attempt has come to its end."""

    def says(self, message: str) -> None:
        """Something that a person should know."""


@dataclass(frozen=True, kw_only=True)
class RunResult:
    """What a session has come to.

    Attributes:
        folder: Of the run.
        run: All that is known now; where something was made, its last session is this one.
        made: The attempts of it.
        interrupted: Whether Ctrl-C or SIGTERM ended it.
    """

    folder: Path
    run: RunFile
    made: tuple[Attempt, ...]
    interrupted: bool
