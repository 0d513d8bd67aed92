"""Planted faults that `demorec check` finds in third-party datasets, and its alarms on sound ones.

    python benchmarks/doctor_faults.py                              faults one at a time in every base
    python benchmarks/doctor_faults.py --second bad nan             with a second bad episode, or a NaN, in the dataset
    python benchmarks/doctor_faults.py --bases delta --faults copy "stuck state"
    python benchmarks/doctor_faults.py --sound 300 --seed 5000      alarms on sound datasets of 1 to 200 episodes
    python benchmarks/doctor_faults.py --scores 3                   AUC of the episodes' scores, three datasets a format

A fault is found if the verdict is not "good", and a check with one of the fault's words in its name reports a faulty
episode (any episode if all are faulty) and did not do so before. tests/support writes the datasets to a temporary
folder.
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
from support.doctor_faults import FAULTS, applies
from support.doctor_judge import EPISODES, LEAKAGE, bench, check, episodes_of, findings_of, is_found, leakage
from support.doctor_motion import SPOILERS
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
            if name != "leakage" and not applies(FAULTS[name], made.base):
                continue
            for other in second:
                if name == "leakage":
                    answer, fault, episodes = leakage(made, other), LEAKAGE, range(EPISODES)
                else:
                    root = made.plant(name, other)
                    answer, fault, episodes = check(root), FAULTS[name], episodes_of(name)
                told = Counter(f"{each['check']}/{each['episode']}" for each in findings_of(answer))
                row = Planted(
                    base=base_name,
                    fault=name,
                    second=other,
                    is_found=is_found(fault, answer, episodes, made.alarms),
                    said=", ".join(told) or str(answer.get("verdict")),
                )
                print(base_name, name, other, "found" if row.is_found else f"missed ({row.said})", flush=True)
                yield row


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


def report_scores(bases: Sequence[str], count: int, seed: int, folder: Path) -> None:
    """Print the AUC of the scores between sound and spoilt episodes, 3 in 10 of all sizes, overall and by kind."""
    for base in bases:
        scores: dict[str, list[float]] = defaultdict(list)
        for number in range(count):
            rng = np.random.default_rng((seed, number))
            kinds = rng.permutation(list(SPOILERS) * 2)
            numbers = rng.choice(54, 16, replace=False).tolist()
            spoilt = {i: (str(kind), rng.uniform(0.2, 1)) for i, kind in zip(numbers, kinds, strict=True)}
            with tempfile.TemporaryDirectory(dir=folder) as place:
                dataset = record(BASES[base], int(rng.integers(2**31)), 54, spoilt=spoilt, cameras=False)
                answer = check(write_dataset(dataset, Path(place) / "scored", VideoStore(Path(place))))
            for row in answer.get("episodes", []):
                scores[spoilt.get(row["episode"], ("", 0))[0]].append(row["score"])
        bad = {kind: scores[kind] for kind in SPOILERS}
        whole = auc(scores[""], [value for values in bad.values() for value in values])
        print(f"{base}: AUC {whole:.3f}; " + ", ".join(f"{k} {auc(scores[''], v):.3f}" for k, v in bad.items()))


def auc(good: Sequence[float], bad: Sequence[float]) -> float:
    """Ratio of pairs in which the good one has the higher score; equal scores count half (Mann-Whitney)."""
    if not good or not bad:
        return float("nan")
    differences = np.subtract.outer(np.array(good), np.array(bad))
    return float((differences > 0).mean() + 0.5 * (differences == 0).mean())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bases", nargs="*", default=list(BASES))
    parser.add_argument("--faults", nargs="*", default=[*FAULTS, "leakage"])
    parser.add_argument("--second", nargs="*", default=[""], choices=["bad", "nan", ""])
    parser.add_argument("--sound", type=int, default=0, help="number of sound datasets")
    parser.add_argument("--scores", type=int, default=0, help="number of datasets of each base")
    parser.add_argument("--seed", type=int, default=1000)
    args = parser.parse_args()
    begun = time.process_time()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if args.sound:
            report_sound(args.bases, args.sound, args.seed, folder)
        elif args.scores:
            report_scores(args.bases, args.scores, args.seed, folder)
        else:
            report_faults(list(planted(args.bases, args.faults, args.second, folder)))
    print(f"{time.process_time() - begun:.0f} CPU s")


if __name__ == "__main__":
    main()
