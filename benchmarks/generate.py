"""Generation from scene to dataset: workers, executors, and the same work done with common tools.

    python benchmarks/generate.py                                   a small sample of everything below `--only`
    python benchmarks/generate.py --episodes 12 --rounds 3 --only "demorec 1 worker" "today default"
    python benchmarks/generate.py --scaling --episodes 12           one worker, two, two of Ray: their overhead
    python benchmarks/generate.py --memory 10 200                   peak memory at two lengths of a run
    python benchmarks/generate.py --driver 1000 100000              run.json at two lengths of a run

"Today" is PyBullet's TinyRenderer and `LeRobotDataset.add_frame` / `save_episode`, with LeRobot's defaults (AV1) and
with streaming encoding; scenes, expert and image sizes are demorec's, so that only the pipeline differs. Each variant
is a separate process and each round runs all of them one after the other; CPU time includes all processes that belong
to a variant, so that ratios hold on a busy machine as well. "All" includes the start-up (imports, compiled code, the
first episode), "steady" is the cost of one more episode.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import psutil

from demorec.core.config import EpisodePlan
from demorec.runs.run_file import Attempt

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
    steady: tuple[float, ...]  # CPU seconds of each episode, measured in its process
    beside: float = 0.0  # CPU seconds an episode outside the workers, once they work


class Meter:
    """CPU seconds and memory of a process and all its descendants, sampled while they live.

    Args:
        pid: Process ID.
        episodes: Folder of finished episodes, whose number separates start-up from work.
    """

    def __init__(self, pid: int, episodes: Path | None = None) -> None:
        self._root = psutil.Process(pid)
        self._episodes = episodes
        self._seen: dict[tuple[int, float], float] = {}
        self._workers: set[tuple[int, float]] = set()
        self._beside: dict[int, float] = {}  # finished episodes -> CPU seconds outside the workers at that moment
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
                    times, key = process.cpu_times(), (process.pid, process.create_time())
                    self._seen[key] = times.user + times.system
                    total += process.memory_info().rss
                    if is_worker(" ".join(process.cmdline())):
                        self._workers.add(key)
                except psutil.Error:
                    continue
            self.peak_bytes = max(self.peak_bytes, total)
            finished = len(list(self._episodes.glob("*"))) if self._episodes is not None else 0
            self._beside.setdefault(finished, sum(s for key, s in self._seen.items() if key not in self._workers))

    def stop(self) -> float:
        """Stop sampling and return the CPU seconds of all processes."""
        self._stop.set()
        self._thread.join()
        return sum(self._seen.values())

    def beside(self) -> float:
        """CPU seconds an episode outside the workers, from the first finished episode to the last."""
        counts = sorted(count for count in self._beside if count)
        if len(counts) < 2:
            return 0.0
        return (self._beside[counts[-1]] - self._beside[counts[0]]) / (counts[-1] - counts[0])


def is_worker(command: str) -> bool:
    """Whether a process of demorec, Python or Ray makes attempts."""
    return "spawn_main" in command or "default_worker.py" in command or command.startswith(("ray::_att", "ray::IDLE"))


def ours(name: str, episodes: int, folder: Path, args: argparse.Namespace) -> list[list[str]]:
    command = [sys.executable, "-c", "from demorec.cli import generate_dataset_main as main; main()"]
    command += ["--out", str(folder), "--num-episodes", str(episodes), "--no-check", "--seed", str(args.seed)]
    command += ["--width", str(args.size), "--height", str(args.size), "--cameras", *args.cameras]
    if args.scaling:
        command.append("--no-export")
    if name == "demorec ray 2":
        return [[*command, "--executor", "ray", "--workers", "2"]]
    return [[*command, "--workers", name.split()[1]]]


def today(name: str, episodes: int, folder: Path, args: argparse.Namespace) -> list[list[str]]:
    """One process a shard; a second process makes the second half."""
    shards = 2 if name.endswith("x2") else 1
    return [
        [sys.executable, __file__, "--be-today", str(folder / f"shard{shard}"), "--first", str(first)]
        + ["--episodes", str(last - first), "--size", str(args.size), "--seed", str(args.seed)]
        + ["--cameras", *args.cameras]
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
        meters = [Meter(process.pid, folder / "episodes") for process in processes]
        errors = [process.communicate()[1] for process in processes]
        wall = time.perf_counter() - start
        cpu = sum(meter.stop() for meter in meters)
        if any(process.returncode for process in processes):
            sys.exit(f"{name} failed:\n{''.join(errors)[-2000:]}")
        made = our_episodes(folder) if name in OURS else todays_episodes(folder)
        return Sample(
            cpu_seconds=cpu,
            wall_seconds=wall,
            episodes=len(made),
            frames=sum(frames for frames, _ in made),
            peak_bytes=sum(meter.peak_bytes for meter in meters),
            steady=tuple(seconds for _, seconds in made),
            beside=meters[0].beside(),
        )


def our_episodes(folder: Path) -> list[tuple[int, float]]:
    """Frames and CPU seconds of each episode, including its share of the export."""
    run = json.loads((folder / "run.json").read_text())
    export = (run["export"] or {}).get("seconds", 0.0) / len(run["episodes"])
    return [(line["num_frames"], line["seconds"] + export) for line in run["episodes"]]


def todays_episodes(folder: Path) -> list[tuple[int, float]]:
    return [(n, seconds) for path in sorted(folder.glob("shard*.json")) for n, seconds in json.loads(path.read_text())]


def be_today(args: argparse.Namespace) -> None:
    """Simulate, draw with TinyRenderer, hand every frame to LeRobot."""
    import numpy as np
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    from demorec.core.config import GenerateConfig
    from demorec.loop import ScriptAgent, Session, SimulatorCache, prepare

    config = GenerateConfig(
        renderer="tiny", width=args.size, height=args.size, seed=args.seed, cameras=tuple(args.cameras)
    )
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
    with SimulatorCache() as simulators:
        world, renderer = simulators.acquire(first.info)
        made = []
        for index in range(args.first, args.first + args.episodes):
            before, num_frames = os.times(), 0
            episode = prepare(EpisodePlan(config=config, episode_index=index))
            session = Session.of_episode(world, episode, renderer)
            for frame in session.run(ScriptAgent(episode)):
                num_frames += 1
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
            if session.outcome is not None and session.outcome.success:
                dataset.save_episode()
            else:
                dataset.clear_episode_buffer()
            # LeRobot's encoders are threads of this process, or children that it waits for.
            made.append((num_frames, sum(os.times()[:4]) - sum(before[:4])))
    dataset.finalize()
    args.be_today.with_suffix(".json").write_text(json.dumps(made))


def compare(args: argparse.Namespace) -> dict[str, Any]:
    everybody = OURS if args.scaling else (*OURS, *TODAY)
    variants = [name for name in everybody if not args.only or name in args.only]
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
        steady = statistics.median(seconds for s in of_name for seconds in s.steady)
        rows[name] = {
            "cpu_s_per_episode": cpu,
            "wall_s_per_episode": wall,
            "peak_mb": max(s.peak_bytes for s in of_name) / 1e6,
            "steady_cpu_s_per_episode": steady,
            "steady_episodes_per_hour_and_core": 3600 / steady,
            "steady_frames_per_s_and_core": sum(s.frames for s in of_name) / sum(s.episodes for s in of_name) / steady,
            "cpu_s_beside_per_episode": statistics.median(s.beside for s in of_name),
        }
    base = rows.get("demorec 1 worker")
    print(f"{'':22}{'steady CPU s/ep':>16}{'ep/h/core':>11}{'frames/s/core':>15}{'ratio':>8}", end="")
    print(f"{'all CPU s/ep':>14}{'ratio':>8}{'wall s/ep':>11}{'MB':>7}")
    for name, row in rows.items():
        of_base = [
            "" if base is None else f"{row[key] / base[key]:.2f}"
            for key in ("steady_cpu_s_per_episode", "cpu_s_per_episode")
        ]
        print(
            f"{name:<22}{row['steady_cpu_s_per_episode']:16.2f}{row['steady_episodes_per_hour_and_core']:11.0f}"
            f"{row['steady_frames_per_s_and_core']:15.1f}{of_base[0]:>8}{row['cpu_s_per_episode']:14.2f}{of_base[1]:>8}"
            f"{row['wall_s_per_episode']:11.2f}{row['peak_mb']:7.0f}",
            flush=True,
        )
    return rows


def scaling(args: argparse.Namespace) -> dict[str, Any]:
    """Cost of an episode in all processes in steady state: the same attempts, and the overhead."""
    rows = compare(args)
    costs = {name: row["steady_cpu_s_per_episode"] + row["cpu_s_beside_per_episode"] for name, row in rows.items()}
    for name, row in rows.items():
        print(
            f"{name:<22}attempts {row['steady_cpu_s_per_episode']:.3f} + overhead {row['cpu_s_beside_per_episode']:.4f}"
            f" = {costs[name]:.3f} CPU s an episode"
        )
    one, two, ray = (costs.get(name) for name in OURS)
    if one and two:
        print(f"parallel efficiency with 2 workers: {one / two:.3f}")
    if two and ray:
        print(f"overhead of Ray against 2 local workers: {100 * (ray / two - 1):.1f} %")
    return rows


def memory(args: argparse.Namespace) -> dict[str, Any]:
    """Peak memory of driver and two workers together, and CPU seconds an episode, for runs of several lengths."""
    rows = {}
    for count in args.memory:
        sample = run_variant("demorec 2 workers", count, args)
        row = {"peak_mb": sample.peak_bytes / 1e6, "cpu_s_per_episode": sum(sample.steady) / count}
        rows[count] = row
        print(
            f"{count:6} episodes: {row['peak_mb']:.0f} MB, CPU s an episode: {row['cpu_s_per_episode']:.3f}", flush=True
        )
    return rows


def make_nothing(plan: EpisodePlan, folder: Path) -> Attempt:
    """A maker that only reports, which leaves the driver's work."""
    index = plan.episode_index
    return Attempt(
        episode_index=index,
        attempt=plan.attempt,
        seed=plan.config.seed,
        success=True,
        file="",
        sha256=f"{index:064x}",
        digest=f"{index:064x}",
        num_frames=219,
        num_bytes=720_000,
        seconds=0.370370367,
    )


