"""Planted faults that `demorec check` finds in third-party datasets, and its alarms on sound ones.

    python benchmarks/doctor_faults.py                              faults one at a time in every base
    python benchmarks/doctor_faults.py --second bad nan             with a second bad episode, or a NaN, in the dataset
    python benchmarks/doctor_faults.py --bases delta --faults copy "stuck state"
    python benchmarks/doctor_faults.py --sound 300 --seed 5000      alarms on sound datasets of 1 to 200 episodes

A fault is found if a check reports a faulty episode (any episode if all are faulty) and does not do so without the
fault. tests/support writes the datasets to a temporary folder.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from support.doctor_bases import BASES, record
from support.doctor_faults import FAULTS
from support.doctor_judge import SECOND, bench, check, episodes_of, findings_of, finds_leakage
from support.doctor_writer import VideoStore, write_dataset

MAX_EPISODES_WITH_CAMERAS = 10


@dataclass(frozen=True, kw_only=True)
class Planted:
    """A fault in a base, and whether it was found; `said` are the checks that reported something."""

    base: str
    fault: str
    second: str
    is_found: bool
    said: str


def planted(bases: Sequence[str], faults: Sequence[str], second: Sequence[str], folder: Path) -> Iterator[Planted]:
    """Plant faults one at a time, and check."""
    for base_name in bases:
        made = bench(BASES[base_name], folder / base_name.replace(" ", "_"))
        for name in faults:
            for other in second[:1] if name == "leakage" else second:  # leakage has no second fault
                said = ""
                if name == "leakage":
                    found = finds_leakage(made)
                elif FAULTS[name].applies(made.base):
                    answer = check(made.plant(name, other))
                    found = made.is_found(answer, episodes_of(name), other)
                    told = Counter(f"{each['check']}/{each['episode']}" for each in findings_of(answer))
                    said = ", ".join(told) or answer["verdict"]
                else:
                    continue
                print(base_name, name, other, "found" if found else f"missed ({said})", flush=True)
                yield Planted(base=base_name, fault=name, second=other, is_found=found, said=said)


def report_faults(results: Sequence[Planted]) -> None:
    """Print the rates of faults found, by fault and by base."""
    for fault, rows in _by(results, "fault").items():
        missed = [
            f"{row.base}{'+' + row.second if row.second else ''} ({row.said})" for row in rows if not row.is_found
        ]
        print(f"{fault:<30}{len(rows) - len(missed)}/{len(rows)}{'  missed: ' if missed else ''}{'; '.join(missed)}")
    harmful = [row for row in results if row.fault == "leakage" or FAULTS[row.fault].is_harmful]
    for key in ("base", "second"):
        print(f"by {key}:", ", ".join(f"{name or 'alone'} {_rate(rows)}" for name, rows in _by(results, key).items()))
    print(f"all {_rate(results)} (at least 90 %), harmful {_rate(harmful)} (at least 95 %)")


def _by(results: Sequence[Planted], key: str) -> dict[str, list[Planted]]:
    groups: dict[str, list[Planted]] = defaultdict(list)
    for row in results:
        groups[getattr(row, key)].append(row)
    return groups


def _rate(rows: Sequence[Planted]) -> str:
    found = sum(row.is_found for row in rows)
    return f"{found}/{len(rows)} = {found / max(1, len(rows)):.1%}"


def report_sound(bases: Sequence[str], count: int, seed: int, folder: Path) -> None:
    """Check sound datasets of 1 to 200 episodes and print each alarm."""
    alarms: Counter[str] = Counter()
    verdicts: Counter[str] = Counter()
    for number in range(count):
        rng = np.random.default_rng((seed, number))
        base = BASES[bases[number % len(bases)]]
        episodes = int(np.exp(rng.uniform(0, np.log(201))))
        cameras = episodes <= MAX_EPISODES_WITH_CAMERAS
        with tempfile.TemporaryDirectory(dir=folder) as place:
            store = VideoStore(Path(place))
            dataset = record(base, int(rng.integers(2**31)), episodes, cameras=cameras)
            answer = check(write_dataset(dataset, Path(place) / "sound", store))
        verdicts[str(answer.get("verdict"))] += 1
        for finding in findings_of(answer):
            alarms[f"{base.name}: {finding['check']} ({finding['severity']})"] += 1
            said = f"{finding['check']} {finding['severity']} episode {finding['episode']} {finding['frames']}"
            print(f"{number} {base.name} {episodes} episodes: {said}: {finding['message']}", flush=True)
    print(f"{count} sound datasets: {dict(verdicts)}; findings {dict(alarms.most_common())}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bases", nargs="*", default=list(BASES))
    parser.add_argument("--faults", nargs="*", default=[*FAULTS, "leakage"])
    parser.add_argument("--second", nargs="*", default=[""], choices=list(SECOND))
    parser.add_argument("--sound", type=int, default=0, help="number of sound datasets")
    parser.add_argument("--seed", type=int, default=1000)
    args = parser.parse_args()
    begun = time.process_time()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if args.sound:
            report_sound(args.bases, args.sound, args.seed, folder)
        else:
            report_faults(list(planted(args.bases, args.faults, args.second, folder)))
    print(f"{time.process_time() - begun:.0f} CPU s")


if __name__ == "__main__":
    main()
