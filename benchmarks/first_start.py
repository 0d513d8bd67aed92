"""The first start on a machine: CPU time from the start of Python to the first frame, with empty caches.

    python benchmarks/first_start.py --rounds 3
    git worktree add /tmp/before HEAD~1 && python benchmarks/first_start.py --against /tmp/before

A frame is two 224x224 images and all numbers. The versions alternate; each starts with empty caches for compiled code
and meshes, and then once more with the caches of that start.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path

STEPS = ("libraries loaded", "renderer compiled", "first frame")


def tell_steps() -> None:
    """Make one frame and print the CPU seconds of this process after each step."""
    from demorec.core.config import EpisodePlan, GenerateConfig
    from demorec.loop import ScriptAgent, Session, make_world, prepare
    from demorec.render.raster import RasterRenderer

    loaded = time.process_time()
    episode = prepare(EpisodePlan(config=GenerateConfig(), episode_index=0))
    with RasterRenderer() as renderer, make_world(episode.info) as world:
        compiled = time.process_time()
        frame = next(iter(Session.of_episode(world, episode, renderer).run(ScriptAgent(episode))))
        assert set(frame.images) == {"front", "wrist"}
        print(loaded, compiled, time.process_time())


def start(folder: Path, kept: Path) -> list[float]:
    """CPU seconds after each step, of the program in `folder` with caches in `kept`."""
    environment = {**os.environ, "PYTHONPATH": str(folder), "DEMOREC_CACHE": str(kept), "NUMBA_CACHE_DIR": str(kept)}
    command = [sys.executable, __file__, "--child"]
    done = subprocess.run(command, env=environment, cwd=kept, check=True, capture_output=True, text=True)
    return [float(word) for word in done.stdout.split()]


def main() -> None:
    """Start the versions alternately, and print medians."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--against", type=Path, help="a folder with another version of demorec/")
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        tell_steps()
        return
    versions = {"now": Path(__file__).resolve().parents[1]}
    if options.against is not None:
        versions = {"before": options.against.resolve(), **versions}
    seconds: dict[tuple[str, str], list[list[float]]] = defaultdict(list)
    for _ in range(options.rounds):
        for name, folder in versions.items():
            with tempfile.TemporaryDirectory() as kept:
                for which in ("first start", "later start"):
                    seconds[which, name].append(start(folder, Path(kept)))
    print(f"{'CPU s from the start of Python':<44}" + "".join(f"{name:>10}" for name in versions))
    for which in ("first start", "later start"):
        for number, step in enumerate(STEPS):
            told = "".join(
                f"{statistics.median(each[number] for each in seconds[which, name]):10.1f}" for name in versions
            )
            print(f"{f'{which}, {step}':<44}{told}")


if __name__ == "__main__":
    main()
