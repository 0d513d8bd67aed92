"""Reading a dataset for training: the plug-in's reader and LeRobot's, with equal arguments, in one interleaved run.

    python benchmarks/reading.py                                    everything, smallest sample
    python benchmarks/reading.py --sizes 224 --workers 0 --batches 8 --rounds 3

torch's DataLoader makes batches of 64 random items, without repetition, so that a cache of frames does not help. CPU
time includes starting the worker processes. The datasets show the same images: one is demorec's export (H.264), one is
written by LeRobot with its defaults (AV1).
"""

from __future__ import annotations

import argparse
import resource
import statistics
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))

from export import Images, made_up, record, scene_images

CAMERAS = ("front", "wrist")
BATCH = 64
FPS = 30
CHUNK = [k / FPS for k in range(16)]
HISTORY = [-1 / FPS, 0.0]


@dataclass(kw_only=True)
class Cost:
    """CPU and wall milliseconds an item, of every round."""

    cpu: list[float] = field(default_factory=list)
    wall: list[float] = field(default_factory=list)


def images_of(args: argparse.Namespace, size: int, episode: int) -> Images:
    return {name: scene_images(args.frames, size, size, seed=7 * episode + n) for n, name in enumerate(CAMERAS)}


def written_by_demorec(folder: Path, args: argparse.Namespace, size: int) -> Path:
    from demorec.datasets.lerobot.export import export_lerobot
    from demorec.datasets.lerobot.options import ExportOptions

    (folder / "run" / "episodes").mkdir(parents=True)
    for episode in range(args.episodes):
        path = folder / "run" / "episodes" / f"episode_{episode:06d}.mcap"
        record(path, made_up(images_of(args, size, episode), episode))
    export_lerobot([folder / "run"], folder / "dataset", ExportOptions(verify=False))
    return folder / "dataset"


def written_by_lerobot(folder: Path, args: argparse.Namespace, size: int) -> Path:
    from lerobot.datasets import LeRobotDataset

    axes = ["height", "width", "channels"]
    features: dict[str, Any] = {
        "observation.state": {"dtype": "float32", "shape": (8,), "names": None},
        "action": {"dtype": "float32", "shape": (8,), "names": None},
    }
    for name in CAMERAS:
        features[f"observation.images.{name}"] = {"dtype": "video", "shape": (size, size, 3), "names": axes}
    dataset = LeRobotDataset.create("local/av1", FPS, features, root=folder / "dataset")
    for episode in range(args.episodes):
        images = images_of(args, size, episode)
        for t in range(args.frames):
            numbers = np.full(8, episode + t / args.frames, np.float32)
            frame = {f"observation.images.{name}": images[name][t] for name in CAMERAS}
            dataset.add_frame({"observation.state": numbers, "action": numbers, "task": "bench", **frame})
        dataset.save_episode()
    dataset.finalize()
    return folder / "dataset"


def without_images(folder: Path, args: argparse.Namespace) -> Path:
    """Write the numbers of demorec's default features, 13 columns, for as many episodes as a training has."""
    from support.recording import write_episode

    from demorec.datasets.lerobot.export import export_lerobot
    from demorec.datasets.lerobot.options import ExportOptions

    (folder / "run" / "episodes").mkdir(parents=True)
    for episode in range(10 * args.episodes):
        path = folder / "run" / "episodes" / f"episode_{episode:06d}.mcap"
        write_episode(path, num_frames=args.frames, cameras=(), episode_index=episode)
    export_lerobot([folder / "run"], folder / "dataset", ExportOptions(verify=False, privileged=True))
    return folder / "dataset"


def cpu_seconds() -> float:
    usages = (resource.getrusage(resource.RUSAGE_SELF), resource.getrusage(resource.RUSAGE_CHILDREN))
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)


