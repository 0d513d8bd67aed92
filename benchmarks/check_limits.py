"""Calibrates the limits of `demorec check`: the largest value that each check finds in good recordings.

    python benchmarks/check_limits.py                      # every task, robot and variation once
    python benchmarks/check_limits.py --rounds 5 --anew    # five times, in other sizes, rates and codecs each time
    python benchmarks/check_limits.py --part 2/5           # every fifth setting, from the second on
    python benchmarks/check_limits.py --clean --rounds 2   # how many of other good episodes are told of, no more
    python benchmarks/check_limits.py --numbers            # without cameras, ten times as fast; so with --clean

Settings run over all tasks, robots and variations, and with each through sizes, frame rates, codecs and qualities,
depth and segmentation. Successful episodes only; warnings and failures that they get are listed. What is found is
merged into demorec/check/limits.toml (the larger value stays; `--anew` forgets what is there), whose limits this
program leaves alone: it lists those that are too near. `--clean` measures the checks instead: default coding and rate,
128 and 224 pixels, episodes of another seed; it writes nothing.
"""

from __future__ import annotations

import argparse
import datetime
import itertools
import tempfile
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

from demorec.check.base import Result
from demorec.check.limits import TABLE, LimitCalibration, LimitTable, read_table
from demorec.check.report import CheckOptions, Subject, check_subject
from demorec.core.config import EpisodePlan, GenerateConfig, VideoConfig
from demorec.core.errors import SceneError
from demorec.core.tables import ROBOTS, TASKS
from demorec.loop import ScriptAgent, Session, make_renderer, make_world, prepare
from demorec.mcap import EpisodeWriter

SIZES = ((128, 128), (224, 224), (96, 96), (64, 64), (320, 240), (640, 480))
RATES = (30, 30, 60, 10, 20)
VIDEOS = (
    VideoConfig(),
    VideoConfig(codec="av1"),
    VideoConfig(codec="jpeg"),
    VideoConfig(crf=30),
    VideoConfig(codec="av1", crf=35),
    VideoConfig(gop=30),
    VideoConfig(codec="jpeg", jpeg_quality=60),
)
VARIATIONS = ("none", "mild", "full")


def settings(seed: int, turn: int) -> Iterator[GenerateConfig]:
    """Every task, robot and variation; the lists above turn beside them at rates of their own, from `turn` on."""
    every = itertools.product(VARIATIONS, ROBOTS.names(), TASKS.names())
    for number, (variation, robot, task) in enumerate(every, start=turn):
        width, height = SIZES[number % len(SIZES)]
        extra = number % 4 == 3
        yield GenerateConfig(
            task=task,
            robot=robot,
            variation=variation,  # type: ignore[arg-type]
            seed=seed,
            fps=RATES[number % len(RATES)],
            width=width,
            height=height,
            video=VIDEOS[number % len(VIDEOS)],
            depth=extra,
            segmentation=extra,
        )


def clean_settings(seed: int) -> Iterator[GenerateConfig]:
    """Every task, robot and variation in two sizes, all else as `generate-dataset` has it."""
    for variation, robot, task, size in itertools.product(VARIATIONS, ROBOTS.names(), TASKS.names(), (128, 224)):
        yield GenerateConfig(
            task=task,
            robot=robot,
            variation=variation,  # type: ignore[arg-type]
            seed=seed,
            width=size,
            height=size,
        )


def record(config: GenerateConfig, index: int, path: Path) -> bool:
    """Make one episode; whether it succeeded."""
    try:
        episode = prepare(EpisodePlan(config=config, episode_index=index))
    except SceneError:
        return False
    with (
        make_world(episode.info) as world,
        make_renderer(episode.info) as renderer,
        EpisodeWriter(path, episode.info, video=config.video, overwrite=True) as writer,
    ):
        session = Session.of_episode(world, episode, renderer)
        for frame in session.run(ScriptAgent(episode)):
            writer.write(frame)
        writer.finish(session.outcome)
    return bool(session.outcome.success)


def written(table: LimitTable) -> str:
    """The table as TOML."""
    c = table.calibration
    lines = [
        "# Written by benchmarks/check_limits.py but for the limits, which are set by hand (demorec/check/limits.py).",
        "",
        "[calibration]",
        f"seed = {c.seed}",
        f'date = "{c.date}"',
        f"episodes = {c.episodes}",
        f'settings = "{c.settings}"',
        f"margin = {c.margin}",
    ]
    for name, limit in table.checks.items():
        lines += ["", f"[checks.{name}]", f"warn = {limit.warn}", f"fail = {limit.fail}", f"largest = {limit.largest}"]
    return "\n".join(lines) + "\n"


