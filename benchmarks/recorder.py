"""Measure the recorder in real time: dropped frames, the cost of `write`, and the loss in a kill.

    python benchmarks/recorder.py --seconds 60 --hz 100 --cameras 3

A loop provides frames at an exact rate, with 640x480 images that move and have noise like those of cameras. `write` is
measured in wall time and in CPU time of its thread. Then another process does the same and is killed.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from demorec import Recorder
from demorec.core.config import VideoConfig
from demorec.mcap import Recording

HEIGHT, WIDTH = 480, 640
NUM_IMAGES = 64


def images(seed: int) -> list[NDArray[np.uint8]]:
    """Smooth scenes that shift by two pixels each, with sensor noise of two levels."""
    random = np.random.default_rng(seed)
    rows, columns = np.mgrid[0:HEIGHT, 0 : WIDTH + 2 * NUM_IMAGES]
    waves = [np.sin(rows / a + columns / b) for a, b in ((37, 53), (71, 23), (19, 97))]
    scene = np.stack([128 + 90 * wave for wave in waves], axis=-1)
    result = []
    for index in range(NUM_IMAGES):
        noise = random.normal(0, 2, (HEIGHT, WIDTH, 3))
        result.append(np.clip(scene[:, 2 * index :][:, :WIDTH] + noise, 0, 255).astype(np.uint8))
    return result


def loop(folder: Path, args: argparse.Namespace, *, tells: bool) -> tuple[list[float], list[float], int]:
    """Record; return wall and CPU milliseconds of every `write`, and the number of dropped frames."""
    names = [f"camera_{number}" for number in range(args.cameras)]
    seen = {name: images(number) for number, name in enumerate(names)}
    wall, cpu = [], []
    with (
        Recorder(
            folder,
            robot=[f"joint_{n}" for n in range(7)],
            cameras=dict.fromkeys(names, (HEIGHT, WIDTH)),
            fps=args.hz,
            task="measure",
            video=VideoConfig(codec=args.codec, preset=args.preset or None, gop=args.gop),
            when_full="drop",
        ) as recorder,
        recorder.episode() as episode,
    ):
        start = time.monotonic()
        for number in range(round(args.seconds * args.hz)):
            time.sleep(max(0.0, start + number / args.hz - time.monotonic()))
            state = np.full(7, number, dtype=np.float64)
            shown = {name: seen[name][number % NUM_IMAGES] for name in names}
            before_wall, before_cpu = time.perf_counter(), time.thread_time()
            episode.write(state, state, shown)
            cpu.append(1000 * (time.thread_time() - before_cpu))
            wall.append(1000 * (time.perf_counter() - before_wall))
            if tells:
                print(number, flush=True)
        return wall, cpu, episode.drops.get("frames", 0)


def lost_seconds(folder: Path, args: argparse.Namespace) -> float:
    """Seconds between the last frame given before `kill -9` and the last one kept in the file."""
    command = [sys.executable, __file__, "--victim", str(folder), "--hz", str(args.hz), "--cameras", str(args.cameras)]
    command += ["--codec", args.codec, "--preset", args.preset, "--gop", str(args.gop), "--seconds", "60"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as victim:
        assert victim.stdout is not None
        last = 0
        for line in victim.stdout:
            last = int(line)
            if last >= 5 * args.hz:
                os.kill(victim.pid, signal.SIGKILL)
                break
        last = max([last, *map(int, victim.stdout)])
    with Recorder(folder, robot="any", fps=args.hz, task="measure") as recorder:
        (kept,) = recorder.recovered
    with Recording(kept) as recording:
        there = float(recording.table().features["observation.state"][-1, 0])
    return (last - there) / float(args.hz)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60)
    parser.add_argument("--hz", type=int, default=100)
    parser.add_argument("--cameras", type=int, default=3)
    parser.add_argument("--codec", choices=("h264", "av1", "jpeg"), default="h264")
    parser.add_argument("--preset", default="ultrafast")
    parser.add_argument("--gop", type=int, default=2)
    parser.add_argument("--victim", type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.victim is not None:
        loop(args.victim, args, tells=True)
        return
    with tempfile.TemporaryDirectory() as temporary:
        before = os.times()
        wall, cpu, drops = loop(Path(temporary) / "run", args, tells=False)
        after = os.times()
        size = sum(path.stat().st_size for path in (Path(temporary) / "run").rglob("*.mcap"))
        busy = (after.user + after.system - before.user - before.system) / args.seconds
        print(f"{len(wall)} frames at {args.hz} Hz with {args.cameras} cameras {WIDTH}x{HEIGHT}, {args.codec}")
        print(f"dropped        {drops} frames")
        for name, values in (("wall", wall), ("CPU", cpu)):
            middle, high = np.percentile(values, (50, 99))
            print(f"write, {name:4}    first {values[0]:.2f} ms, p50 {middle:.2f} ms, p99 {high:.2f} ms")
        print(f"CPU in all     {busy:.2f} cores")
        print(f"size           {size / 1e6 / args.seconds:.1f} MB/s")
        print(f"kill -9        loses {lost_seconds(Path(temporary) / 'killed', args):.2f} s")


if __name__ == "__main__":
    main()
