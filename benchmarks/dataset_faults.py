"""What share of faults in LeRobot datasets `demorec check` finds, with and without the sidecar.

    python benchmarks/dataset_faults.py                    # the faults that are not found, and all shares
    python benchmarks/dataset_faults.py --half looked      # only the half that was looked at when laws were written
    python benchmarks/dataset_faults.py --all              # every fault, with the checks that find it

Datasets of three arms and kinds of action are spoilt on disk, one fault at a time (`dataset_row_faults.py`,
`dataset_file_faults.py`), in turns.
Statistics follow the numbers and images, as they do when a converter has the fault. Every second fault belongs to the
half that was only measured (`held`). Without the sidecar the columns that only demorec writes into `meta/episodes` are
gone, too. LeRobot itself, which `demorec check` lets open each dataset, is not asked.
"""

from __future__ import annotations

import argparse
import hashlib
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path

import pyarrow.parquet as pq
from dataset_file_faults import FILES, LANGUAGE, META, SIDECAR
from dataset_row_faults import NUMBERS, ROWS, VIDEOS
from support.dataset_edits import Fault

from demorec.check import dataset_files
from demorec.check.base import Result
from demorec.check.report import CheckOptions, Subject, check_subject

FAULTS: list[tuple[str, str, Fault]] = [
    (kind, name, fault)
    for kind, faults in {
        "numbers": NUMBERS, "rows": ROWS, "meta": META, "files": FILES, "videos": VIDEOS, "language": LANGUAGE,
        "sidecar": SIDECAR,
    }.items()
    for name, fault in faults
]  # fmt: skip
"""Kind, name and fault; those of the sidecar tell nothing where there is none."""

BASES = {
    "joint_increment": (("pick_place", "panda", "mild", 30, 3), ("stack", "panda", "mild", 30, 3)),
    "ee_delta": (("sort_by_color", "iiwa", "full", 20, 4),),
    "joint": (("pick_place", "so101", "mild", 10, 3), ("place_in_tray", "so101", "mild", 10, 2)),
}
"""Kind of action -> the runs of its dataset: task, robot, variation, frames a second, episodes."""
_FEATURES = ("observation.velocity", "observation.effort", "observation.ee_pose", "observation.images.front",
             "observation.images.wrist", "next.reward", "next.done", "next.success")  # fmt: skip
_LEROBOT = ("episode_index", "length", "tasks", "dataset_", "data/", "videos/", "meta/", "stats/")
LEVELS = ("fail", "warn", "-")


def make(folder: Path, action: str) -> Path:
    """A dataset of a kind of action, made once."""
    out = folder / action
    if out.exists():
        return out
    command, runs = Path(sys.executable), []
    for number, (task, robot, variation, fps, episodes) in enumerate(BASES[action]):
        runs.append(str(folder / f"{action}_{number}"))
        flags = {"task": task, "robot": robot, "variation": variation, "fps": fps, "num-episodes": episodes}
        flags |= {"seed": 3601 + number, "width": 96, "height": 96, "workers": 1, "out": runs[-1]}
        told = [str(word) for name, value in flags.items() for word in (f"--{name}", value)]
        subprocess.run([str(command.with_name("generate-dataset")), *told, "--no-export"], check=True)
    told = ["--language"] if action == "joint_increment" else ["--privileged"] if action == "joint" else []
    features = [*_FEATURES, *(["observation.environment_state"] if action == "joint" else [])]
    export = [str(command.with_name("demorec")), "export", "lerobot", *runs, "--out", str(out), "--action", action]
    subprocess.run([*export, "--features", *features, *told, "--no-verify"], check=True)
    return out


def bare(dataset: Path) -> None:
    """Nothing is left that only demorec writes."""
    shutil.rmtree(dataset / "demorec", ignore_errors=True)
    (dataset / "README.md").unlink(missing_ok=True)
    for path in dataset.glob("meta/episodes/*/*.parquet"):
        rows = pq.read_table(path)
        pq.write_table(rows.select([name for name in rows.column_names if name.startswith(_LEROBOT)]), path)


