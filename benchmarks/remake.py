"""CPU time of checking, remaking, replaying and rendering recordings again, and whether all are bit-exact.

    python benchmarks/remake.py --episodes 20

Each episode is generated and then processed in every way, one after the other in one process, so that the ratios hold
under any load. World and renderer are reused from one episode to the next, as in the workers of `generate-dataset`,
`check --deep` and `demorec render`.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

from demorec.check.report import CheckOptions, Subject, check_subject
from demorec.core.config import EpisodePlan, GenerateConfig
from demorec.extensions.remake.deep_check import deep_check
from demorec.extensions.remake.drive import replay_all
from demorec.extensions.remake.options import RerenderOptions
from demorec.extensions.remake.rerender import rerender
from demorec.loop import ScriptAgent, Session, SimulatorCache, prepare
from demorec.mcap import EpisodeWriter, Recording
from demorec.render.painter import WarmRenderer

SMALL = RerenderOptions(cameras=("front",), width=96, height=96)


@dataclass(frozen=True, kw_only=True)
class Warm:
    """What is reused between episodes: generation and remakes run in separate processes."""

    makes: SimulatorCache
    remakes: SimulatorCache
    renderers: WarmRenderer


def steps(path: Path, config: GenerateConfig, index: int, warm: Warm) -> Iterator[tuple[str, bool]]:
    """Yield each step after it was done, and whether its result is as expected."""
    episode = prepare(EpisodePlan(config=config, episode_index=index))
    world, renderer = warm.makes.acquire(episode.info)
    session = Session.of_episode(world, episode, renderer)
    with EpisodeWriter(path, episode.info, video=config.video) as writer:
        for frame in session.run(ScriptAgent(episode)):
            writer.write(frame)
        writer.finish(session.outcome)
    yield "generate", True
    yield "check", check_subject(Subject(path=path, kind="recording"), CheckOptions()).verdict == "good"
    yield "deep", deep_check(path, warm.remakes).level == "pass"
    with Recording(path) as recording:
        (report,) = replay_all([recording])
    yield "replay", report.is_identical
    if config.cameras:
        for name, options in (("render", RerenderOptions()), ("render 96x96", SMALL)):
            drawn = rerender(path, path.with_name("drawn.mcap"), options, renderers=warm.renderers, overwrite=True)
            yield name, not drawn.differing


def measure(name: str, config: GenerateConfig, episodes: int) -> None:
    """Print a row for each step."""
    cpu: dict[str, float] = defaultdict(float)
    good: dict[str, int] = defaultdict(int)
    with (
        tempfile.TemporaryDirectory() as folder,
        closing(SimulatorCache()) as makes,
        closing(SimulatorCache()) as remakes,
        WarmRenderer() as renderers,
    ):
        warm = Warm(makes=makes, remakes=remakes, renderers=renderers)
        for index in range(episodes + 1):  # the first one warms up
            start = time.process_time()
            for step, is_good in steps(Path(folder) / f"{index}.mcap", config, index, warm):
                now = time.process_time()
                if index:
                    cpu[step] += now - start
                    good[step] += is_good
                start = now
    for step, seconds in cpu.items():
        each, ratio = 1e3 * seconds / episodes, seconds / cpu["generate"]
        print(f"{name:<28} {step:<16} {each:17.0f} {ratio:14.2f}  {good[step]} of {episodes}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=10)
    parser.add_argument("--size", type=int, default=224)
    parser.add_argument("--task", default="pick_place")
    arguments = parser.parse_args()
    filmed = GenerateConfig(task=arguments.task, width=arguments.size, height=arguments.size)
    print(f"{'':<28} {'step':<16} CPU ms an episode  of generating  as expected")
    measure("no cameras", replace(filmed, cameras=()), arguments.episodes)
    measure("two cameras", filmed, arguments.episodes)
    measure("two cameras, depth, labels", replace(filmed, depth=True, segmentation=True), arguments.episodes)


if __name__ == "__main__":
    main()
