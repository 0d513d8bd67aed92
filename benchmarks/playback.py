"""What playback costs: an episode to .rrd as columns and row by row, and what `generate-dataset --view` adds.

    python benchmarks/playback.py recordings/cubes/episodes/episode_000000.mcap
    python benchmarks/playback.py EPISODE --view-episodes 3      (also generates episodes and sends them to a server)

CPU seconds of the process, both ways in turns within one run.
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

import numpy as np
import rerun as rr

from demorec.mcap.transforms import MovingJoints
from demorec.view.bodies import log_robot, robot_model
from demorec.view.episode import PlayedEpisode
from demorec.view.layout import episode_layout
from demorec.view.paths import Paths
from demorec.view.programs import free_port, viewer_environment, viewer_program
from demorec.view.save import save
from demorec.view.scene import log_curves, log_ee_path, log_events, log_phases, new_recording
from demorec.view.sources import find_episodes


def as_columns(episode: PlayedEpisode, target: Path) -> None:
    """The numbers as demorec sends them."""
    stream = new_recording(episode)
    stream.save(target)
    paths = Paths()
    log_robot(stream, paths, episode)
    log_curves(stream, paths, episode)
    log_ee_path(stream, paths, episode)
    log_phases(stream, paths, episode)
    log_events(stream, paths, episode)
    stream.disconnect()


def row_by_row(episode: PlayedEpisode, target: Path) -> None:
    """The same numbers, each at its time."""
    stream = new_recording(episode)
    stream.save(target)
    info, positions = episode.info, episode.joint_position
    assert episode.base_from_tcp is not None
    urdf, _ = robot_model(info.robot.urdf, info.scene.robot.scale, episode.robot_description)
    joints = MovingJoints(urdf, [*positions])
    poses = joints.values(np.array([*positions.values()]).T)
    points = episode.base_from_tcp[:, :3]
    for frame, time_ns in enumerate(episode.time_ns):
        stream.set_time("time", duration=np.timedelta64(int(time_ns), "ns"))
        stream.set_time("frame", sequence=frame)
        for (_, link), pose in zip(joints.moving, poses[frame], strict=True):
            stream.log(f"robot/{link}", rr.Transform3D(translation=pose[:3], quaternion=pose[3:]))
        if frame:
            stream.log("ee_path", rr.LineStrips3D([points[frame - 1 : frame + 1]]))
        stream.log("phase", rr.StateChange(state=episode.phase[frame]))
    stream.reset_time()
    for name, curves in episode.curves.items():
        for time_ns, values in zip(curves.time_ns, curves.values, strict=True):
            stream.set_time("time", duration=np.timedelta64(int(time_ns), "ns"))
            stream.log(Paths().curves(name), rr.Scalars(values))
    stream.disconnect()


def measure_saving(path: Path, rounds: int) -> None:
    (source,) = find_episodes([path])
    columns, rows, whole, wall = [], [], [], []
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "x.rrd"
        save(source, target)  # meshes into the cache, libraries into memory
        with source.open() as episode:
            num_frames, num_samples = episode.num_frames, len(episode.curves["position"].time_ns)
            for _ in range(rounds):
                columns.append(_cpu(lambda: as_columns(episode, target)))
                size = target.stat().st_size
                rows.append(_cpu(lambda: row_by_row(episode, target)))
                row_size = target.stat().st_size
                start = time.perf_counter()
                whole.append(_cpu(lambda: save(source, target)))
                wall.append(time.perf_counter() - start)
            layout = _cpu(lambda: episode_layout(episode))
        total = target.stat().st_size
    median = statistics.median
    print(f"{num_frames} frames, {num_samples} joint samples, {rounds} rounds, median CPU seconds")
    print(f"numbers and robot as columns   {median(columns):8.3f} s  {size / 1e6:6.2f} MB (robot's meshes included)")
    print(f"numbers row by row             {median(rows):8.3f} s  {row_size / 1e6:6.2f} MB (no meshes)")
    print(f"row by row / columns           {median(r / c for r, c in zip(rows, columns, strict=True)):8.1f}")
    print(f"demorec view --save, all of it {median(whole):8.3f} s  {total / 1e6:6.2f} MB, {median(wall):.3f} s wall")
    print(f"layout alone                   {layout:8.3f} s")


def _cpu(work: object) -> float:
    assert callable(work)
    start = time.process_time()
    work()
    return time.process_time() - start


def measure_view(num_episodes: int) -> None:
    """CPU of the process that sends, against that of generating the same episodes."""
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
