"""What language, progress and boxes add to an export, to its size, and to reading an item of the dataset.

    python benchmarks/language.py                                    makes ten episodes first
    python benchmarks/language.py --run recordings/cubes --rounds 9

Every round exports the same run with each choice one after the other; CPU time of the process, medians, and the ratio
to the plain export of the same round. Items are read by LeRobot, with pictures and without, in the same order.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from demorec.lerobot import ExportOptions, export_lerobot

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))

CHOICES: dict[str, dict[str, Any]] = {
    "plain": {},
    "subtask": {"language": ("subtask",)},
    "states": {"language": ("subtask", "plan", "memory", "motion", "task_aug")},
    "language": {"language": ()},
    "progress": {"progress": True},
    "boxes": {"boxes": True},
}
"""What is exported, and with which options; `states` is all language but what is about single pictures."""


def size_of(folder: Path) -> int:
    return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())


def exports(run: Path, work: Path, rounds: int) -> None:
    seconds: dict[str, list[float]] = {name: [] for name in CHOICES}
    sizes, frames = {}, 0
    for number in range(rounds + 1):
        for name, options in CHOICES.items():
            out = work / f"{name}-{number}"
            start = time.process_time()
            frames = export_lerobot([run], out, ExportOptions(verify=False, **options)).num_frames
            if number:  # the first round loads libraries
                seconds[name].append(time.process_time() - start)
            sizes[name] = size_of(out)
    print(f"export of {frames} frames: CPU ms a frame, ratio to plain, bytes a frame")
    for name in CHOICES:
        ratio = statistics.median(a / b for a, b in zip(seconds[name], seconds["plain"], strict=True))
        cost = 1e3 * statistics.median(seconds[name]) / frames
        print(f"  {name:9} {cost:7.3f} {ratio:6.2f} {sizes[name] / frames:8.0f}")


def items(run: Path, work: Path, rounds: int, *, pictures: bool) -> None:
    """Reading single items by LeRobot, from datasets with and without language."""
    from lerobot.datasets import LeRobotDataset

    features = () if pictures else ("observation.state", "action")
    datasets = {}
    for name in ("plain", "subtask", "states"):
        out = work / f"items-{name}-{pictures}"
        export_lerobot([run], out, ExportOptions(verify=False, features=features, **CHOICES[name]))
        datasets[name] = LeRobotDataset("local/x", root=out, video_backend="pyav")
    seconds: dict[str, list[float]] = {name: [] for name in datasets}
    count = min(len(datasets["plain"]), 100 if pictures else 400)
    for _ in range(rounds):
        for name, dataset in datasets.items():
            start = time.process_time()
            for index in range(count):
                dataset[index * len(dataset) // count]
            seconds[name].append((time.process_time() - start) / count)
    print(f"an item {'with' if pictures else 'without'} pictures: CPU ms, ratio to plain")
    for name, found in seconds.items():
        ratio = statistics.median(a / b for a, b in zip(found, seconds["plain"], strict=True))
        print(f"  {name:9} {1e3 * statistics.median(found):7.3f} {ratio:6.2f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", type=Path, help="a run with cameras and segmentation")
    parser.add_argument("--rounds", type=int, default=5)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        work, run = Path(folder), args.run
        if run is None:
            from support.check import simulate_run

            size = {"width": 224, "height": 224}
            run = simulate_run(work / "run", 10, seed=1, cameras=("front", "wrist"), segmentation=True, **size)
        exports(run, work, args.rounds)
        for pictures in (False, True):
            items(run, work, args.rounds, pictures=pictures)


if __name__ == "__main__":
    main()
