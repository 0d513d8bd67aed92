"""Speed of replaying, checking and rerendering recordings, and whether the replays are bit-exact.

    python benchmarks/replay.py --episodes 100 --images 2

Figures are CPU seconds of this process. Ratios are taken within one interleaved run: each episode is generated,
checked, replayed and (the first few) rerendered, one after the other. World and renderer are reused from one episode to
the next, as in the workers of `generate-dataset` and `demorec render`; "as it was" makes a new renderer for each
rerendered recording.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections import defaultdict
from contextlib import ExitStack
from pathlib import Path

from demorec.check.report import CheckOptions, Subject, check_subject
from demorec.core.config import EpisodePlan, GenerateConfig
from demorec.extensions.remake.demonstration import open_file
from demorec.extensions.remake.drive import replay_all
from demorec.extensions.remake.options import RerenderOptions
from demorec.extensions.remake.rerender import rerender
from demorec.loop import ScriptAgent, Session, SimulatorCache, prepare
from demorec.mcap import EpisodeWriter, Recording
from demorec.render.painter import WarmRenderer


def generate(path: Path, config: GenerateConfig, index: int, simulators: SimulatorCache) -> None:
    episode = prepare(EpisodePlan(config=config, episode_index=index))
    world, renderer = simulators.acquire(episode.info)
    with EpisodeWriter(path, episode.info, video=config.video) as writer:
        session = Session.of_episode(world, episode, renderer)
        for frame in session.run(ScriptAgent(episode)):
            writer.write(frame)
        writer.finish(session.outcome)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--episodes", type=int, default=10, help="without images, replayed and checked")
    parser.add_argument("--images", type=int, default=1, help="with two cameras, rerendered and checked")
    parser.add_argument("--size", type=int, default=224)
    parser.add_argument("--task", default="pick_place")
    arguments = parser.parse_args()
    cpu: dict[str, float] = defaultdict(float)
    identical = same_pictures = 0
    stack = ExitStack()
    simulators, warm = SimulatorCache(), WarmRenderer()
    stack.callback(simulators.close)
    stack.callback(warm.close)
    simulated = filmed = 0.0

    def timed(name: str, start: float) -> None:
        cpu[name] += time.process_time() - start

    with stack, tempfile.TemporaryDirectory() as folder:
        plain = GenerateConfig(task=arguments.task, cameras=())
        generate(Path(folder) / "warm.mcap", plain, 10_000, simulators)  # compiles functions
        for index in range(arguments.episodes):
            path = Path(folder) / f"{index}.mcap"
            start = time.process_time()
            generate(path, plain, index, simulators)
            timed("generate", start)
            start = time.process_time()
            report = check_subject(Subject(path=path, kind="recording"), CheckOptions(images=False))
            timed("check", start)
            assert report.verdict == "good", report
            start = time.process_time()
            [replayed] = replay_all([open_file(path)])
            timed("replay", start)
            identical += replayed.is_identical
            with Recording(path) as recording:
                simulated += recording.num_frames / recording.info.fps
        config = GenerateConfig(
            task=arguments.task, cameras=("front", "wrist"), width=arguments.size, height=arguments.size
        )
        if arguments.images:
            warming = Path(folder) / "warm_images.mcap"
            generate(warming, config, 10_000, simulators)
            rerender(warming, Path(folder) / "warm_again.mcap", RerenderOptions(), renderers=warm)
        for index in range(arguments.images):
            path = Path(folder) / f"filmed_{index}.mcap"
            start = time.process_time()
            generate(path, config, index, simulators)
            timed("generate with images", start)
            start = time.process_time()
            rerender(path, Path(folder) / f"as_it_was_{index}.mcap", RerenderOptions())
            timed("rerender, as it was", start)
            start = time.process_time()
            drawn = rerender(path, Path(folder) / f"again_{index}.mcap", RerenderOptions(), renderers=warm)
            timed("rerender", start)
            same_pictures += not drawn.differing
            start = time.process_time()
            small = RerenderOptions(cameras=("front",), width=96, height=96)
            rerender(path, Path(folder) / f"small_{index}.mcap", small, renderers=warm)
            timed("rerender one camera, 96x96", start)
            for images in (False, True):
                start = time.process_time()
                check_subject(Subject(path=path, kind="recording"), CheckOptions(images=images))
                timed("check with images" if images else "check, not decoding", start)
            with Recording(path) as recording:
                filmed += recording.num_frames / recording.info.fps
    count = arguments.episodes
    print(f"{identical} of {count} replays identical to the bit, {same_pictures} of {arguments.images} drawings")
    for name, seconds in cpu.items():
        of_images = name not in ("generate", "check", "replay")
        number, length = (arguments.images, filmed) if of_images else (count, simulated)
        print(f"{name:<26} {1e3 * seconds / number:8.1f} CPU ms an episode, {length / seconds:8.1f} times real time")
    if arguments.images:
        generation = cpu["generate with images"]
        was, now = generation / cpu["rerender, as it was"], generation / cpu["rerender"]
        print(f"generate / rerender: as it was {was:.2f}, {now:.2f} now")


if __name__ == "__main__":
    main()
