"""Options of a run's execution (place, number, executor), its observer and its result.

None of them affects the content of an episode.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from demorec.core.errors import ConfigError, check_option
from demorec.core.options import Rare
from demorec.core.replacing import OptionalTarget
from demorec.core.tables import EXECUTORS
from demorec.datasets.lerobot.options import check_repo_id
from demorec.runs.run_file import MAX_EPISODES, Attempt, GeneratedRun

if TYPE_CHECKING:
    ExecutorName = str
else:
    ExecutorName = Literal["local", *EXECUTORS.names()]


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """Options of a run that do not affect the data."""

    out: OptionalTarget = None
    """Folder of the run (auto: recordings/TASK). Run the same command again to continue where it stopped."""
    num_episodes: int = 50
    """Number of successful episodes to make; a larger one extends the run."""
    workers: int | None = None
    """Number of simulating processes (auto: one per core; on a cluster, as many as it has room for)."""
    executor: ExecutorName = "local"
    """Processes on this machine, or tasks on a cluster."""
    address: Rare[str] = "local"
    """Address of the cluster, such as auto (that of this machine) or HOST:6379; local: only this machine."""
    gpus_per_worker: Rare[float] = 0.0
    """GPUs that each worker on a cluster reserves (for --renderer egl)."""
    recycle_after: Rare[int] = 500
    """Replace a worker process after this many episodes."""
    export: Rare[bool] = True
    """Export the successful episodes to a LeRobot dataset in OUT/dataset."""
    repo_id: Rare[str | None] = None
    """Name of the dataset, OWNER/NAME (auto: local/TASK)."""
    overwrite: bool = False
    """Delete the run in the output folder and start again."""

    def validate(self) -> None:
        """Raise ConfigError for invalid values."""
        check_option("num_episodes", self.num_episodes, 1, MAX_EPISODES)
        check_option("workers", self.workers, 1, 100_000)
        check_option("recycle_after", self.recycle_after, 1, 1_000_000)
        check_option("gpus_per_worker", self.gpus_per_worker, 0, 64)
        for name in ("address", "gpus_per_worker"):
            if self.executor == "local" and getattr(self, name) != getattr(RunOptions, name):
                names = EXECUTORS.names()
                whose = " or ".join(map(str.capitalize, names)) or "a cluster"
                remedy = f"add --executor {' or '.join(names)}, or leave" if names else "leave"
                raise ConfigError(f"--{name.replace('_', '-')} is for {whose}: {remedy} it out.")
        if self.repo_id is not None:
            check_repo_id(self.repo_id)
            if not self.export:
                raise ConfigError("--repo-id names the exported dataset, but --no-export omits it: remove one of them.")


class RunObserver:
    """Receives the progress of a run; this base class ignores it."""

    def verifying(self, done: int, total: int) -> None:
        """Handle the verification of recordings from an earlier session."""

    def started(self, run: GeneratedRun) -> None:
        """Handle the start of the work; `run` contains everything already made."""

    def ended(self, attempt: Attempt) -> None:
        """Handle the end of an attempt."""

    def says(self, message: str) -> None:
        """Handle a message for the user."""


@dataclass(frozen=True, kw_only=True)
class RunResult:
    """Result of a session.

    Attributes:
        folder: Folder of the run.
        run: Known state of the run.
        made: Attempts made in this session.
        seconds: Its duration.
        interrupted: Whether Ctrl-C or SIGTERM ended it.
    """

    folder: Path
    run: GeneratedRun
    made: tuple[Attempt, ...]
    seconds: float
    interrupted: bool