def driver(args: argparse.Namespace) -> dict[str, Any]:
    """Cost of an episode in the driver, and of run.json at several lengths of a run."""
    from demorec.core.config import GenerateConfig
    from demorec.generate.options import RunOptions
    from demorec.generate.run import generate
    from demorec.runs.run_file import load_run_file, save_run_file

    config = GenerateConfig(cameras=())
    rows: dict[str, Any] = {}
    with tempfile.TemporaryDirectory(prefix="demorec-bench-") as temporary:
        options = RunOptions(out=Path(temporary) / "run", num_episodes=min(args.driver), workers=2)
        start = time.process_time()
        run = generate(config, options, maker="generate:make_nothing").run
        rows["report_s"] = (time.process_time() - start) / run.num_episodes
        print(
            f"driver: {1000 * rows['report_s']:.2f} ms of CPU an episode, of {run.num_episodes} that cost nothing else"
        )
        for count in args.driver:
            plans = (EpisodePlan(config=config, episode_index=index) for index in range(count))
            attempts = tuple(make_nothing(plan, Path()) for plan in plans)
            run = replace(run, num_episodes=count, attempts=attempts)
            start = time.process_time()
            save_run_file(run, Path(temporary))
            saved = time.process_time()
            load_run_file(Path(temporary))
            rows[str(count)] = {
                "save_s": saved - start,
                "load_s": time.process_time() - saved,
                "run_json_mb": (Path(temporary) / "run.json").stat().st_size / 1e6,
            }
            told = ", ".join(f"{name} {value:.2f}" for name, value in rows[str(count)].items())
            print(
                f"{count:8} episodes: {told}, this process {psutil.Process().memory_info().rss / 1e6:.0f} MB",
                flush=True,
            )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=6, help="episodes of demorec in each round")
    parser.add_argument(
        "--today-episodes", type=int, default=2, help="episodes of common tools in each round (x2: at least 2)"
    )
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--size", type=int, default=224, help="width and height of the images of both cameras")
    parser.add_argument("--cameras", nargs="+", default=["front", "wrist"])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="*", default=[], choices=[*OURS, *TODAY], help="only these variants")
    parser.add_argument("--scaling", action="store_true", help="demorec only, without export: efficiency and overhead")
    parser.add_argument("--memory", nargs="*", type=int, default=None, help="lengths of runs, instead of comparing")
    parser.add_argument("--driver", nargs="*", type=int, default=None, help="lengths of runs, for run.json alone")
    parser.add_argument("--json", type=Path, help="also write the figures here")
    parser.add_argument("--be-today", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--first", type=int, default=0, help=argparse.SUPPRESS)
    parser.add_argument("--streaming", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.be_today:
        be_today(args)
        return
    stages = [(memory, args.memory), (driver, args.driver), (scaling, args.scaling), (compare, True)]
    found = next(stage for stage, asked in stages if asked)(args)
    if args.json:
        args.json.write_text(json.dumps(found, indent=2))


if __name__ == "__main__":
    main()
