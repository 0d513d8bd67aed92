"""Planted faults that `demorec check` finds in third-party datasets, and its alarms on sound ones.

    python benchmarks/doctor_faults.py                              faults one at a time in every base
    python benchmarks/doctor_faults.py --second bad nan             with a second bad episode, or a NaN, in the dataset
    python benchmarks/doctor_faults.py --bases delta --faults copy "stuck state"
    python benchmarks/doctor_faults.py --sound 300 --seed 5000      alarms on sound datasets of 1 to 200 episodes
    python benchmarks/doctor_faults.py --scores 3                   AUC of the episodes' scores, three datasets a format

A fault is found if the verdict is not "good", and a check with one of the fault's words in its name reports a faulty
episode (any episode if all are faulty). Datasets are written to a temporary folder by tests/support.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import io
import json
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from support.doctor_bases import BASES, DatasetBase, DemoDataset, record
from support.doctor_damage import copied, on, other_unit, put
from support.doctor_faults import FAULTS, PlantedFault, applies
from support.doctor_motion import SPOILERS
from support.doctor_writer import VideoStore, write_dataset

from demorec.cli import main as demorec

EPISODES = 8
PLANTED = 3
BAD, WITH_NAN = 6, 7
"""Episodes with the fault; with the second fault, another unit or a NaN."""
SEED = 11
MAX_EPISODES_WITH_CAMERAS = 10


def check(*paths: Path) -> dict[str, Any]:
    """Run `demorec check --json` in this process."""
    printed = io.StringIO()
    with (
        contextlib.redirect_stdout(printed),
        contextlib.redirect_stderr(io.StringIO()),
        contextlib.suppress(SystemExit),
    ):
        demorec(["check", *map(str, paths), "--json"])
    try:
        answer: dict[str, Any] = json.loads(printed.getvalue())
    except json.JSONDecodeError:
        return {"verdict": "no answer", "findings": [], "episodes": []}
    return answer


def digest(root: Path) -> str:
    """SHA-256 over all files of a dataset."""
    total = hashlib.sha256()
    for path in sorted(root.rglob("*")):
        if path.is_file():
            total.update(str(path.relative_to(root)).encode() + path.read_bytes())
    return total.hexdigest()


def findings_of(answer: dict[str, Any]) -> list[dict[str, Any]]:
    """The findings of every path of an answer."""
    found = list(answer.get("findings", []))
    for path in answer.get("paths", []):
        found += path.get("findings", [])
    return found


def is_found(fault: PlantedFault, answer: dict[str, Any], episodes: Iterable[int]) -> bool:
    """Whether an answer has the fault of these episodes."""
    if answer.get("verdict") == "good":
        return False
    words = fault.words.split()
    for finding in findings_of(answer):
        names_episode = fault.is_whole or finding["episode"] in set(episodes)
        if names_episode and any(word in finding["check"].lower() for word in words):
            return True
    return False


@dataclass(frozen=True, kw_only=True)
class Bench:
    """A base's sound dataset, and those with a fault, in a folder."""

    base: DatasetBase
    folder: Path
    store: VideoStore
    sound: DemoDataset
    sound_digest: str

    def plant(self, name: str, second: str = "") -> Path:
        """Write the dataset with a fault; raises if nothing changed."""
        fault = FAULTS[name]
        dataset = copied(self.sound)
        if second == "bad":
            for feature in ("state", "action"):
                on(feature, other_unit)(dataset, BAD)
        if second == "nan":
            on("state", put(np.nan, slice(40, 41), 2))(dataset, WITH_NAN)
        if fault.rows is not None:
            fault.rows(dataset, PLANTED)
        root = write_dataset(dataset, self.folder / f"{name}_{second}".replace(" ", "_"), self.store)
        if fault.files is not None:
            before = digest(root)
            fault.files(root, self.base, PLANTED)
            assert digest(root) != before, f"{name} changed no file"
        assert digest(root) != self.sound_digest, f"{name} changed nothing"
        return root


def bench(base: DatasetBase, folder: Path) -> Bench:
    """Record and write a base's sound dataset."""
    (folder / "videos").mkdir(parents=True)
    store = VideoStore(folder / "videos")
    sound = record(base, SEED, EPISODES)
    root = write_dataset(sound, folder / "sound", store)
    return Bench(base=base, folder=folder, store=store, sound=sound, sound_digest=digest(root))


@dataclass(frozen=True, kw_only=True)
class Planted:
    """A fault in a base, and whether it was found; `said` are the checks that said something."""

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
                yield Planted(
                    base=base_name, fault=name, second=other, is_found=is_found(fault, answer, episodes),
                    said=", ".join(told) or str(answer.get("verdict")),
                )  # fmt: skip


LEAKAGE = PlantedFault(family="set", words="leak cop duplic shared overlap same", is_whole=True)


def leakage(made: Bench, second: str) -> dict[str, Any]:
    """Check a training set and a validation set that share an episode."""
    others = record(made.base, SEED + 1, 4, cameras=bool(made.base.cameras))
    others.episodes[2] = copied(made.sound).episodes[PLANTED]
    if second:
        on("state", put(np.nan, slice(40, 41), 2) if second == "nan" else other_unit)(others, 0)
    validation = write_dataset(others, made.folder / f"validation_{second}", made.store)
    return check(made.folder / "sound", validation)


def episodes_of(name: str) -> range:
    """Episodes of which a finding may name any."""
    copies = {"copy": range(PLANTED, PLANTED + 2), "four copies": range(PLANTED, PLANTED + 4)}
    return copies.get(name, range(PLANTED - 1 if name == "shared piece" else PLANTED, PLANTED + 1))


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
    """Print the AUC of the scores between sound and spoilt episodes, 3 in 10, overall and by kind."""
    for base in bases:
        scores: dict[str, list[float]] = defaultdict(list)
        for number in range(count):
            rng = np.random.default_rng((seed, number))
            kinds = rng.permutation(list(SPOILERS) * 2)
            spoilt = dict(zip(rng.choice(54, 16, replace=False).tolist(), map(str, kinds), strict=True))
            with tempfile.TemporaryDirectory(dir=folder) as place:
                dataset = record(BASES[base], int(rng.integers(2**31)), 54, spoilt=spoilt, cameras=False)
                answer = check(write_dataset(dataset, Path(place) / "scored", VideoStore(Path(place))))
            for row in answer.get("episodes", []):
                scores[spoilt.get(row["episode"], "")].append(row["score"])
        bad = {kind: scores[kind] for kind in SPOILERS}
        whole = auc(scores[""], [value for values in bad.values() for value in values])
        print(f"{base}: AUC {whole:.3f}; " + ", ".join(f"{k} {auc(scores[''], v):.3f}" for k, v in bad.items()))


def auc(good: Sequence[float], bad: Sequence[float]) -> float:
    """Share of the pairs in which the good one has the higher score; equal ones count half (Mann-Whitney)."""
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
