"""Exports compared with LeRobot's own writers, their growth and memory, and their speed compared with cp and checksums.

    python benchmarks/export.py                          a small sample
    python benchmarks/export.py --episodes 4 --frames 90 --rounds 3 --growth 10 100 1000

Every round runs all candidates one after the other on the same frames; CPU time includes all processes and threads, so
that the figures can be compared on a shared machine. The comparison covers the time that a user waits after recording:
images in recordings are encoded already, so the cost of recording them is listed separately.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import zstandard
from mcap.records import Chunk
from mcap.stream_reader import StreamReader
from numpy.typing import NDArray

from demorec.datasets.lerobot.export import export_lerobot
from demorec.datasets.lerobot.options import ExportOptions
from demorec.episode.episode import Frame, Outcome
from demorec.episode.info import EpisodeInfo
from demorec.episode.simulated import with_simulation
from demorec.mcap import EpisodeWriter

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))

CAMERAS = {"front": (640, 480), "wrist": (224, 224), "side": (224, 224)}
"""Cameras of the comparison, with their sizes."""

Images = dict[str, list[NDArray[np.uint8]]]


@dataclass(kw_only=True)
class Cost:
    """CPU and wall seconds of every round."""

    cpu: list[float] = field(default_factory=list)
    wall: list[float] = field(default_factory=list)

    def __str__(self) -> str:
        return f"{1e3 * statistics.median(self.cpu):9.3f} {1e3 * statistics.median(self.wall):9.3f}"


def cpu_seconds() -> float:
    return sum(
        usage.ru_utime + usage.ru_stime
        for usage in (resource.getrusage(resource.RUSAGE_SELF), resource.getrusage(resource.RUSAGE_CHILDREN))
    )


@contextmanager
def measured(cost: Cost, per: float) -> Iterator[None]:
    cpu, wall = cpu_seconds(), time.perf_counter()
    yield
    cost.cpu.append((cpu_seconds() - cpu) / per)
    cost.wall.append((time.perf_counter() - wall) / per)


def scene_images(frames: int, width: int, height: int, seed: int) -> list[NDArray[np.uint8]]:
    """Images as expensive to encode as rendered ones: shaded surfaces, edges, a moving arm, a little noise."""
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[0:height, 0:width].astype(np.float32) / np.float32(height)
    table = np.stack([170 + 40 * columns, 140 + 30 * rows, 100 + 20 * columns], axis=-1)
    grain = rng.normal(0, 1, (height, width, 1))
    result = []
    for t in range(frames):
        image = table + grain
        x, y = 0.3 + 0.4 * t / frames, 0.5 + 0.2 * np.sin(t / 15)
        for k in range(6):
            near = (columns - x - 0.05 * k) ** 2 + (rows - y + 0.08 * k) ** 2 < (0.07 - 0.005 * k) ** 2
            image[near] = (60 + 25 * k, 70 + 10 * k, 200 - 20 * k)
        result.append(np.clip(image, 0, 255).astype(np.uint8))
    return result


def made_up(images: Images, episode: int) -> tuple[EpisodeInfo, list[Frame], Outcome]:
    """An episode of synthetic numbers and the given images."""
    from support.recording import make_episode

    length = len(next(iter(images.values())))
    info, frames, outcome = make_episode(
        num_frames=length, cameras=tuple(images), width=16, height=16, episode_index=episode
    )
    cameras = tuple(
        replace(camera, height=images[camera.name][0].shape[0], width=images[camera.name][0].shape[1])
        for camera in info.simulated.scene.cameras
    )
    frames = [
        replace(frame, images={name: replace(frame.images[name], color=images[name][t]) for name in images})
        for t, frame in enumerate(frames)
    ]
    return with_simulation(info, scene=replace(info.simulated.scene, cameras=cameras)), frames, outcome


def record(path: Path, episode: tuple[EpisodeInfo, list[Frame], Outcome]) -> None:
    info, frames, outcome = episode
    with EpisodeWriter(path, info) as writer:
        for frame in frames:
            writer.write(frame)
        writer.finish(outcome)


def compare(args: argparse.Namespace, work: Path) -> dict[str, Any]:
    """CPU and wall ms a frame: this export, LeRobot's default writer, its streaming writers."""
    from lerobot.configs.video import RGBEncoderConfig
    from lerobot.datasets import LeRobotDataset

    images: list[Images] = [
        {name: scene_images(args.frames, *size, seed=7 * e + n) for n, (name, size) in enumerate(CAMERAS.items())}
        for e in range(args.episodes)
    ]
    episodes = [made_up(found, e) for e, found in enumerate(images)]
    costs = {
        name: Cost() for name in ("record", "export", "lerobot", "lerobot_streaming_av1", "lerobot_streaming_h264")
    }
    total = args.episodes * args.frames
    h264 = RGBEncoderConfig(vcodec="h264", crf=23, preset="veryfast")

    def lerobot(name: str, folder: Path, **options: Any) -> None:
        features: dict[str, Any] = {
            "observation.state": {"dtype": "float32", "shape": (8,), "names": None},
            "action": {"dtype": "float32", "shape": (8,), "names": None},
        }
        for key, (width, height) in CAMERAS.items():
            features[f"observation.images.{key}"] = {
                "dtype": "video", "shape": (height, width, 3), "names": ["height", "width", "channels"]
            }  # fmt: skip
        with measured(costs[name], total):
            dataset = LeRobotDataset.create("local/bench", 30, features, root=folder, **options)
            for episode in images:
                for t in range(args.frames):
                    vector = np.full(8, t, dtype=np.float32)
                    frame: dict[str, Any] = {"observation.state": vector, "action": vector, "task": "task"}
                    frame |= {f"observation.images.{key}": episode[key][t] for key in CAMERAS}
                    dataset.add_frame(frame)
                dataset.save_episode()
            dataset.finalize()

    for number in range(args.rounds):
        folder = work / f"round{number}"
        run = folder / "run"
        run.mkdir(parents=True)
        if number == 0:  # loads libraries
            record(folder / "warm.mcap", episodes[0])
            export_lerobot([folder / "warm.mcap"], folder / "warm", ExportOptions(verify=False))
        with measured(costs["record"], total):
            for e, recorded in enumerate(episodes):
                record(run / f"episode_{e:06d}.mcap", recorded)
        for copy in range(1, args.repeat):
            for e in range(args.episodes):
                index = copy * args.episodes + e
                shutil.copy(run / f"episode_{e:06d}.mcap", run / f"episode_{index:06d}.mcap")
        with measured(costs["export"], total * args.repeat):
            export_lerobot([run], folder / "ours", ExportOptions(verify=False, workers=1))
        lerobot("lerobot", folder / "default")
        lerobot("lerobot_streaming_av1", folder / "streaming", streaming_encoding=True, encoder_queue_maxsize=10_000)
        lerobot(
            "lerobot_streaming_h264", folder / "streaming264",
            streaming_encoding=True, encoder_queue_maxsize=10_000, rgb_encoder=h264,
        )  # fmt: skip
        shutil.rmtree(folder)
    ours = statistics.median(costs["export"].cpu)
    print(f"\n{args.episodes} episodes of {args.frames} frames, cameras {CAMERAS}, {args.rounds} rounds")
    print(f"(demorec's export gets them {args.repeat} times, to make its fixed cost negligible)")
    print(f"{'ms a frame':28} {'CPU':>9} {'wall':>9}   CPU / demorec")
    for name, cost in costs.items():
        print(f"{name:28} {cost} {statistics.median(cost.cpu) / ours:10.1f}x")
    return {
        name: {"cpu_ms": 1e3 * statistics.median(c.cpu), "wall_ms": 1e3 * statistics.median(c.wall)}
        for name, c in costs.items()
    }


