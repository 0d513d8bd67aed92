"""Cost of encoding: bytes, CPU time and quality of one episode by codec and GOP.

    python benchmarks/recording.py [--size 224] [--renderer raster]

Bytes are compared with raw images and float64 numbers. The summary of `generate-dataset` has the CPU time by stage.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np

from demorec.core.config import EpisodePlan, GenerateConfig, VideoConfig
from demorec.episode.episode import Frame, Outcome
from demorec.episode.info import EpisodeInfo
from demorec.loop import ScriptAgent, Session, SimulatorCache, prepare
from demorec.mcap import EpisodeWriter, Recording
from demorec.mcap.video import make_encoder

STREAMS = [VideoConfig(codec=codec, gop=gop) for codec in ("h264", "av1") for gop in (2, 10, 30)]
WAYS = [*STREAMS, VideoConfig(codec="jpeg")]


def simulate(config: GenerateConfig) -> tuple[EpisodeInfo, list[Frame], Outcome]:
    episode = prepare(EpisodePlan(config=config, episode_index=0))
    with SimulatorCache() as simulators:
        world, renderer = simulators.acquire(episode.info)
        session = Session.of_episode(world, episode, renderer)
        return episode.info, list(session.run(ScriptAgent(episode))), session.outcome


def raw_bytes(frames: list[Frame]) -> int:
    """Size of images as RGB, and of numbers as float64."""
    images = sum(image.color.nbytes for frame in frames for image in frame.images.values())
    observation = frames[0].observation
    numbers = 3 * len(observation.joint_position) + 2 + 6 + 7 + 7 * len(observation.object_poses)
    numbers += 2 * (len(frames[0].action.joint_target) + 1 + 7) + 7 * len(frames[0].images)
    return images + 8 * numbers * len(frames)


def encoding_ms(video: VideoConfig, info: EpisodeInfo, frames: list[Frame]) -> float:
    """CPU time of an image."""
    start = time.process_time()
    for camera in info.cameras:
        encoder = make_encoder(video, camera.width, camera.height, info.fps)
        for frame in frames:
            encoder.encode(frame.images[camera.name].color)
        encoder.finish()
    return 1000 * (time.process_time() - start) / (len(frames) * len(info.cameras))


def psnr(recording: Recording, frames: list[Frame]) -> float:
    """PSNR of the decoded images of all cameras together, dB."""
    errors = [
        np.mean((image.astype(np.float64) - frame.images[camera].color) ** 2)
        for camera in recording.cameras
        for frame, image in zip(frames, recording.images(camera), strict=True)
    ]
    return float(10 * np.log10(255**2 / np.mean(errors)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=224)
    parser.add_argument("--renderer", default=GenerateConfig().renderer)
    args = parser.parse_args()
    config = GenerateConfig(renderer=args.renderer, width=args.size, height=args.size, cameras=("front", "wrist"))
    info, frames, outcome = simulate(config)
    raw = raw_bytes(frames)
    print(f"one episode of {len(frames)} frames, two cameras {args.size}x{args.size}: {raw / 1e6:.1f} MB raw")
    print(f"{'coding':<14}{'file kB':>9}{'raw / file':>12}{'encoding ms/image':>21}{'PSNR dB':>9}")
    with tempfile.TemporaryDirectory() as folder:
        for way in WAYS:
            with EpisodeWriter(Path(folder) / f"{way.codec}-{way.gop}.mcap", info, video=way) as writer:
                for frame in frames:
                    writer.write(frame)
                path = writer.finish(outcome)
            label = "jpeg q90" if way.codec == "jpeg" else f"{way.codec} GOP {way.gop}"
            num_bytes, encoding = path.stat().st_size, encoding_ms(way, info, frames)
            with Recording(path) as recording:
                quality = psnr(recording, frames)
            print(f"{label:<14}{num_bytes / 1e3:>9.0f}{raw / num_bytes:>11.0f}x{encoding:>21.2f}{quality:>9.1f}")


if __name__ == "__main__":
    main()