def read(dataset: Any, rows: Sequence[int], workers: int, cost: Cost) -> Any:
    """Read one round; returns the last batch for comparison."""
    import torch

    start = "fork" if workers else None
    loader = torch.utils.data.DataLoader(
        dataset, batch_size=BATCH, sampler=rows, num_workers=workers, multiprocessing_context=start
    )
    cpu, wall = cpu_seconds(), time.perf_counter()
    last = None
    for batch in loader:  # the workers end with it, and their time counts
        last = batch
    cost.cpu.append(1e3 * (cpu_seconds() - cpu) / len(rows))
    cost.wall.append(1e3 * (time.perf_counter() - wall) / len(rows))
    return last


def compare(name: str, root: Path, windows: dict[str, list[float]], workers: int, args: argparse.Namespace) -> None:
    """Print one row: LeRobot's reader, demorec's, the ratio of their CPU times."""
    import torch
    from lerobot.datasets import LeRobotDataset

    from lerobot_policy_act_keypoints import FastDataset

    arguments = {"root": root, "video_backend": args.backend, "return_uint8": True, "delta_timestamps": windows}
    datasets = {
        "lerobot": LeRobotDataset("local/bench", **arguments),
        "demorec": FastDataset("local/bench", **arguments, frame_cache_bytes=0),
    }
    costs = {reader: Cost() for reader in datasets}
    rng = np.random.default_rng(0)
    for dataset in datasets.values():  # fixed costs
        dataset[0]
    for number in range(args.rounds):
        rows = rng.permutation(len(datasets["lerobot"]))[: BATCH * args.batches].tolist()
        order = list(datasets) if number % 2 == 0 else list(reversed(datasets))
        last = {reader: read(datasets[reader], rows, workers, costs[reader]) for reader in order}
        for key, value in last["lerobot"].items():
            same = torch.equal(value, last["demorec"][key]) if torch.is_tensor(value) else value == last["demorec"][key]
            assert same, key
    cpu = {reader: statistics.median(cost.cpu) for reader, cost in costs.items()}
    wall = {reader: statistics.median(cost.wall) for reader, cost in costs.items()}
    print(
        f"{name:<34} {workers:>7} {cpu['lerobot']:>9.3f} {cpu['demorec']:>9.3f} "
        f"{cpu['lerobot'] / cpu['demorec']:>7.1f} {wall['lerobot']:>9.3f} {wall['demorec']:>9.3f}",
        flush=True,
    )


def main() -> None:
    """Make the datasets and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=int, nargs="*", default=[96, 224])
    parser.add_argument("--writers", nargs="+", default=["demorec", "lerobot"], choices=("demorec", "lerobot"))
    parser.add_argument("--workers", type=int, nargs="+", default=[0, 2])
    parser.add_argument("--backend", default="pyav", choices=("pyav", "torchcodec"))
    parser.add_argument("--episodes", type=int, default=4)
    parser.add_argument("--frames", type=int, default=120, help="of an episode")
    parser.add_argument("--batches", type=int, default=4)
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--no-numbers", action="store_true")
    args = parser.parse_args()
    import datasets
    import torch

    datasets.disable_progress_bars()
    torch.set_num_threads(1)
    print(f"{'ms an item':<34} {'workers':>7} {'lerobot':>9} {'demorec':>9} {'ratio':>7} {'wall':>9} {'wall':>9}")
    with tempfile.TemporaryDirectory(prefix="demorec-reading-") as folder:
        if not args.no_numbers:
            root = without_images(Path(folder) / "numbers", args)
            for workers in args.workers:
                compare("numbers, chunk 16", root, {"action": CHUNK}, workers, args)
        for size in args.sizes:
            for writer in args.writers:
                make = written_by_demorec if writer == "demorec" else written_by_lerobot
                root = make(Path(folder) / f"{writer}_{size}", args, size)
                both = dict.fromkeys([f"observation.images.{name}" for name in CAMERAS], HISTORY)
                for workers in args.workers:
                    name = f"two {size}x{size} of {writer}, chunk 16"
                    compare(name, root, {"action": CHUNK}, workers, args)
                    compare(f"{'':<4}and history of two", root, {"action": CHUNK, **both}, workers, args)


if __name__ == "__main__":
    main()
