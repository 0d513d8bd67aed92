"""Runs of stand-in recordings (`support.makers`) with the real code around them.

As a program (`python -m support.generate OUT MAKER NUM_EPISODES WORKERS GRACE_S`) it is a driver that tests can kill.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from demorec.core.config import GenerateConfig
from demorec.core.errors import DemorecError
from demorec.core.files import read_text_limited
from demorec.generate import run as running
from demorec.generate.options import RunObserver, RunOptions, RunResult
from demorec.generate.run import generate
from demorec.runs.run_file import Attempt
from support.makers import line_of, succeeds


def inspect(path: Path) -> tuple[Attempt, dict[str, Any], dict[str, str]]:
    try:
        content = json.loads(read_text_limited(path, 100_000))
        return line_of(path, content, path.name), content["config"], content["versions"]
    except (ValueError, KeyError) as error:
        raise DemorecError("it is not a recording") from error


class Remembers(RunObserver):
    """Observer that keeps its messages."""

    def __init__(self) -> None:
        self.said: list[str] = []

    def says(self, message: str) -> None:
        self.said.append(message)


class Tells(RunObserver):
    """Observer that prints its messages."""

    def says(self, message: str) -> None:
        print(message, flush=True)


def run_fake(
    out: Path,
    *,
    maker: str = "make",
    num_episodes: int = 8,
    workers: int = 1,
    seed: int = 0,
    recycle_after: int = 500,
    overwrite: bool = False,
    export: bool = True,
    progress: RunObserver | None = None,
    episodes: list[int] | None = None,
) -> RunResult:
    return generate(
        GenerateConfig(seed=seed, cameras=()),
        RunOptions(
            out=out,
            num_episodes=num_episodes,
            workers=workers,
            recycle_after=recycle_after,
            overwrite=overwrite,
            export=export,
        ),
        progress=progress,
        maker=f"support.makers:{maker}",
        inspect=inspect,
        episodes=episodes,
    )


def attempts_of(result: RunResult) -> dict[tuple[int, int], bool]:
    """(episode, attempt) -> whether it succeeded."""
    return {(a.episode_index, a.attempt): bool(a.success) for a in result.run.attempts}


def num_finished(out: Path) -> int:
    return len(list((out / "episodes").glob("*.mcap")))


def expected_attempts(num_episodes: int, *, seed: int = 0) -> dict[tuple[int, int], bool]:
    """Attempts that a run must make, by definition: an episode is attempted until an attempt succeeds."""
    expected = {}
    for episode in range(num_episodes):
        for attempt in range(3):
            expected[episode, attempt] = succeeds(seed, episode, attempt)
            if expected[episode, attempt]:
                break
    return expected


if __name__ == "__main__":
    out, of_maker, number, processes, grace_s = sys.argv[1:]
    running.GRACE_S = float(grace_s)
    result = run_fake(Path(out), maker=of_maker, num_episodes=int(number), workers=int(processes), progress=Tells())
    print(result.run.digest)
    sys.exit(130 if result.interrupted else 0)