def print_of(dataset: Path) -> dict[str, str]:
    """Path -> digest of each file."""
    paths = (path for path in dataset.rglob("*") if path.is_file())
    return {str(path.relative_to(dataset)): hashlib.sha256(path.read_bytes()).hexdigest() for path in paths}


def judge(dataset: Path) -> list[Result]:
    """What does not pass."""
    report = check_subject(Subject(path=dataset, kind="dataset"), CheckOptions())
    return [result for result in report.results if result.level in ("warn", "fail")]


def spoilt(base: Path, fault: Fault, place: Path, *, sidecar: bool) -> bool:
    """Make a copy with the fault; False where the dataset has not what would be spoilt."""
    shutil.rmtree(place, ignore_errors=True)
    shutil.copytree(base, place)
    if not sidecar:
        bare(place)
    before = print_of(place)
    try:
        fault(place)
    except (ValueError, KeyError, IndexError):
        return False
    return print_of(place) != before


def measured(bases: list[Path], fault: Fault, turn: int, place: Path, *, sidecar: bool) -> tuple[str, list[Result]]:
    """The dataset whose turn it is, or the next one that can be spoilt, and what is said of it."""
    for number in range(len(bases)):
        base = bases[(turn + number) % len(bases)]
        if spoilt(base, fault, place, sidecar=sidecar):
            return base.name, judge(place)
    raise SystemExit("A fault changes nothing in any dataset.")


def level_of(found: list[Result]) -> str:
    """The most severe one."""
    return "fail" if any(r.level == "fail" for r in found) else "warn" if found else "-"


def clean(bases: list[Path], place: Path) -> None:
    """Good datasets must pass without a word, also when their statistics and images are made again."""
    for base in bases:
        for sidecar in (True, False):
            spoilt(base, lambda dataset: None, place, sidecar=sidecar)
            for result in judge(place):
                print(f"CLEAN {base.name} sidecar={sidecar}: {result.check} {result.level}: {result.detail}")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--half", choices=["looked", "held", "both"], default="both")
    parser.add_argument("--all", action="store_true", help="print what finds each fault")
    parser.add_argument("--only", default="", help="faults whose kind or name has this in it")
    parser.add_argument("--turn", type=int, default=0, help="begin with another of the three datasets")
    parser.add_argument("--cache", type=Path, help="a folder that keeps the good datasets")
    args = parser.parse_args()
    vars(dataset_files)["lerobot_is_installed"] = lambda: False
    shares: Counter[tuple[str, bool, str]] = Counter()
    with tempfile.TemporaryDirectory() as temporary:
        bases = [make(args.cache or Path(temporary), action) for action in BASES]
        place = Path(temporary) / "spoilt"
        clean(bases, place)
        for number, (kind, name, fault) in enumerate(FAULTS):
            half = ("looked", "held")[number % 2]
            if args.half not in (half, "both") or args.only not in f"{kind} {name}":
                continue
            for sidecar in (True, False) if kind != "sidecar" else (True,):
                base, found = measured(bases, fault, number // 2 + args.turn, place, sidecar=sidecar)
                level = level_of(found)
                shares[half, sidecar, level] += 1
                if args.all or level != "fail":
                    by = ", ".join(f"{r.check} ({r.level})" for r in found)
                    print(
                        f"{half:6} {'with' if sidecar else 'bare'} {base:15} {level:4} {kind}: {name}: {by}", flush=True
                    )
    for half in ("looked", "held"):
        for sidecar in (True, False):
            counts = [shares[half, sidecar, level] for level in LEVELS]
            if sum(counts):
                print(f"{half}, {'with' if sidecar else 'without'} sidecar: {counts[0]} of {sum(counts)} fail, "
                      f"{counts[1]} warned of: {100 * (counts[0] + counts[1]) / sum(counts):.1f} % found")  # fmt: skip


if __name__ == "__main__":
    main()
