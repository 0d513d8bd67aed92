"""lerobot-train with datasets read by `FastDataset`."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import draccus
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets import factory
from lerobot.scripts import lerobot_train
from lerobot.utils.import_utils import register_third_party_plugins

from lerobot_policy_act_keypoints.encodings import Encodings
from lerobot_policy_act_keypoints.errors import RequestError, TrainingError
from lerobot_policy_act_keypoints.reader import FastDataset

PROGRAM = "lerobot-train"


def train(
    arguments: Sequence[str],
    *,
    frame_cache_bytes: int,
    on_replaced: Callable[[], None],
    expert_only: bool = False,
) -> None:
    """Run lerobot-train in this process.

    Args:
        arguments: Flags of lerobot-train.
        frame_cache_bytes: Maximum size of the decoded frames that each process keeps.
        on_replaced: Called when the first dataset is opened by `FastDataset`; streamed datasets are not.
        expert_only: See `FastDataset`.

    Raises:
        RequestError: The file of --config_path is missing, or the encoder is not pretrained.
        TrainingError: lerobot-train ended with an error.
        SystemExit: lerobot-train refused its arguments (2) and printed why, or printed its help (0).
    """
    check_settings_file(arguments)
    with (
        _reading_fast(frame_cache_bytes, on_replaced, expert_only=expert_only) as opened,
        _encoding_once(opened),
        _called_with(arguments),
    ):
        try:
            lerobot_train.main()
        except TrainingError:
            raise
        except Exception as error:  # any error of another program
            missing = [word for word in arguments if word.startswith("--policy.path=") and not _exists(word)]
            if missing and type(error).__module__.startswith("huggingface_hub"):
                advice = f"{missing[0]} is not a folder here, so the Hub was asked for it."
            else:
                advice = f"run {PROGRAM} with the same flags to see where."
            raise TrainingError(f"{PROGRAM} stopped ({type(error).__name__}: {error}); {advice}") from error


def _exists(argument: str) -> bool:
    return Path(argument.partition("=")[2]).expanduser().exists()


def check_settings_file(arguments: Sequence[str]) -> None:
    """Raise RequestError if the file of --config_path is missing."""
    for argument in arguments:
        flag, _, path = argument.partition("=")
        if flag == "--config_path" and path.endswith(".json") and not Path(path).exists():
            raise RequestError(f"The settings file does not exist: {path}")


def training_config(arguments: Sequence[str]) -> Any:
    """Parse flags of lerobot-train into its settings (TrainPipelineConfig).

    Raises:
        RequestError: The file of --config_path is missing, or the parser failed.
        SystemExit: The parser refused the arguments (2) and printed why.
    """
    check_settings_file(arguments)
    register_third_party_plugins()
    with _called_with(arguments):
        try:
            return draccus.parse(TrainPipelineConfig, args=list(arguments))
        except Exception as error:  # any error of another parser
            raise RequestError(f"{PROGRAM} does not take these settings ({type(error).__name__}: {error}).") from error


@contextmanager
def _reading_fast(
    frame_cache_bytes: int, on_replaced: Callable[[], None], *, expert_only: bool
) -> Iterator[list[FastDataset]]:
    """Let LeRobot's factory of datasets make `FastDataset`s, which are appended to the list."""
    opened: list[FastDataset] = []

    def open_dataset(*args: Any, **kwargs: Any) -> FastDataset:
        if not opened:
            on_replaced()
        opened.append(FastDataset(*args, frame_cache_bytes=frame_cache_bytes, expert_only=expert_only, **kwargs))
        return opened[-1]

    with _replaced(factory, "LeRobotDataset", open_dataset):
        yield opened


def _encoding_once(opened: Sequence[FastDataset]) -> AbstractContextManager[None]:
    """Let policies of type act_keypoints that lerobot-train makes encode each frame of the dataset once."""
    make_policy = lerobot_train.make_policy

    def make_policy_with_encodings(*args: Any, **kwargs: Any) -> Any:
        policy = make_policy(*args, **kwargs)
        if policy.config.type != "act_keypoints":
            return policy
        if not policy.config.pretrained_path:
            raise RequestError(
                "The encoder of a policy of type act_keypoints is trained before the policy: act-keypoints-pretrain, "
                "then --policy.path with its --out."
            )
        for dataset in opened:
            if dataset.image_transforms is None:  # transforms change an image each time
                encodings = Encodings(dataset.meta.total_frames)
                encodings.serve(policy)
                dataset.leave_out_images(encodings.known)
        return policy

    return _replaced(lerobot_train, "make_policy", make_policy_with_encodings)


@contextmanager
def _called_with(arguments: Sequence[str]) -> Iterator[None]:
    """Set the command line that LeRobot's parser also reads by itself; make its exit code 0 or 2."""
    try:
        with _replaced(sys, "argv", [PROGRAM, *arguments]):
            yield
    except SystemExit as ended:  # its parser exits with 1 for some wrong requests and with 2 for others
        raise SystemExit(2 if ended.code else 0) from None


@contextmanager
def _replaced(owner: Any, name: str, value: Any) -> Iterator[None]:
    """Set an attribute within the context."""
    before = getattr(owner, name)
    setattr(owner, name, value)
    try:
        yield
    finally:
        setattr(owner, name, before)