def growth(args: argparse.Namespace, work: Path) -> list[dict[str, float]]:
    """Cost an episode and peak memory of exports with increasing numbers of episodes, each in a separate process."""
    from support.recording import write_episode

    run = work / "growth" / "episodes"
    run.mkdir(parents=True)
    write_episode(run / "episode_000000.mcap", num_frames=args.growth_frames)
    for index in range(1, max(args.growth)):
        shutil.copy(run / "episode_000000.mcap", run / f"episode_{index:06d}.mcap")
    program = (
        "import resource, sys, time\n"
        "from pathlib import Path\n"
        "from demorec.datasets.lerobot.export import export_lerobot\n"
        "from demorec.datasets.lerobot.options import ExportOptions\n"
        "files = sorted(Path(sys.argv[1]).glob('*.mcap'))[: int(sys.argv[2])]\n"
        "export_lerobot(files[:1], Path(sys.argv[3] + '.warm'), ExportOptions(verify=False))\n"
        "cpu = time.process_time()\n"
        "export_lerobot(files, Path(sys.argv[3]), ExportOptions(verify=False, workers=1))\n"
        "print(time.process_time() - cpu, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)\n"
    )
    print(f"\nGrowth, episodes of {args.growth_frames} frames, 2 cameras of 64x48")
    print(f"{'episodes':>9} {'CPU ms an episode':>18} {'peak MiB':>9}")
    rows = []
    for count in args.growth:
        out = work / f"growth{count}"
        done = subprocess.run(
            [sys.executable, "-c", program, str(run), str(count), str(out)], check=True, capture_output=True, text=True
        )
        cpu, memory = (float(text) for text in done.stdout.split())
        shutil.rmtree(out)
        rows.append({"episodes": count, "cpu_ms_an_episode": 1e3 * cpu / count, "peak_mib": memory})
        print(f"{count:9d} {1e3 * cpu / count:18.2f} {memory:9.1f}")
    return rows


