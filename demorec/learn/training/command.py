"""lerobot-train, with the one difference that its datasets are read by `FastDataset`."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from demorec.core.errors import ConfigError, DemorecError, MissingDependencyError, resource_error

if TYPE_CHECKING:
    from demorec.learn.training.reader import FastDataset

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
        ConfigError: The limit is negative, the file of --config_path is missing, or the encoder is not pretrained.
        TrainingError: lerobot-train ended with an error.
        MissingDependencyError: LeRobot, or what it needs for training, is not installed.
        SystemExit: lerobot-train refused its arguments (2), and said why, or printed its help (0).
    """
    if frame_cache_bytes < 0:
        raise ConfigError(f"frame-cache-mb is {frame_cache_bytes / (1 << 20):g}, at least 0 is needed.")
    check_settings_file(arguments)
    try:
        import accelerate  # noqa: F401  # which lerobot-train asks for late
        from lerobot.scripts import lerobot_train

        import demorec.lerobot_policy  # noqa: F401  # which registers its policy's type
    except ImportError as error:
        raise MissingDependencyError("Training", error.name or "lerobot", "pip install 'demorec[train]'") from error
    with (
        _reading_fast(frame_cache_bytes, on_replaced, expert_only=expert_only) as opened,
        _encoding_once(opened),
        _called_with(arguments),
    ):
        try:
            lerobot_train.main()
        except Exception as error:  # whatever a foreign program raises
            if isinstance(error, DemorecError) or resource_error(error) is not None:
                raise
            asked = [word for word in arguments if word.startswith("--policy.path=") and not _is_here(word)]
            if asked and type(error).__module__.startswith("huggingface_hub"):
                advice = f"{asked[0]} names no folder here, so the Hub was asked for it."
            else:
                advice = f"run {PROGRAM} with the same flags to see where."
            raise TrainingError(f"{PROGRAM} stopped ({type(error).__name__}: {error}); {advice}") from error


def _is_here(argument: str) -> bool:
    return Path(argument.partition("=")[2]).expanduser().exists()


def check_settings_file(arguments: Sequence[str]) -> None:
    """Raise ConfigError if the file of --config_path is missing."""
    for argument in arguments:
        flag, _, path = argument.partition("=")
        if flag == "--config_path" and path.endswith(".json") and not Path(path).exists():
            raise ConfigError(f"There is no such file of settings: {path}")


def training_config(arguments: Sequence[str]) -> Any:
    """lerobot-train's settings (TrainPipelineConfig), as its parser reads them from its arguments.

    Raises:
        ConfigError: The file of --config_path is missing.
        MissingDependencyError: LeRobot, or what it needs for training, is not installed.
        SystemExit: The parser refused the arguments (2), and said why.
    """
    check_settings_file(arguments)
    try:
        import draccus
        from lerobot.configs.train import TrainPipelineConfig
        from lerobot.policies import factory  # noqa: F401  # which registers the policies' types

        import demorec.lerobot_policy  # noqa: F401  # so does this
    except ImportError as error:
        raise MissingDependencyError("Training", error.name or "lerobot", "pip install 'demorec[train]'") from error
    with _called_with(arguments):
        try:
            return draccus.parse(TrainPipelineConfig, args=list(arguments))
        except Exception as error:  # whatever a foreign parser raises
            raise ConfigError(f"{PROGRAM} does not take these settings ({type(error).__name__}: {error}).") from error


@contextmanager
def _reading_fast(
    frame_cache_bytes: int, on_replaced: Callable[[], None], *, expert_only: bool
) -> Iterator[list[FastDataset]]:
    """LeRobot's factory of datasets makes `FastDataset`s meanwhile, which come into the list."""
    from lerobot.datasets import factory

    from demorec.learn.training.reader import FastDataset

    opened: list[FastDataset] = []

    def open_dataset(*args: Any, **kwargs: Any) -> FastDataset:
        if not opened:
            on_replaced()
        opened.append(FastDataset(*args, frame_cache_bytes=frame_cache_bytes, expert_only=expert_only, **kwargs))
        return opened[-1]

    with _replaced(factory, "LeRobotDataset", open_dataset):
        yield opened


def _encoding_once(opened: Sequence[FastDataset]) -> AbstractContextManager[None]:
    """Policies of ours that lerobot-train makes meanwhile encode each frame of the dataset once."""
    from lerobot.scripts import lerobot_train

    from demorec.learn.training.encodings import Encodings

    make_policy = lerobot_train.make_policy

    def made(*args: Any, **kwargs: Any) -> Any:
        policy = make_policy(*args, **kwargs)
        if policy.config.type != "act_keypoints":
            return policy
        if not policy.config.pretrained_path:
            raise ConfigError(
                "The encoder of a policy of type act_keypoints is trained before the policy: demorec pretrain, then "
                "--policy.path with its --out."
            )
        for dataset in opened:
            if dataset.image_transforms is None:  # else an image is another one each time
                encodings = Encodings(dataset.meta.total_frames)
                encodings.serve(policy)
                dataset.leave_out_images(encodings.known)
        return policy

    return _replaced(lerobot_train, "make_policy", made)


@contextmanager
def _called_with(arguments: Sequence[str]) -> Iterator[None]:
    """The command line that LeRobot's parser looks at, here and there, by itself; it exits with 0 or 2."""
    try:
        with _replaced(sys, "argv", [PROGRAM, *arguments]):
            yield
    except SystemExit as ended:  # its parser exits with 1 for some wrong requests and with 2 for others
        raise SystemExit(2 if ended.code else 0) from None


@contextmanager
def _replaced(owner: Any, name: str, value: Any) -> Iterator[None]:
    """Another value of an attribute meanwhile."""
    before = getattr(owner, name)
    setattr(owner, name, value)
    try:
        yield
    finally:
        setattr(owner, name, before)
