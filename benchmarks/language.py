"""Cost of language, progress and boxes: time and size of an export, and time to read an item of the dataset.

    python benchmarks/language.py                                    makes ten episodes first
    python benchmarks/language.py --run recordings/cubes --rounds 9
    python benchmarks/language.py --commands 10 1000                 whole commands, on these numbers of episodes

Every round exports the same run with each choice one after the other; the table has medians of the process's CPU time,
and the ratio to the plain export of the same round. LeRobot and demorec read the same random items, with images (by
each decoder that works here) and without. --commands runs `demorec export lerobot` including LeRobot's verification,
without --language and with it, on copies of the run's recordings.
"""

from __future__ import annotations

import argparse
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from demorec.datasets.lerobot.export import export_lerobot
from demorec.datasets.lerobot.options import LeRobotOptions

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))

CHOICES: dict[str, dict[str, Any]] = {
    "plain": {},
    "subtask": {"language": ("subtask",)},
    "language": {"language": ()},
    "progress": {"progress": True},
    "boxes": {"boxes": True},
}
"""Exports, with their options."""


BATCH = 32


def size_of(folder: Path) -> int:
    return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())


def exports(run: Path, work: Path, rounds: int) -> None:
    seconds: dict[str, list[float]] = {name: [] for name in CHOICES}
    sizes, frames = {}, 0
    for number in range(rounds + 1):
        for name, options in CHOICES.items():
            out = work / f"{name}-{number}"
            start = time.process_time()
            frames = export_lerobot([run], out, LeRobotOptions(verify=False, **options)).num_frames
            if number:  # the first round loads libraries
                seconds[name].append(time.process_time() - start)
            sizes[name] = size_of(out)
    print(f"export of {frames} frames: CPU ms a frame, ratio to plain, bytes a frame")
    for name in CHOICES:
        ratio = statistics.median(a / b for a, b in zip(seconds[name], seconds["plain"], strict=True))
        cost = 1e3 * statistics.median(seconds[name]) / frames
        print(f"  {name:9} {cost:7.3f} {ratio:6.2f} {sizes[name] / frames:8.0f}")


def decoders() -> list[str]:
    """Decoders that work here; torchcodec needs the system's FFmpeg."""
    try:
        import torchcodec.decoders  # noqa: F401
    except (ImportError, RuntimeError, OSError):
        return ["pyav"]
    return ["pyav", "torchcodec"]


def items(run: Path, work: Path, rounds: int, *, images: bool) -> None:
    """Read random items in batches, by LeRobot and by `FastDataset`, from datasets with and without language."""
    import numpy as np
    import torch
    from lerobot.datasets import LeRobotDataset

    from lerobot_policy_act_keypoints import FastDataset

    torch.set_num_threads(1)  # waiting threads would count as CPU time
    features = () if images else ("observation.state", "action")
    names = ("plain", "subtask", "language")
    readers: dict[tuple[str, str, str], Any] = {}
    for name in names:
        out = work / f"items-{name}-{images}"
        export_lerobot([run], out, LeRobotOptions(verify=False, features=features, **CHOICES[name]))
        for decoder in decoders() if images else ["pyav"]:
            for reader in (LeRobotDataset, FastDataset):
                cache: dict[str, Any] = {} if reader is LeRobotDataset else {"frame_cache_bytes": 0}
                made = reader("local/x", root=out, video_backend=decoder, **cache)
                readers[reader.__name__, decoder if images else "", name] = made
    seconds: dict[tuple[str, str, str], list[float]] = {key: [] for key in readers}
    rng, count = np.random.default_rng(0), BATCH * (2 if images else 12)
    for number in range(rounds + 1):
        chosen = rng.permutation(len(readers[next(iter(readers))]))[:count].tolist()
        for key, dataset in readers.items():
            start = time.process_time()
            for first in range(0, len(chosen), BATCH):
                batch = chosen[first : first + BATCH]
                if key[0] == "FastDataset":
                    dataset.__getitems__(batch)
                else:
                    [dataset[index] for index in batch]
            if number:
                seconds[key].append((time.process_time() - start) / len(chosen))
    print(f"an item {'with' if images else 'without'} images: CPU ms, ratio to plain")
    for (reader_name, decoder, name), found in seconds.items():
        plain = seconds[reader_name, decoder, "plain"]
        ratio = statistics.median(a / b for a, b in zip(found, plain, strict=True))
        print(f"  {reader_name:14} {decoder:10} {name:9} {1e3 * statistics.median(found):7.3f} {ratio:6.2f}")


def commands(run: Path, work: Path, counts: list[int], rounds: int) -> None:
    """Run whole commands on copies of the run's episodes, since only their number matters."""
    recordings = sorted((run / "episodes").glob("*.mcap"))
    for count in counts:
        copies = work / f"copies-{count}"
        copies.mkdir()
        for index in range(count):
            shutil.copyfile(recordings[index % len(recordings)], copies / f"{index:06d}.mcap")
        seconds: dict[str, list[float]] = {"plain": [], "language": []}
        for number in range(rounds):
            for name, found in seconds.items():
                out = work / f"command-{count}-{name}-{number}"
                words = ["export", "lerobot", str(copies), "--out", str(out), "--workers", "1"]
                words += ["--language"] if name == "language" else []
                before = resource.getrusage(resource.RUSAGE_CHILDREN)
                subprocess.run([sys.executable, "-m", "demorec", *words], check=True, capture_output=True)
                after = resource.getrusage(resource.RUSAGE_CHILDREN)
                found.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
        ratio = statistics.median(a / b for a, b in zip(seconds["language"], seconds["plain"], strict=True))
        cost = ", ".join(f"{name} {statistics.median(found):.1f} CPU s" for name, found in seconds.items())
        print(f"demorec export lerobot, {count} episodes: {cost}, ratio {ratio:.2f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", type=Path, help="a run with cameras and segmentation")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--commands", type=int, nargs="+", help="measure whole commands on these numbers of episodes")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        work, run = Path(folder), args.run
        if run is None:
            from support.check import simulate_run

            size = {"width": 224, "height": 224}
            run = simulate_run(work / "run", 10, seed=1, cameras=("front", "wrist"), segmentation=True, **size)
        if args.commands:
            commands(run, work, args.commands, args.rounds)
            return
        exports(run, work, args.rounds)
        for images in (False, True):
            items(run, work, args.rounds, images=images)


if __name__ == "__main__":
    main()
