"""Measures `demorec check` on good recordings: how many it wrongly reports, and the largest value of each check.

    python benchmarks/check_limits.py --episodes 12 --out clean.jsonl    # of each task, robot and variation
    python benchmarks/check_limits.py --episodes 12 --out clean.jsonl --numbers    # others without cameras: far faster
    python benchmarks/check_limits.py --out clean.jsonl --episodes 0 --write    # into demorec/check/limits.toml

Sizes, frame rates, codecs and their quality, cameras, depth and segmentation are drawn for each episode, small images
more often. Episodes that stand in `--out` are not made again: the same command goes on after `--minutes` or Ctrl-C.
Each successful episode that gets a warning or a failure is printed, then a table with a line a cell. `--write` merges
the largest values into the table of limits (the larger one stays; `--anew` forgets what is there), whose limits stay as
they are: those too near are listed.
"""

from __future__ import annotations

import argparse
import datetime
import itertools
import json
import random
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from demorec.check.base import LIMITS, limit_table
from demorec.check.report import CheckOptions, Subject, check_subject
from demorec.core.config import EpisodePlan, GenerateConfig, VideoConfig
from demorec.core.errors import SceneError
from demorec.core.tables import ROBOTS, TASKS
from demorec.loop import ScriptAgent, Session, make_renderer, make_world, prepare
from demorec.mcap import EpisodeWriter
from demorec.replay.deep import deep_check

SIZES = {
    (64, 48): 8, (96, 72): 8, (96, 96): 6, (128, 96): 6, (128, 128): 4, (160, 120): 3, (224, 224): 2, (320, 240): 1,
    (640, 480): 0.4,
}  # fmt: skip
RATES = {10: 6, 12: 2, 15: 3, 20: 4, 24: 1, 30: 4, 48: 1, 60: 1}
VIDEOS = (
    *(VideoConfig(), VideoConfig(), VideoConfig(crf=30), VideoConfig(crf=18), VideoConfig(gop=30)),
    *(VideoConfig(codec="jpeg"), VideoConfig(codec="jpeg", jpeg_quality=60)),
    *(VideoConfig(codec="av1"), VideoConfig(codec="av1", crf=35)),
)
CAMERAS = (("front", "wrist"), ("front", "wrist"), ("front",), ("wrist",), ("top", "wrist"), ("workspace",))
VARIATIONS = ("none", "mild", "full")
Cell = tuple[str, str, str]


@dataclass(frozen=True, kw_only=True)
class Row:
    """One episode.

    Attributes:
        seed, index, numbers: Which one; `numbers` is one without cameras.
        settings: In words.
        success: Whether the task was.
        alarms: Of each check that did not pass: level, name, value, frame, detail.
        values: Check -> what it found.
        deep: Of `check --deep`, "" where that was not run.
    """

    task: str
    robot: str
    variation: str
    seed: int
    index: int
    numbers: bool
    settings: str = ""
    success: bool = False
    alarms: Sequence[Sequence[object]] = ()
    values: Mapping[str, float]
    deep: str = ""

    @property
    def key(self) -> tuple[object, ...]:
        """Which episode it is."""
        return self.task, self.robot, self.variation, self.seed, self.index, self.numbers

    @property
    def level(self) -> str:
        """The worst."""
        levels = {alarm[0] for alarm in self.alarms} | {self.deep}
        return "fail" if "fail" in levels else "warn" if "warn" in levels else "pass"


def drawn_config(cell: Cell, seed: int, index: int, *, numbers: bool) -> GenerateConfig:
    """What is chosen beside task, robot and variation."""
    rng = random.Random(f"{cell} {seed} {index}")
    width, height = rng.choices(list(SIZES), list(SIZES.values()))[0]
    extra = rng.random() < 0.2
    config = GenerateConfig(
        task=cell[0],
        robot=cell[1],
        variation=cell[2],  # type: ignore[arg-type]
        seed=seed,
        fps=rng.choices(list(RATES), list(RATES.values()))[0],
        width=width,
        height=height,
        video=rng.choice(VIDEOS),
        cameras=rng.choice(CAMERAS),
        depth=extra,
        segmentation=extra,
    )
    return replace(config, cameras=(), depth=False, segmentation=False) if numbers else config


def record(config: GenerateConfig, index: int, path: Path) -> bool | None:
    """Make one episode; whether it succeeded, None where the layout does not fit."""
    try:
        episode = prepare(EpisodePlan(config=config, episode_index=index))
    except SceneError:
        return None
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


def measured(config: GenerateConfig, index: int, path: Path, *, deep: bool) -> Row:
    """Make and check one episode."""
    row = Row(
        task=config.task,
        robot=config.robot,
        variation=config.variation,
        seed=config.seed,
        index=index,
        numbers=not config.cameras,
        values={},
    )
    success = record(config, index, path)
    if success is None:
        return row
    video = config.video
    quality = video.jpeg_quality if video.codec == "jpeg" else video.crf
    found = check_subject(Subject(path=path, kind="recording"), CheckOptions()).results
    return replace(
        row,
        settings=f"{config.width}x{config.height} {'+'.join(config.cameras)} {config.fps} fps {video.codec} {quality} "
        f"gop {video.gop}{' depth' * config.depth}",
        success=success,
        alarms=[(r.level, r.check, r.value, r.frame, r.detail) for r in found if r.level in ("warn", "fail")],
        values={r.check: r.value for r in found if r.value is not None},
        deep=deep_check(path).level if deep else "",
    )


