"""lerobot-train, with the one difference that its datasets are read by `FastDataset`."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from demorec.errors import ConfigError, DemorecError, MissingDependencyError, resource_error

PROGRAM = "lerobot-train"


class TrainingError(DemorecError):
    """lerobot-train did not come to its end."""


def train(
    arguments: Sequence[str],
    *,
    frame_cache_bytes: int,
    on_replaced: Callable[[], None],
    expert_only: bool = False,
) -> None:
    """Run lerobot-train in this process.

    Args:
        arguments: As for lerobot-train.
        frame_cache_bytes: Limit of the decoded frames that each process keeps.
        expert_only: As of `FastDataset`.
        on_replaced: Called when the first dataset is opened by `FastDataset`: streamed ones are not.

    Raises:
        ConfigError: The limit is negative, or the file of --config_path is missing.
        TrainingError: lerobot-train ended with an error.
        MissingDependencyError: LeRobot, or what it needs for training, is not installed.
        SystemExit: lerobot-train refused its arguments (2), and said why, or told its help (0).
    """
    if frame_cache_bytes < 0:
        raise ConfigError(f"frame-cache-mb is {frame_cache_bytes / (1 << 20):g}, at least 0 is needed.")
    for argument in arguments:
        flag, _, path = argument.partition("=")
        if flag == "--config_path" and path.endswith(".json") and not Path(path).exists():
            raise ConfigError(f"There is no such file of settings: {path}")
    try:
        import accelerate  # noqa: F401  # which lerobot-train asks for late
        from lerobot.scripts import lerobot_train
    except ImportError as error:
        raise MissingDependencyError("Training", error.name or "lerobot", "pip install 'demorec[train]'") from error
    with _reading_fast(frame_cache_bytes, on_replaced, expert_only=expert_only), _called_as(PROGRAM, arguments):
        try:
            lerobot_train.main()
        except SystemExit as ended:  # its parser exits with 1 for some wrong requests and with 2 for others
            raise SystemExit(2 if ended.code else 0) from None
        except Exception as error:  # whatever a foreign program raises
            if isinstance(error, DemorecError) or resource_error(error) is not None:
                raise
            raise TrainingError(
                f"{PROGRAM} stopped ({type(error).__name__}: {error}); run {PROGRAM} with the same flags to see where."
            ) from error


@contextmanager
def _reading_fast(frame_cache_bytes: int, on_replaced: Callable[[], None], *, expert_only: bool) -> Iterator[None]:
    """LeRobot's factory of datasets makes `FastDataset`s meanwhile."""
    from lerobot.datasets import factory

    from demorec.training.dataset import FastDataset

    original = factory.LeRobotDataset
    is_told = False

    def open_dataset(*args: Any, **kwargs: Any) -> FastDataset:
        nonlocal is_told
        if not is_told:
            on_replaced()
            is_told = True
        return FastDataset(*args, frame_cache_bytes=frame_cache_bytes, expert_only=expert_only, **kwargs)

    factory.LeRobotDataset = open_dataset
    try:
        yield
    finally:
        factory.LeRobotDataset = original


@contextmanager
def _called_as(program: str, arguments: Sequence[str]) -> Iterator[None]:
    """The command line that LeRobot's parser looks at, here and there, by itself."""
    before = sys.argv
    sys.argv = [program, *arguments]
    try:
        yield
    finally:
        sys.argv = before
