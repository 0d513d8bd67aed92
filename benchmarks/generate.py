"""The main job from scene to dataset: workers, executors, and the same job done the way people do it today.

    python benchmarks/generate.py                                   a small sample
    python benchmarks/generate.py --episodes 20 --rounds 3 --json generate.json
    python benchmarks/generate.py --memory 10 200                   peak memory at two lengths of a run

"Today" is PyBullet's TinyRenderer and `LeRobotDataset.add_frame` / `save_episode`, with LeRobot's defaults (AV1) and
with streaming encoding; scenes, expert and picture sizes are ours, so that only the pipeline differs. Each variant
is a process of its own and each round runs all of them one after the other; CPU time counts all processes that
belong to a variant, so that ratios hold on a busy machine as well. Start-up is part of it; give more episodes to
see less of it.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil

OURS = ("demorec 1 worker", "demorec 2 workers", "demorec ray 2")
TODAY = ("today default", "today streaming", "today default x2", "today streaming x2")


@dataclass(frozen=True, kw_only=True)
class Sample:
    """One run of a variant."""

    cpu_seconds: float
    wall_seconds: float
    episodes: int
    frames: int
    peak_bytes: int
    steady: tuple[float, ...] = ()  # CPU seconds of each attempt of ours, as its worker measured them


class Meter:
    """CPU seconds and memory of a process and all its descendants, sampled while they live."""

    def __init__(self, pid: int) -> None:
        self._root = psutil.Process(pid)
        self._seen: dict[tuple[int, float], float] = {}
        self.peak_bytes = 0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()

    def _watch(self) -> None:
        while not self._stop.wait(0.1):
            total = 0
            try:
                family = [self._root, *self._root.children(recursive=True)]
            except psutil.Error:
                continue
            for process in family:
                try:
                    times = process.cpu_times()
                    self._seen[process.pid, process.create_time()] = times.user + times.system
                    total += process.memory_info().rss
                except psutil.Error:
                    continue
            self.peak_bytes = max(self.peak_bytes, total)

    def stop(self) -> float:
        """CPU seconds of all that was seen."""
        self._stop.set()
        self._thread.join()
        return sum(self._seen.values())


def ours(name: str, episodes: int, folder: Path, args: argparse.Namespace) -> list[list[str]]:
    command = [sys.executable, "-c", "from demorec.cli import generate_dataset_main as main; main()"]
    command += ["--out", str(folder), "--num-episodes", str(episodes), "--no-check", "--seed", str(args.seed)]
    command += ["--width", str(args.size), "--height", str(args.size)]
    if name == "demorec ray 2":
        return [[*command, "--executor", "ray", "--workers", "2"]]
    return [[*command, "--workers", name.split()[1]]]


def today(name: str, episodes: int, folder: Path, args: argparse.Namespace) -> list[list[str]]:
    """One process a shard; the second half is what a second process makes."""
    shards = 2 if name.endswith("x2") else 1
    return [
        [sys.executable, __file__, "--be-today", str(folder / f"shard{shard}"), "--first", str(first)]
        + ["--episodes", str(last - first), "--size", str(args.size), "--seed", str(args.seed)]
        + (["--streaming"] if "streaming" in name else [])
        for shard in range(shards)
        for first, last in [(episodes * shard // shards, episodes * (shard + 1) // shards)]
        if last > first
    ]


def run_variant(name: str, episodes: int, args: argparse.Namespace) -> Sample:
    with tempfile.TemporaryDirectory(prefix="demorec-bench-") as temporary:
        folder = Path(temporary) / "out"
        commands = (ours if name in OURS else today)(name, episodes, folder, args)
        start = time.perf_counter()
        processes = [
            subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
            for command in commands
        ]
        meters = [Meter(process.pid) for process in processes]
        errors = [process.communicate()[1] for process in processes]
        wall = time.perf_counter() - start
        cpu = sum(meter.stop() for meter in meters)
        if any(process.returncode for process in processes):
            sys.exit(f"{name} failed:\n{''.join(errors)[-2000:]}")
        dataset = [folder / "dataset"] if name in OURS else sorted(folder.glob("shard*"))
        infos = [json.loads((root / "meta/info.json").read_text()) for root in dataset]
        return Sample(
            cpu_seconds=cpu,
            wall_seconds=wall,
            episodes=sum(info["total_episodes"] for info in infos),
            frames=sum(info["total_frames"] for info in infos),
            peak_bytes=sum(meter.peak_bytes for meter in meters),
            steady=attempt_seconds(folder) if name in OURS else (),
        )


def attempt_seconds(folder: Path) -> tuple[float, ...]:
    lines = json.loads((folder / "run.json").read_text())["episodes"]
    return tuple(sum(line["seconds"].values()) for line in lines)


def be_today(args: argparse.Namespace) -> None:
    """Simulate, draw with TinyRenderer, hand every frame to LeRobot."""
    import numpy as np
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    from demorec.config import EpisodePlan, GenerateConfig
    from demorec.rollout import Rollout, make_renderer, make_world, prepare

    config = GenerateConfig(renderer="tiny", width=args.size, height=args.size, seed=args.seed)
    features: dict[str, Any] = {
        key: {"dtype": "float32", "shape": (8,), "names": [f"{key}.{i}" for i in range(8)]}
        for key in ("observation.state", "action")
    }
    for camera in config.cameras:
        features[f"observation.images.{camera}"] = {
            "dtype": "video",
            "shape": (args.size, args.size, 3),
            "names": ["height", "width", "channels"],
        }
    dataset = LeRobotDataset.create(
        "local/today", config.fps, features, root=args.be_today, streaming_encoding=args.streaming
    )
    first = prepare(EpisodePlan(config=config, episode_index=args.first))
    with make_world(first.info) as world, make_renderer(first.info) as renderer:
        for index in range(args.first, args.first + args.episodes):
            episode = prepare(EpisodePlan(config=config, episode_index=index))
            rollout = Rollout(world, episode, renderer)
            for frame in rollout:
                state = np.append(frame.observation.joint_position[:7], frame.observation.gripper_width)
                action = np.append(frame.action.joint_target, frame.action.gripper_target)
                dataset.add_frame(
                    {
                        "observation.state": state.astype(np.float32),
                        "action": action.astype(np.float32),
                        "task": episode.info.instruction,
                        **{f"observation.images.{name}": image.color for name, image in frame.images.items()},
                    }
                )
            if rollout.outcome is not None and rollout.outcome.success:
                dataset.save_episode()
            else:
                dataset.clear_episode_buffer()
    dataset.finalize()


def compare(args: argparse.Namespace) -> dict[str, Any]:
    variants = [name for name in (*OURS, *TODAY) if not args.only or name in args.only]
    samples: dict[str, list[Sample]] = {name: [] for name in variants}
    for number in range(args.rounds):
        for name in variants if number % 2 == 0 else reversed(variants):
            count = args.episodes if name in OURS else args.today_episodes
            samples[name].append(run_variant(name, count, args))
            print(f"round {number + 1}: {name}", file=sys.stderr, flush=True)
    rows = {}
    for name, of_name in samples.items():
        cpu = statistics.median(s.cpu_seconds / s.episodes for s in of_name)
        wall = statistics.median(s.wall_seconds / s.episodes for s in of_name)
        rows[name] = {
            "cpu_s_per_episode": cpu,
            "episodes_per_hour_and_core": 3600 / cpu,
            "frames_per_s_and_core": statistics.median(s.frames / s.cpu_seconds for s in of_name),
            "wall_s_per_episode": wall,
            "peak_mb": max(s.peak_bytes for s in of_name) / 1e6,
            "steady_cpu_s_per_episode": statistics.median(x for s in of_name for x in s.steady)
            if name in OURS
            else cpu,
        }
    head = f"{'':22}{'CPU s/ep':>9}{'ep/h/core':>11}{'frames/s/core':>15}{'wall s/ep':>11}{'MB':>7}{'steady':>8}"
    print(f"{head}{'ratio':>8}")
    base = rows.get("demorec 1 worker")
    for name, row in rows.items():
        ratio = "" if base is None else f"{row['cpu_s_per_episode'] / base['cpu_s_per_episode']:8.2f}"
        print(
            f"{name:<22}{row['cpu_s_per_episode']:9.2f}{row['episodes_per_hour_and_core']:11.0f}"
            f"{row['frames_per_s_and_core']:15.1f}{row['wall_s_per_episode']:11.2f}{row['peak_mb']:7.0f}"
            f"{row['steady_cpu_s_per_episode']:8.2f}{ratio}"
        )
    if base is not None:
        print("steady: median CPU seconds of an attempt, without start-up and export")
        print("ratio: all CPU seconds an episode in units of demorec with one worker")
    return rows


def memory(args: argparse.Namespace) -> dict[str, Any]:
    """Peak memory of driver and workers, and seconds by stage, for runs of several lengths."""
    rows = {}
    for count in args.memory:
        with tempfile.TemporaryDirectory(prefix="demorec-bench-") as temporary:
            (command,) = ours("demorec 2 workers", count, Path(temporary) / "out", args)
            subprocess.run([*command, "--no-export"], check=True, stdout=subprocess.DEVNULL)
            run = json.loads((Path(temporary) / "out/run.json").read_text())
            session, stages = run["sessions"][-1], Counter[str]()
            for line in run["episodes"]:
                stages.update(line["seconds"])
            rows[count] = {
                "driver_mb": session["peak_driver_bytes"] / 1e6,
                "worker_mb": session["peak_worker_bytes"] / 1e6,
                "cpu_s_per_episode": {stage: seconds / count for stage, seconds in stages.items()},
            }
            row = rows[count]
            told = ", ".join(f"{stage} {seconds:.3f}" for stage, seconds in row["cpu_s_per_episode"].items())
            print(
                f"{count:6} episodes: driver {row['driver_mb']:.0f} MB, worker {row['worker_mb']:.0f} MB; "
                f"CPU s an episode: {told}",
                flush=True,
            )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=6, help="of ours in each round")
    parser.add_argument("--today-episodes", type=int, default=2, help="of today's way in each round (x2: at least 2)")
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--size", type=int, default=224, help="of the pictures of both cameras")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="*", default=[], choices=[*OURS, *TODAY], help="only these variants")
    parser.add_argument("--memory", nargs="*", type=int, default=None, help="lengths of runs, instead of comparing")
    parser.add_argument("--json", type=Path, help="also write the figures here")
    parser.add_argument("--be-today", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--first", type=int, default=0, help=argparse.SUPPRESS)
    parser.add_argument("--streaming", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.be_today:
        be_today(args)
        return
    found = compare(args) if args.memory is None else memory(args)
    if args.json:
        args.json.write_text(json.dumps(found, indent=2))


if __name__ == "__main__":
    main()