def bytes_alone(run: Path) -> None:
    """Only unpack each chunk, and compute its CRC-32 and SHA-256."""
    for path in sorted(run.iterdir()):
        with path.open("rb") as file:
            for record in StreamReader(file, emit_chunks=True).records:
                if isinstance(record, Chunk):
                    content = zstandard.ZstdDecompressor().decompress(record.data, record.uncompressed_size)
                    assert zlib.crc32(content) == record.uncompressed_crc
                    hashlib.sha256(content).digest()


def against_copy(args: argparse.Namespace, work: Path) -> dict[str, float]:
    """MB of recordings a second, exported and copied by cp, at 640x480; and CPU time relative to `bytes_alone`."""
    run = work / "copy" / "episodes"
    run.mkdir(parents=True)
    names = ("front", "wrist")
    images = {name: scene_images(args.frames, 640, 480, seed=n) for n, name in enumerate(names)}
    record(run / "episode_000000.mcap", made_up(images, 0))
    for index in range(1, args.copy_episodes):
        shutil.copy(run / "episode_000000.mcap", run / f"episode_{index:06d}.mcap")
    size = sum(path.stat().st_size for path in run.iterdir()) / 1e6
    ways: dict[str, Callable[[Path], object]] = {
        "export": lambda out: export_lerobot([run], out, ExportOptions(verify=False, workers=1)),
        "CRC-32, SHA-256, Zstandard": lambda _: bytes_alone(run),
        "cp": lambda out: subprocess.run(["cp", "-r", run, out], check=True),
        "cp, then sync": lambda out: subprocess.run(["sh", "-c", f"cp -r {run} {out} && sync -f {out}/*"], check=True),
    }
    costs = {name: Cost() for name in ways}
    for number in range(args.rounds + 1):
        for name, way in ways.items():
            out = work / "copied"
            with measured(costs[name] if number else Cost(), 1):
                way(out)
            shutil.rmtree(out, ignore_errors=True)  # `bytes_alone` writes none
    print(f"\nSpeed at 640x480, {size:.0f} MB in {args.copy_episodes} recordings")
    print(f"{'':26} {'MB/s':>9} {'CPU s':>9}")
    result = {}
    for name, cost in costs.items():
        result[name] = size / statistics.median(cost.wall)
        print(f"{name:26} {result[name]:9.0f} {statistics.median(cost.cpu):9.3f}")
    shares = zip(costs["export"].cpu, costs["CRC-32, SHA-256, Zstandard"].cpu, strict=True)
    result["export / bytes alone"] = statistics.median(export / alone for export, alone in shares)
    print(f"CPU time of the export against that of the bytes alone: {result['export / bytes alone']:.2f}")
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--episodes", type=int, default=2)
    parser.add_argument("--frames", type=int, default=45)
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument(
        "--repeat", type=int, default=20, help="number of copies of the recordings that demorec's export gets"
    )
    parser.add_argument("--growth", type=int, nargs="*", default=[10, 100])
    parser.add_argument("--growth-frames", type=int, default=12)
    parser.add_argument("--copy-episodes", type=int, default=20)
    parser.add_argument("--skip", nargs="*", default=[], choices=["compare", "growth", "copy"])
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    os.environ.setdefault("HF_HUB_OFFLINE", "1")
    results: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        os.environ["HF_DATASETS_CACHE"] = str(work / "hf")
        if "growth" not in args.skip and args.growth:
            results["growth"] = growth(args, work)
        if "copy" not in args.skip:
            results["copy"] = against_copy(args, work)
        if "compare" not in args.skip:
            results["compare"] = compare(args, work)
    if args.json:
        args.json.write_text(json.dumps(results, indent=2) + "\n")


if __name__ == "__main__":
    main()
