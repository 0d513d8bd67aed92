"""The commands `act-keypoints-pretrain` and `lerobot-train-fast`.

Exit codes: 0 done; 1 the training failed, or a file is damaged; 2 the request was wrong; 130 interrupted.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from lerobot_policy_act_keypoints.errors import RequestError, TrainingError

_TRAIN_HELP = """Train a policy with lerobot-train and a faster dataset reader, which gives the same items.

All other flags are passed on to lerobot-train unchanged (see lerobot-train --help); checkpoints and logs are its own.
Any LeRobot dataset can be read.

examples:
  lerobot-train-fast --config_path=examples/act_numbers.json
  lerobot-train-fast --config_path=examples/act_images.json --policy.path=outputs/eye
  lerobot-train-fast --dataset.repo_id=lerobot/pusht --policy.type=diffusion
"""
_PRETRAIN_HELP = """Pretrain the image encoder of a policy of type act_keypoints before the policy is trained.

From the images, it learns to predict where the hand will be when the gripper is next commanded to close, and when it
is next commanded to open. The targets come from the dataset's own poses and commands; no object poses are needed. The
result is a policy folder for --policy.path of lerobot-train-fast. All other flags are those of lerobot-train, of which
only those about the dataset, the policy and the seed matter. Run the same command again to continue where it stopped.

examples:
  act-keypoints-pretrain --config_path=examples/act_images.json --out outputs/eye
  lerobot-train-fast --config_path=examples/act_images.json --policy.path=outputs/eye
"""
_CACHE_HELP = "cache of decoded frames in each process, in MiB; a small dataset is then decoded only once (default 256)"


def lerobot_train_fast(argv: Sequence[str] | None = None) -> None:
    """Entry point of `lerobot-train-fast`; exits the process."""
    parser = _parser("lerobot-train-fast", _TRAIN_HELP)
    parser.add_argument("--frame-cache-mb", type=_within(int, 0, 1 << 20), default=256, help=_CACHE_HELP)
    parser.add_argument(
        "--expert-only",
        action="store_true",
        help="in corrected episodes (column `intervention`), learn from the expert's frames only",
    )
    flags, others = parser.parse_known_args(argv)

    def run() -> None:
        from lerobot_policy_act_keypoints.training import train

        replaced = f"{parser.prog}: FastDataset reads in place of LeRobotDataset; all else is lerobot-train."
        train(
            others,
            frame_cache_bytes=flags.frame_cache_mb << 20,
            on_replaced=lambda: _print_stderr(replaced),
            expert_only=flags.expert_only,
        )

    _exit_after(run, parser.prog)


def act_keypoints_pretrain(argv: Sequence[str] | None = None) -> None:
    """Entry point of `act-keypoints-pretrain`; exits the process."""
    parser = _parser("act-keypoints-pretrain", _PRETRAIN_HELP)
    parser.add_argument("--out", type=Path, required=True, help="folder of the policy")
    parser.add_argument(
        "--num-updates",
        type=_within(int, 1, 10_000_000),
        default=3000,
        help="number of updates of the encoder's weights (default 3000)",
    )
    parser.add_argument(
        "--frames-per-update",
        type=_within(int, 2, 65_536),
        default=64,
        help="frames per update, each with the images of all cameras (default 64)",
    )
    parser.add_argument(
        "--learning-rate",
        type=_within(float, 1e-7, 1.0),
        default=2e-3,
        help="peak learning rate; it decays along a cosine (default 2e-3)",
    )
    parser.add_argument("--frame-cache-mb", type=_within(int, 0, 1 << 20), default=256, help=_CACHE_HELP)
    flags, others = parser.parse_known_args(argv)

    def run() -> None:
        steps = next((flag for flag in others if flag.partition("=")[0] == "--steps"), None)
        if steps is not None:
            raise RequestError(f"{steps} is a flag of lerobot-train-fast: give --num-updates for the encoder.")
        from lerobot_policy_act_keypoints.pretrain import PretrainConfig, pretrain
        from lerobot_policy_act_keypoints.training import training_config

        config = training_config(others)
        plan = PretrainConfig(
            updates=flags.num_updates,
            batch_size=flags.frames_per_update,
            learning_rate=flags.learning_rate,
            seed=config.seed or 0,
        )
        result = pretrain(
            config, plan, flags.out, frame_cache_bytes=flags.frame_cache_mb << 20, on_progress=_print_stderr
        )
        print(
            f"next keyframe {1000 * result.median_m:.1f} mm off (median; 9 of 10 frames within "
            f"{1000 * result.most_m:.0f} mm) in {result.episodes} held-out episodes; without images "
            f"{1000 * result.baseline_m:.0f} mm"
        )
        print(f"policy        {flags.out}")

    _exit_after(run, parser.prog)


def _parser(program: str, text: str) -> argparse.ArgumentParser:
    return argparse.ArgumentParser(
        prog=program,
        description=text,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,  # any other flag is one of lerobot-train
    )


def _within[T: (int, float)](kind: type[T], low: T, high: T) -> Callable[[str], T]:
    """Make an argument type that accepts numbers from `low` to `high`."""

    def number(text: str) -> T:
        value = kind(text)
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"{text} is not within {low:g} to {high:g}")
        return value

    return number


def _exit_after(run: Callable[[], None], program: str) -> None:
    """Run a command; turn its errors into one sentence and an exit code."""
    try:
        run()
    except TrainingError as error:
        _print_stderr(f"{program}: {error}")
        sys.exit(error.exit_code)
    except KeyboardInterrupt:
        _print_stderr(f"{program}: interrupted.")
        sys.exit(130)
    sys.exit(0)


def _print_stderr(text: str) -> None:
    print(text, file=sys.stderr, flush=True)
