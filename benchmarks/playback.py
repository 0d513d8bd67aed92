"""Cost of playback: the median of CPU seconds to convert an episode to .rrd.

python benchmarks/playback.py recordings/cubes/episodes/episode_000000.mcap
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from pathlib import Path

from demorec.view.scene import save
from demorec.view.sources import find_episodes


def measure_saving(path: Path, rounds: int) -> None:
    (source,) = find_episodes([path])
    cpu, wall = [], []
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "x.rrd"
        save(source, target)  # meshes into the cache, libraries into memory
        for _ in range(rounds):
            start, start_cpu = time.perf_counter(), time.process_time()
            save(source, target)
            cpu.append(time.process_time() - start_cpu)
            wall.append(time.perf_counter() - start)
        size = target.stat().st_size
    median = statistics.median
    print(f"demorec view --save            {median(cpu):8.3f} CPU s, {median(wall):.3f} s wall, {size / 1e6:.2f} MB")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--rounds", type=int, default=5)
    args = parser.parse_args()
    measure_saving(args.recording, args.rounds)


if __name__ == "__main__":
    main()
