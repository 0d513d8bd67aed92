"""Editing a dataset: `demorec dataset` against LeRobot's own tool and a plain copy, in one interleaved run.

    python benchmarks/edits.py                                   less than two minutes
    python benchmarks/edits.py --episodes 200 --rounds 1         the same with a dataset ten times as large

Deletes a twentieth of the episodes, splits 80 to 20, merges 5 copies, trims two frames off every episode (LeRobot has
no trim). One camera of 64x48, as LeRobot's default writer encodes it (AV1), 10 frames an episode. CPU seconds count
child processes; what loading the libraries costs is measured first and taken off.
"""

from __future__ import annotations

import argparse
import os
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

BIN = Path(sys.executable).parent
ENVIRONMENT = {**os.environ, "HF_HUB_OFFLINE": "1", "HF_DATASETS_OFFLINE": "1", "OMP_NUM_THREADS": "1"}


def written_by_lerobot(root: Path, episodes: int, frames: int) -> Path:
    from lerobot.datasets import LeRobotDataset

    rng = np.random.default_rng(0)
    vector = {"dtype": "float32", "shape": (3,), "names": ["x", "y", "z"]}
    camera = {"dtype": "video", "shape": (48, 64, 3), "names": ["height", "width", "channels"]}
    features = {"observation.state": vector, "action": vector, "observation.images.top": camera}
    dataset = LeRobotDataset.create("local/x", fps=10, features=features, root=root)
    for episode in range(episodes):
        for t in range(frames):
            image = np.full((48, 64, 3), (episode * 7 + t * 3) % 255, np.uint8)
            image[10:30, 5 + t : 25 + t] = 200
            numbers = rng.normal(size=(2, 3)).astype(np.float32)
            dataset.add_frame(
                {"observation.state": numbers[0], "action": numbers[1], "observation.images.top": image, "task": "go"}
            )
        dataset.save_episode()
    dataset.finalize()
    return root


def seconds(*command: object) -> tuple[float, float]:
    """CPU and wall seconds of a command with its children."""
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    done = subprocess.run([*map(str, command)], env=ENVIRONMENT, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{' '.join(map(str, command))} failed: {done.stderr[-1500:]}")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return (
        after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime,
        time.perf_counter() - start,
    )


def commands(root: Path, copies: Sequence[Path], out: Path, episodes: int) -> dict[str, dict[str, list[list[object]]]]:
    """Work -> who does it -> commands."""
    gone = list(range(0, episodes, 20))
    ours: list[object] = [BIN / "demorec", "dataset"]
    theirs: list[object] = [BIN / "lerobot-edit-dataset", f"--root={root}", "--repo_id=local/x"]
    new = out / "lerobot"
    named = [f"--new_root={new}", "--new_repo_id=local/y"]
    repos = f"[{', '.join(repr(f'local/{copy.name}') for copy in copies)}]"
    roots = f"[{', '.join(repr(str(copy)) for copy in copies)}]"
    merging = ["--operation.type=merge", f"--operation.repo_ids={repos}", f"--operation.roots={roots}"]
    copy: list[object] = ["cp", "-r", root, out / "copy"]
    return {
        "delete": {
            "demorec": [[*ours, "drop", root, "--episodes", ",".join(map(str, gone)), "--out", out / "demorec"]],
            "lerobot": [[*theirs, *named, "--operation.type=delete_episodes", f"--operation.episode_indices={gone}"]],
            "copy": [copy],
        },
        "split": {
            "demorec": [[*ours, "split", root, "--shares", "train=0.8", "val=0.2", "--out", out / "demorec"]],
            "lerobot": [[*theirs, *named, "--operation.type=split", '--operation.splits={"train": 0.8, "val": 0.2}']],
            "copy": [copy],
        },
        "merge 5": {
            "demorec": [[*ours, "merge", *copies, "--out", out / "demorec"]],
            "lerobot": [[theirs[0], *named, *merging]],
            "copy": [["cp", "-r", each, out / f"copy_{number}"] for number, each in enumerate(copies)],
        },
        "trim": {
            "demorec": [[*ours, "trim", root, "--head", 1, "--tail", 1, "--out", out / "demorec"]],
            "copy": [copy],
        },
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--frames", type=int, default=10, help="of each episode")
    parser.add_argument("--rounds", type=int, default=1)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="demorec-benchmark-") as name:
        folder = Path(name)
        root = written_by_lerobot(folder / "d", args.episodes, args.frames)
        copies = [Path(shutil.copytree(root, folder / f"d{number}")) for number in range(5)]
        idle = {
            "demorec": seconds(BIN / "demorec", "dataset", "select", root, "--episodes", 0, "--out", "x", "--dry-run"),
            "lerobot": seconds(sys.executable, "-c", "import lerobot.scripts.lerobot_edit_dataset"),
            "copy": seconds("cp", "--version"),
        }
        print("loading, CPU s: " + ", ".join(f"{who} {cpu:.2f}" for who, (cpu, _) in idle.items()))
        spent: dict[tuple[str, str], list[tuple[float, float]]] = {}
        for _ in range(args.rounds):
            for work, by in commands(root, copies, folder / "out", args.episodes).items():
                (folder / "out").mkdir()
                for who, calls in by.items():
                    costs = [seconds(*call) for call in calls]
                    spent.setdefault((work, who), []).append((sum(c for c, _ in costs), sum(w for _, w in costs)))
                shutil.rmtree(folder / "out")
    print(f"{args.episodes} episodes of {args.frames} frames; CPU s (wall s), with loading; CPU ratio without loading")
    for work in dict.fromkeys(work for work, _ in spent):
        cells, own = [], {}
        for who in ("demorec", "lerobot", "copy"):
            if (work, who) in spent:
                cpu, wall = (statistics.median(values) for values in zip(*spent[work, who], strict=True))
                own[who] = max(cpu - idle[who][0], 0.0)
                cells.append(f"{who} {cpu:.2f} ({wall:.2f})")
        if "lerobot" in own:
            cells.append(f"lerobot/demorec {own['lerobot'] / max(own['demorec'], 0.01):.1f}")
        print(f"{work:8} {'  '.join(cells)}")


if __name__ == "__main__":
    main()
