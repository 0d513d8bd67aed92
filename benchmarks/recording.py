"""What recording costs: CPU time of an episode by stage, and bytes by codec and GOP.

    python benchmarks/recording.py [--episodes 3] [--size 224] [--renderer raster]

Every stage of every episode is measured in the same run, in CPU time of this process; the recorder's share is what
`EpisodeWriter` takes less its video encoders. Bytes are those of the same episode recorded in several ways, against
raw images and float64 numbers.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from demorec.core.config import EpisodePlan, GenerateConfig, VideoConfig
from demorec.core.geometry import Array
from demorec.episode.episode import CameraImages, Frame, Outcome
from demorec.episode.info import EpisodeInfo
from demorec.loop import ScriptAgent, Session, make_renderer, make_world, prepare
from demorec.mcap import EpisodeWriter, Recording, video
from demorec.render import Renderer, RenderSetup

WAYS = [VideoConfig(codec=codec, gop=gop) for codec in ("h264", "av1") for gop in (2, 10, 30)]


class Clock:
    """CPU seconds by stage; a stage within another counts for the inner one."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._inner = 0.0

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        before, self._inner = self._inner, 0.0
        start = time.process_time()
        try:
            yield
        finally:
            spent = time.process_time() - start
            self.seconds[name] = self.seconds.get(name, 0.0) + spent - self._inner
            self._inner = before + spent

    def add(self, name: str, spent: float) -> None:
        """Count seconds measured within the current stage for another one: quicker than `stage`."""
        self.seconds[name] = self.seconds.get(name, 0.0) + spent
        self._inner += spent


class TimedRenderer:
    def __init__(self, renderer: Renderer, clock: Clock) -> None:
        self._renderer, self._clock = renderer, clock

    def setup(self, setup: RenderSetup) -> None:
        with self._clock.stage("rendering"):
            self._renderer.setup(setup)

    def render(self, poses: Array) -> dict[str, CameraImages]:
        with self._clock.stage("rendering"):
            return self._renderer.render(poses)

    def close(self) -> None:
        pass

    def __enter__(self) -> TimedRenderer:
        return self

    def __exit__(self, *exc: object) -> None:
        pass


def timed_encoders(clock: Clock) -> None:
    """Count the time within the video encoders apart from the rest of the recorder."""
    for kind in (video._StreamEncoder, video._JpegEncoder):
        for name in ("encode", "finish"):
            original = getattr(kind, name)

            def timed(self: object, *args: object, original: object = original) -> object:
                start = time.process_time()
                result = original(self, *args)  # type: ignore[operator]
                clock.add("encoding", time.process_time() - start)
                return result

            setattr(kind, name, timed)


def measure(
    plan: EpisodePlan, folder: Path, clock: Clock, kept: list[Frame] | None = None
) -> tuple[EpisodeInfo, Outcome]:
    """Simulate, draw and record one episode; its frames are kept in `kept` where that is given."""
    episode = prepare(plan)
    with make_world(episode.info) as world, make_renderer(episode.info) as renderer:
        session = Session.of_episode(world, episode, TimedRenderer(renderer, clock) if renderer else None)
        path = folder / f"{plan.episode_index}.mcap"
        with EpisodeWriter(path, episode.info, video=plan.config.video) as writer:
            iterator = session.run(ScriptAgent(episode))
            while True:
                with clock.stage("simulation"):
                    frame = next(iterator, None)
                if frame is None:
                    break
                with clock.stage("recorder"):
                    writer.write(frame)
                if kept is not None:
                    kept.append(frame)
            with clock.stage("recorder"):
                writer.finish(session.outcome)
    return episode.info, session.outcome


def raw_bytes(frames: list[Frame]) -> int:
    """Images as RGB, numbers as float64."""
    images = sum(image.color.nbytes for frame in frames for image in frame.images.values())
    observation = frames[0].observation
    numbers = 3 * len(observation.joint_position) + 2 + 6 + 7 + 7 * len(observation.object_poses)
    numbers += 2 * (len(frames[0].action.joint_target) + 1 + 7) + 7 * len(frames[0].images)
    return images + 8 * numbers * len(frames)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=3)
    parser.add_argument("--size", type=int, default=224)
    parser.add_argument("--renderer", default=GenerateConfig().renderer)
    parser.add_argument("--cameras", nargs="*", default=["front", "wrist"])
    args = parser.parse_args()
    config = GenerateConfig(
        renderer=args.renderer, width=args.size, height=args.size, cameras=tuple(args.cameras) or ("none",)
    )
    clock = Clock()
    timed_encoders(clock)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "again").mkdir()
        measure(EpisodePlan(config=config, episode_index=args.episodes), folder, Clock())  # loads and compiles
        clock.seconds.clear()
        num_frames = 0
        for index in range(args.episodes):
            info, outcome = measure(EpisodePlan(config=config, episode_index=index), folder, clock)
            num_frames += outcome.num_frames
        total = sum(clock.seconds.values())
        print(
            f"{args.episodes} episodes, {num_frames} frames, {len(info.scene.cameras)} cameras "
            f"{args.size}x{args.size}, renderer {args.renderer}"
        )
        for stage, seconds in clock.seconds.items():
            print(f"{stage:<11} {seconds / num_frames * 1e3:7.3f} ms CPU a frame  {seconds / total:6.1%}")
        besides = total - clock.seconds.get("encoding", 0.0)
        recorder = clock.seconds["recorder"]
        print(f"recorder besides encoding: {recorder / total:.1%} of all, {recorder / besides:.1%} of all but encoding")
        print()
        frames: list[Frame] = []
        again = EpisodePlan(config=config, episode_index=args.episodes - 1)
        info, outcome = measure(again, folder / "again", Clock(), frames)
        raw = raw_bytes(frames)
        images = sum(image.color.nbytes for frame in frames for image in frame.images.values())
        numbers = (raw - images) / 1e3
        print(f"one episode of {len(frames)} frames: {raw / 1e6:.1f} MB raw, {numbers:.0f} kB of it numbers")
        print(f"{'coding':<14}{'file kB':>9}{'video kB':>10}{'raw / file':>12}{'encoding ms/image':>21}{'PSNR dB':>9}")
        for way in [*WAYS, VideoConfig(codec="jpeg")] if frames[0].images else [VideoConfig()]:
            clock.seconds.clear()
            with EpisodeWriter(folder / f"{way.codec}-{way.gop}.mcap", info, video=way) as writer:
                for frame in frames:
                    writer.write(frame)
                path = writer.finish(outcome)
            num_bytes = path.stat().st_size
            with Recording(path) as recording:
                video_bytes = sum(len(packet.data) for name in recording.cameras for packet in recording.packets(name))
            count = max(1, len(frames) * len(frames[0].images))
            label = "jpeg q90" if way.codec == "jpeg" else f"{way.codec} GOP {way.gop}"
            encoding = clock.seconds.get("encoding", 0.0) / count * 1e3
            print(
                f"{label:<14}{num_bytes / 1e3:>9.0f}{video_bytes / 1e3:>10.0f}"
                f"{raw / num_bytes:>11.0f}x{encoding:>21.2f}{psnr(path, frames):>9.1f}"
            )


def psnr(path: Path, frames: list[Frame]) -> float:
    """Of the decoded images, all cameras together."""
    errors = []
    with Recording(path) as recording:
        for camera in recording.cameras:
            for frame, image in zip(frames, recording.images(camera), strict=True):
                errors.append(np.mean((image.astype(np.float64) - frame.images[camera].color) ** 2))
    return float(10 * np.log10(255**2 / np.mean(errors))) if errors else float("nan")


if __name__ == "__main__":
    main()
