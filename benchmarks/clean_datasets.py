"""Good datasets, most of them small: how many `demorec check` wrongly reports, with and without the sidecar.

    python benchmarks/clean_datasets.py --datasets 30 --out datasets.jsonl

Task, robot, variation, number of episodes (1 to 12), size, frame rate, codec, kind of action and features are drawn for
each dataset. Small ones tell less of what is usual, so that laws which compare episodes err in them first. What stands
in `--out` is not made again: the same command goes on after `--minutes` or Ctrl-C. LeRobot itself, which
`demorec check` lets open each dataset, is not asked.
"""

from __future__ import annotations

import argparse
import itertools
import json
import random
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from check_limits import RATES, VIDEOS
from dataset_faults import bare, judge

from demorec.check import dataset_files
from demorec.core.tables import ROBOTS, TASKS

SIZES = {(64, 64): 3, (96, 96): 3, (96, 72): 3, (128, 96): 2, (160, 120): 1}
ACTIONS = ("joint", "joint_increment", "ee", "ee_delta")
FEATURES = ("velocity", "effort", "ee_pose")


@dataclass(frozen=True, kw_only=True)
class Row:
    """One dataset; `alarms` are of each check that did not pass: level, name, value, detail; `bare` those without
    sidecar. A dataset whose run failed has an `error`."""

    seed: int
    number: int
    settings: str
    error: str = ""
    alarms: Sequence[Sequence[object]] = ()
    bare: Sequence[Sequence[object]] = ()


def made(folder: Path, seed: int, number: int) -> tuple[str, Path | None, str]:
    """Settings in words, the dataset (None where it could not be made), and why."""
    pairs = [
        (t, r) for r, t in itertools.product(ROBOTS.names(), TASKS.names()) if not TASKS.load(t).refusal(ROBOTS.load(r))
    ]
    random.Random(seed).shuffle(pairs)
    rng = random.Random(f"{seed} {number}")
    task, robot = pairs[number % len(pairs)]
    width, height = rng.choices(list(SIZES), list(SIZES.values()))[0]
    fps, video = rng.choices(list(RATES), list(RATES.values()))[0], rng.choice(VIDEOS)
    flags = {
        "task": task, "robot": robot, "variation": rng.choice(("none", "mild", "full")), "fps": fps,
        "num-episodes": rng.randint(1, 12), "seed": rng.randrange(10**6), "width": width, "height": height,
        "codec": video.codec, "workers": 1,
    }  # fmt: skip
    action = rng.choice(ACTIONS)
    features = [f"observation.{name}" for name in FEATURES if rng.random() < 0.5]
    cameras = [f"observation.images.{name}" for name in ("front", "wrist")]
    run, dataset = folder / "run", folder / "dataset"
    commands = Path(sys.executable).parent
    words = [str(word) for name, value in flags.items() for word in (f"--{name}", value)]
    told = " ".join(f"{value}" for value in flags.values())
    for command in (
        [commands / "generate-dataset", *words, "--cameras", "front", "wrist", "--out", run, "--no-export"],
        [commands / "demorec", "export", "lerobot", run, "--out", dataset, "--action", action, "--no-verify",
         "--features", *features, *cameras],
    ):  # fmt: skip
        done = subprocess.run([str(word) for word in command], capture_output=True, text=True, check=False)
        if done.returncode:
            return told, None, done.stderr[-300:]
    return f"{told} {action} {' '.join(features)}", dataset, ""


def main() -> None:
    """Make what is missing and print all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=2026)
    parser.add_argument("--datasets", type=int, default=30)
    parser.add_argument("--minutes", type=float, default=1e6, help="start none after so long")
    parser.add_argument("--out", type=Path, help="a line of JSON for each; what stands there is not made again")
    options = parser.parse_args()
    rows = [Row(**json.loads(line)) for line in options.out.open()] if options.out and options.out.exists() else []
    known = {(row.seed, row.number) for row in rows}
    end = time.monotonic() + 60 * options.minutes
    vars(dataset_files)["lerobot_is_installed"] = lambda: False
    for number in range(options.datasets):
        if (options.seed, number) in known or time.monotonic() > end:
            continue
        with tempfile.TemporaryDirectory() as folder:
            settings, dataset, error = made(Path(folder), options.seed, number)
            found: list[list[tuple[object, ...]]] = [[], []]
            if dataset is not None:
                for alarms, sidecar in zip(found, (True, False), strict=True):
                    if not sidecar:
                        bare(dataset)
                    alarms += [(r.level, r.check, r.value, r.detail) for r in judge(dataset)]
        row = Row(seed=options.seed, number=number, settings=settings, error=error, alarms=found[0], bare=found[1])
        rows.append(row)
        if row.alarms or row.bare or row.error:
            print(json.dumps(asdict(row)), flush=True)
        if options.out:
            with options.out.open("a") as file:
                file.write(json.dumps(asdict(row)) + "\n")
    good = [row for row in rows if not row.error]
    for words, reports in (("with", [row.alarms for row in good]), ("without", [row.bare for row in good])):
        levels = [{str(alarm[0]) for alarm in report} for report in reports]
        failed, warned = sum("fail" in level for level in levels), sum(level == {"warn"} for level in levels)
        print(f"{words} sidecar: {len(good)} datasets, {warned} warned of, {failed} failed")


if __name__ == "__main__":
    main()
