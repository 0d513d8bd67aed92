"""Editing a dataset: `demorec dataset` against LeRobot's own tool and a plain copy, in one interleaved run.

    python benchmarks/edits.py                          200 episodes of 100 frames, less than five minutes
    python benchmarks/edits.py --episodes 20 --frames 50
    python benchmarks/edits.py --episodes 50 --frames 150 --size 640 480     images of a typical size
    python benchmarks/edits.py --copies 1 10 --without-lerobot     how demorec's cost grows with the dataset

Deletes a twentieth of the episodes, splits 80 to 20, merges 5 datasets, and trims a frame off both ends of every
episode (LeRobot has no trim). The dataset has two cameras of 96x96, encoded by LeRobot's default writer (AV1); a tenth
of its episodes are recorded and merged ten times, which keeps their packets. CPU seconds include child processes. The
cost of starting and loading libraries is measured first, and listed separately.
"""

from __future__ import annotations

import argparse
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

BIN = Path(sys.executable).parent
ENVIRONMENT = {**os.environ, "HF_HUB_OFFLINE": "1", "HF_DATASETS_OFFLINE": "1", "OMP_NUM_THREADS": "1"}
ENVIRONMENT.pop("PYTHONDONTWRITEBYTECODE", None)  # otherwise every start would compile the package again


def written_by_lerobot(root: Path, episodes: int, frames: int, width: int, height: int) -> Path:
    from lerobot.datasets import LeRobotDataset

    rng = np.random.default_rng(0)
    vector = {"dtype": "float32", "shape": (7,), "names": [f"joint_{number}" for number in range(7)]}
    camera = {"dtype": "video", "shape": (height, width, 3), "names": ["height", "width", "channels"]}
    cameras = ("observation.images.top", "observation.images.wrist")
    features = {"observation.state": vector, "action": vector, **dict.fromkeys(cameras, camera)}
    dataset = LeRobotDataset.create("local/x", fps=30, features=features, root=root)
    y, x = np.mgrid[:height, :width]
    for episode in range(episodes):
        for t in range(frames):
            image = np.stack([x + 3 * t + 7 * episode, 2 * y + t, x * y // 16 + 5 * episode], axis=-1).astype(np.uint8)
            begin = 10 + t % (height - 40)
            image[begin : begin + 20, begin : begin + 20] = 200
            numbers = rng.normal(size=(2, 7)).astype(np.float32)
            frame = {"observation.state": numbers[0], "action": numbers[1], "task": "go"}
            dataset.add_frame({**frame, cameras[0]: image, cameras[1]: np.ascontiguousarray(image[::-1])})
        dataset.save_episode()
    dataset.finalize()
    return root


def multiplied(root: Path, times: int, out: Path) -> Path:
    """Repeat the episodes of a dataset with unchanged packets."""
    copies = [Path(shutil.copytree(root, out.with_name(f"{out.name}_{number}"))) for number in range(times)]
    if times == 1:
        return copies[0]
    seconds(BIN / "demorec", "dataset", "merge", *copies, "--out", out)
    for copy in copies:
        shutil.rmtree(copy)
    return out


_MEASURED = """
import resource, signal, subprocess, sys, time
start = time.perf_counter()
done = subprocess.run(sys.argv[1:], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
if done.returncode not in (0, -signal.SIGABRT):  # LeRobot's threads may abort when all is written
    sys.exit(done.stderr.decode(errors="replace")[-1500:])
used = resource.getrusage(resource.RUSAGE_CHILDREN)
print(used.ru_utime + used.ru_stime, time.perf_counter() - start, used.ru_maxrss / 1000)
"""
"""A separate process, since the reported memory of a child is at least that of its parent."""


def seconds(*command: object) -> tuple[float, float, float]:
    """CPU and wall seconds of a command with its children, and its peak memory in MB."""
    words = [sys.executable, "-c", _MEASURED, *map(str, command)]
    done = subprocess.run(words, env=ENVIRONMENT, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{' '.join(map(str, command))} failed: {done.stderr}")
    cpu, wall, memory = map(float, done.stdout.split())
    return cpu, wall, memory


def commands(root: Path, copies: Sequence[Path], out: Path, episodes: int) -> dict[str, dict[str, list[list[object]]]]:
    """Work -> program -> commands."""
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


def start_costs(root: Path) -> dict[str, float]:
    """CPU s of starting demorec and LeRobot, including all that an edit loads."""
    dry = (BIN / "demorec", "dataset", "select", root, "--episodes", 0, "--out", "x", "--dry-run")
    return {
        "demorec": seconds(*dry)[0],
        "lerobot": seconds(sys.executable, "-c", "import lerobot.scripts.lerobot_edit_dataset")[0],
        "copy": seconds("cp", "--version")[0],
    }


def measured(folder: Path, root: Path, episodes: int, rounds: int, without: str) -> None:
    """Measure everything on a dataset, and print a row for each kind of work."""
    copies = [Path(shutil.copytree(root, folder / f"d{number}")) for number in range(5)]
    idle = start_costs(root)
    spent: dict[tuple[str, str], list[tuple[float, float, float]]] = {}
    for _ in range(rounds):
        for work, by in commands(root, copies, folder / "out", episodes).items():
            (folder / "out").mkdir()
            for who, calls in by.items():
                if who != without:
                    costs = [seconds(*call) for call in calls]
                    cpu, wall, memory = zip(*costs, strict=True)
                    spent.setdefault((work, who), []).append((sum(cpu), sum(wall), max(memory)))
            shutil.rmtree(folder / "out")
    size = sum(path.stat().st_size for path in root.rglob("*") if path.is_file())
    print(
        f"{episodes} episodes, {size / 1e6:.1f} MB; start, CPU s: " + ", ".join(f"{k} {v:.2f}" for k, v in idle.items())
    )
    print("work       CPU s (wall s, memory) with start; ratios of CPU with start / without")
    for work in dict.fromkeys(work for work, _ in spent):
        cells: list[str] = []
        spent_cpu: dict[str, float] = {}
        for who in (who for who in idle if (work, who) in spent):
            took, passed, most = (statistics.median(values) for values in zip(*spent[work, who], strict=True))
            spent_cpu[who] = took
            cells.append(f"{who} {took:.2f} ({passed:.2f}, {most:.0f} MB)")
        own = {who: max(value - idle[who], 0.01) for who, value in spent_cpu.items()}
        for a, b in (("lerobot", "demorec"), ("demorec", "copy")):
            if a in spent_cpu:
                cells.append(f"{a}/{b} {spent_cpu[a] / max(spent_cpu[b], 0.01):.1f} / {own[a] / own[b]:.1f}")
        print(f"{work:9}  {'  '.join(cells)}")
    for copy in copies:
        shutil.rmtree(copy)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--frames", type=int, default=100, help="of each episode")
    parser.add_argument("--size", type=int, nargs=2, default=(96, 96), help="width and height of the images")
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--copies", type=int, nargs="+", default=[1], help="factors by which the dataset is enlarged")
    parser.add_argument("--without-lerobot", action="store_true")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="demorec-benchmark-") as name:
        folder = Path(name)
        few = written_by_lerobot(folder / "few", max(1, args.episodes // 10), args.frames, *args.size)
        base = multiplied(few, 10, folder / "base")
        for times in args.copies:
            root = multiplied(base, times, folder / f"times_{times}")
            without = "lerobot" if args.without_lerobot else ""
            measured(folder, root, args.episodes // 10 * 10 * times, args.rounds, without)


if __name__ == "__main__":
    main()
