"""Cost of playback: an episode to .rrd, and the overhead of `generate-dataset --view`.

    python benchmarks/playback.py recordings/cubes/episodes/episode_000000.mcap
    python benchmarks/playback.py EPISODE --view-episodes 3      (also generates episodes and sends them to a server)

The output has medians of CPU seconds of the processes.
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

from demorec.view.programs import free_port, viewer_environment, viewer_program
from demorec.view.save import save
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


def measure_view(num_episodes: int) -> None:
    """CPU time of the process that sends, compared with that of generating the same episodes."""
    port = free_port()
    server = subprocess.Popen(
        [viewer_program(), "--serve-grpc", "--bind", "127.0.0.1", "--port", str(port)],
        env=viewer_environment(),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    url = f"rerun+http://127.0.0.1:{port}/proxy"
    try:
        with tempfile.TemporaryDirectory() as folder:
            run, warm_up = Path(folder) / "run", Path(folder) / "warm_up"
            generate = [sys.executable, "-c", "from demorec.cli import generate_dataset_main as m; m()"]
            flags = ["--workers", "1", "--no-export"]
            # The first call may compile the renderer; the second costs the start and one episode.
            for _ in range(2):
                shutil.rmtree(warm_up, ignore_errors=True)
                first = _children_cpu([*generate, *flags, "--out", str(warm_up), "--num-episodes", "1"], "")
            number = str(num_episodes)
            generating = _children_cpu([*generate, *flags, "--out", str(run), "--num-episodes", number], "")
            files = sorted(str(path) for path in run.glob("episodes/*.mcap"))
            sender = [sys.executable, "-m", "demorec.view.live", url]
            one = _children_cpu(sender, files[0] + "\n")
            sending = _children_cpu(sender, "".join(f"{file}\n" for file in files))
    finally:
        server.terminate()
        server.wait()
    each, episode = (sending - one) / (len(files) - 1), (generating - first) / (len(files) - 1)
    print(f"generating                     {episode:8.3f} CPU s an episode, {first - episode:.2f} s to start")
    print(f"sending (--view)               {each:8.3f} CPU s an episode, {one - each:.2f} s to start")
    print(f"--view adds at most            {100 * each / episode:8.1f} % when no core is free")


def _children_cpu(command: list[str], text: str) -> float:
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(command, input=text, text=True, check=True, stdout=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--view-episodes", type=int, default=0, help="two or more")
    args = parser.parse_args()
    measure_saving(args.recording, args.rounds)
    if args.view_episodes > 1:
        measure_view(args.view_episodes)


if __name__ == "__main__":
    main()