def main(argv: list[str] | None = None) -> None:
    """Measure, tell, write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seed", type=int, default=2026)
    parser.add_argument("--part", default="1/1", help="K/N: every N-th setting from the K-th on")
    parser.add_argument("--rounds", type=int, default=1, help="over all tasks, robots and variations")
    parser.add_argument("--first", type=int, default=0, help="the first round, which is the index of its episodes")
    parser.add_argument("--anew", action="store_true", help="forget the values in the table")
    parser.add_argument("--numbers", action="store_true", help="no cameras: only what checks see in numbers")
    parser.add_argument("--clean", action="store_true", help="count episodes that are told of; write nothing")
    options = parser.parse_args(argv)
    first, step = (int(word) for word in options.part.split("/"))
    if options.clean:
        found = clean_settings(options.seed + 1)
        if options.numbers:  # another size says nothing of numbers, another rate does
            found = (replace(c, cameras=(), fps=RATES[k % len(RATES)]) for k, c in enumerate(found))
        count_clean(itertools.islice(found, first - 1, None, step), options)
        return
    before = read_table()
    largest = {name: 0.0 if options.anew else limit.largest for name, limit in before.checks.items()}
    count = 0 if options.anew else before.calibration.episodes
    with tempfile.TemporaryDirectory() as folder:
        for index in range(options.first, options.first + options.rounds):
            for config in itertools.islice(settings(options.seed, index), first - 1, None, step):
                config = replace(config, cameras=()) if options.numbers else config
                count += measure(config, index, Path(folder) / "episode.mcap", largest)
                # After each episode, so that one can stop at any time.
                write_table(largest, seed=options.seed, episodes=count)
    print(f"{count} episodes in all; limits that are too near:")
    for name, limit in read_table().checks.items():
        if largest.get(name, 0.0) * before.calibration.margin > limit.warn:
            print(f"  {name}: warns above {limit.warn:g}, the largest value is {largest.get(name, 0.0):g}")


def count_clean(found: Iterator[GenerateConfig], options: argparse.Namespace) -> None:
    """Check good episodes, tell how many of them got a warning or failed."""
    levels: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "episode.mcap"
        for number, config in enumerate(found, start=1):
            for index in range(options.first, options.first + options.rounds):
                if record(config, index, path):
                    said = {result.level for result in results(config, index, path)}
                    levels["fail" if "fail" in said else "warn" if "warn" in said else "pass"] += 1
            if number % 10 == 0:
                print(f"{number} settings: {dict(levels)}")
    print(f"{levels.total()} good episodes: {levels['warn']} with warnings, {levels['fail']} failed")


def write_table(largest: Mapping[str, float], *, seed: int, episodes: int) -> None:
    """The limits as they are now, with what was measured."""
    before = read_table()
    calibration = LimitCalibration(
        seed=seed,
        date=datetime.datetime.now(datetime.UTC).date().isoformat(),
        episodes=episodes,
        settings="rounds over all tasks, robots and variations; sizes, rates, codecs and qualities turn beside them",
        margin=before.calibration.margin,
    )
    checks = {
        name: replace(limit, largest=round(largest.get(name, limit.largest), 6))
        for name, limit in before.checks.items()
    }
    TABLE.write_text(written(LimitTable(calibration=calibration, checks=checks)))


def measure(config: GenerateConfig, index: int, path: Path, largest: dict[str, float]) -> int:
    """Check one good episode, keep the largest values; how many episodes that were (a failed one is none)."""
    if not record(config, index, path):
        return 0
    for result in results(config, index, path):
        if result.check in largest and result.value is not None:
            largest[result.check] = max(largest[result.check], result.value)
    return 1


def results(config: GenerateConfig, index: int, path: Path) -> tuple[Result, ...]:
    """Of all checks of an episode; those that it does not pass are told."""
    said = config.task, config.robot, config.variation, f"{config.width}x{config.height}", f"{config.fps} fps"
    found = check_subject(Subject(path=path, kind="recording"), CheckOptions()).results
    for result in found:
        if result.level in ("warn", "fail"):
            coded = f"{config.video.codec} crf {config.video.crf}"
            print(*said, coded, index, result.level, result.check, result.value, result.frame, result.detail)
    return found


if __name__ == "__main__":
    main()
