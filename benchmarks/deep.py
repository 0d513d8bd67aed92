"""CPU time of `demorec check --deep` compared with generating and checking, and whether it reports no difference.

    python benchmarks/deep.py --episodes 20

Each episode is generated, checked with its images and made again, one after the other in one warm process, so that the
ratios hold under any load.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

from demorec.check.report import CheckOptions, Subject, check_subject
from demorec.core.config import EpisodePlan, GenerateConfig
from demorec.extensions.remake.deep_check import deep_check
from demorec.loop import ScriptAgent, Session, SimulatorCache, prepare
from demorec.mcap import EpisodeWriter


def generate(path: Path, config: GenerateConfig, index: int, simulators: SimulatorCache) -> None:
    episode = prepare(EpisodePlan(config=config, episode_index=index))
    world, renderer = simulators.acquire(episode.info)
    session = Session.of_episode(world, episode, renderer)
    with EpisodeWriter(path, episode.info, video=config.video) as writer:
        for frame in session.run(ScriptAgent(episode)):
            writer.write(frame)
        writer.finish(session.outcome)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--episodes", type=int, default=10)
    parser.add_argument("--size", type=int, default=224)
    parser.add_argument("--task", default="pick_place")
    arguments = parser.parse_args()
    filmed = GenerateConfig(task=arguments.task, width=arguments.size, height=arguments.size)
    configs = {
        "no cameras": replace(filmed, cameras=()),
        "two cameras": filmed,
        "two cameras, depth, labels": replace(filmed, depth=True, segmentation=True),
    }
    cpu: dict[tuple[str, str], float] = defaultdict(float)
    same = 0
    with tempfile.TemporaryDirectory() as folder:
        for name, config in configs.items():
            makes, checks = (
                SimulatorCache(),
                SimulatorCache(),
            )  # two, as in the processes of generate and check
            for index in range(-1, arguments.episodes):  # the first one warms up
                path = Path(folder) / f"{name}_{index}.mcap"
                starts = [time.process_time()]
                generate(path, config, index + 1, makes)
                starts.append(time.process_time())
                check_subject(Subject(path=path, kind="recording"), CheckOptions())
                starts.append(time.process_time())
                report = deep_check(path, checks)
                starts.append(time.process_time())
                path.unlink()
                if index < 0:
                    continue
                same += report.level == "pass"
                for step, start, end in zip(("generate", "check", "deep"), starts, starts[1:], strict=False):
                    cpu[name, step] += end - start
            makes.close()
            checks.close()
    print(f"{same} of {len(configs) * arguments.episodes} made again are the same to the bit")
    print(f"{'CPU ms an episode':<28} generate    check     deep  deep / generate")
    for name in configs:
        generated, checked, deep = (cpu[name, step] / arguments.episodes for step in ("generate", "check", "deep"))
        print(f"{name:<28} {1e3 * generated:8.0f} {1e3 * checked:8.0f} {1e3 * deep:8.0f} {deep / generated:16.2f}")


if __name__ == "__main__":
    main()