def rows_to_make(options: argparse.Namespace, known: set[tuple[object, ...]]) -> Iterator[Row]:
    """Rows of the episodes that are missing, until the time is over."""
    end = time.monotonic() + 60 * options.minutes
    robots = ROBOTS.names() if options.robots == ["all"] else options.robots
    tasks = TASKS.names() if options.tasks == ["all"] else options.tasks
    pairs = [(t, r) for t in tasks for r in robots if not TASKS.load(t).refusal(ROBOTS.load(r))]
    cells = [(task, robot, variation) for (task, robot), variation in itertools.product(pairs, VARIATIONS)]
    with tempfile.TemporaryDirectory() as folder:
        # Cell after cell within each index, so that one can stop at any time.
        for number, (index, cell) in enumerate(itertools.product(range(options.episodes), cells)):
            config = drawn_config(cell, options.seed, index, numbers=options.numbers)
            if (*cell, options.seed, index, options.numbers) not in known and time.monotonic() < end:
                yield measured(config, index, Path(folder) / "episode.mcap", deep=number % options.deep_every == 1)


def table(rows: Sequence[Row]) -> Iterator[str]:
    """A line a cell, and one for all."""
    cells: dict[Cell, list[Row]] = defaultdict(list)
    for row in rows:
        cells[row.task, row.robot, row.variation].append(row)
    yield "| task | robot | variation | episodes | successes | warned of | failed | made again: the same |"
    yield "|---|---|---|---|---|---|---|---|"
    for name, members in [*cells.items(), (("all", "", ""), list(rows))]:
        levels = [row.level for row in members if row.success]
        again = [row.deep for row in members if row.deep]
        made, warned, failed = sum(bool(row.values) for row in members), levels.count("warn"), levels.count("fail")
        yield (
            f"| {' | '.join(name)} | {made} | {len(levels)} | {warned} | {failed} "
            f"| {again.count('pass')} of {len(again)} |"
        )


def write_limits(rows: Sequence[Row], options: argparse.Namespace) -> None:
    """Merge the largest values into the table and list limits that are too near."""
    before = limit_table()
    margin = before["calibration"]["margin"]
    good = [row for row in rows if row.success]
    checks = {}
    for name, limit in before["checks"].items():
        values = [row.values[name] for row in good if name in row.values]
        largest = max([0.0 if options.anew else limit["largest"], *values])
        checks[name] = {**limit, "largest": round(largest, 6)}
        if largest * margin > limit["warn"]:
            print(f"too near: {name} warns above {limit['warn']:g}, the largest value is {largest:g}")
    calibration = {
        "seed": options.seed,
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "episodes": len(good) + (0 if options.anew else before["calibration"]["episodes"]),
        "settings": "all tasks, robots and variations; sizes, rates, codecs and qualities are drawn for each episode",
        "margin": margin,
    }
    LIMITS.write_text(written(calibration, checks))


def written(calibration: Mapping[str, Any], checks: Mapping[str, Mapping[str, float]]) -> str:
    """The table as TOML."""
    lines = [
        "# Written by benchmarks/check_limits.py but for warn and fail, set by hand (demorec/check/base.py).",
        "",
        "[calibration]",
        *(f"{key} = {json.dumps(value)}" for key, value in calibration.items()),
    ]
    for name, limit in checks.items():
        lines += ["", f"[checks.{name}]", *(f"{key} = {value}" for key, value in limit.items())]
    return "\n".join(lines) + "\n"


def main(argv: list[str] | None = None) -> None:
    """Make what is missing, print all, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=2026)
    parser.add_argument("--episodes", type=int, default=1, help="of each cell (task, robot, variation)")
    parser.add_argument("--tasks", nargs="+", default=["all"], help="names, or all")
    parser.add_argument("--robots", nargs="+", default=["all"], help="names, or all")
    parser.add_argument("--numbers", action="store_true", help="no cameras: only what checks see in numbers")
    parser.add_argument("--deep-every", type=int, default=30, help="one of so many is also made again")
    parser.add_argument("--minutes", type=float, default=1e6, help="start no episode after so long")
    parser.add_argument("--out", type=Path, help="a line of JSON for each episode; what stands there is not made again")
    parser.add_argument("--write", action="store_true", help="merge the largest values into the table of limits")
    parser.add_argument("--anew", action="store_true", help="and forget those that are there")
    options = parser.parse_args(argv)
    rows = [Row(**json.loads(line)) for line in options.out.open()] if options.out and options.out.exists() else []
    for row in rows_to_make(options, {row.key for row in rows}):
        rows.append(row)
        if options.out:
            with options.out.open("a") as file:
                file.write(json.dumps(asdict(row)) + "\n")
        if row.level != "pass" and row.success:
            print(json.dumps(asdict(replace(row, values={}))), flush=True)
    print("\n".join(table(rows)))
    if options.write:
        write_limits(rows, options)


if __name__ == "__main__":
    main()
