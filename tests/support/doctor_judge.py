"""Plant a fault in a dataset, run `demorec check --json`, and search its output for the fault."""

from __future__ import annotations

import contextlib
import io
import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from demorec.cli import main
from support.doctor_bases import DatasetBase, DemoDataset, record
from support.doctor_damage import both, copied, on, other_unit, put
from support.doctor_faults import FAULTS
from support.doctor_writer import VideoStore, write_dataset

Alarms = frozenset[tuple[str, int | None]]

EPISODES = 8
PLANTED = 3
SEED = 11
SECOND: dict[str, Callable[[DemoDataset], None]] = {
    "": lambda dataset: None,
    "bad": lambda dataset: both(other_unit)(dataset, 6),
    "nan": lambda dataset: on("state", put(np.nan, slice(40, 41), 2))(dataset, 7),
}
"""Faults of another episode next to the planted one."""


def check(*paths: Path) -> dict[str, Any]:
    """Run `demorec check --json` in this process."""
    printed = io.StringIO()
    with (
        contextlib.redirect_stdout(printed),
        contextlib.redirect_stderr(io.StringIO()),
        contextlib.suppress(SystemExit),
    ):
        main(["check", *map(str, paths), "--json"])
    answer: dict[str, Any] = json.loads(printed.getvalue())
    return answer


def findings_of(answer: dict[str, Any]) -> list[dict[str, Any]]:
    """Findings for every path in the output."""
    return [finding for each in answer.get("paths", [answer]) for finding in each["findings"]]


def alarms_of(answer: dict[str, Any]) -> Alarms:
    """Check and episode of every finding."""
    return frozenset((finding["check"], finding["episode"]) for finding in findings_of(answer))


@dataclass(frozen=True, kw_only=True)
class Bench:
    """A base's sound dataset and its faulty ones, in a folder."""

    base: DatasetBase
    folder: Path
    store: VideoStore
    sound: DemoDataset
    alarms: dict[str, Alarms] = field(default_factory=dict)

    def write(self, name: str, change: Callable[[DemoDataset], None]) -> Path:
        """Write a changed copy of the sound dataset."""
        dataset = copied(self.sound)
        change(dataset)
        return write_dataset(dataset, self.folder / name.replace(" ", "_"), self.store)

    def plant(self, name: str, second: str = "") -> Path:
        """Write the dataset with a fault."""
        fault = FAULTS[name]

        def spoil(dataset: DemoDataset) -> None:
            SECOND[second](dataset)
            if fault.rows is not None:
                fault.rows(dataset, PLANTED)

        root = self.write(f"{name}_{second}", spoil)
        if fault.files is not None:
            before = _contents(root)
            fault.files(root, self.base, PLANTED)
            assert _contents(root) != before, f"{name} changed no file"
        return root

    def is_found(self, answer: dict[str, Any], episodes: range | None, second: str = "") -> bool:
        """Whether a finding names one of the episodes, any for None, that the dataset without the fault lacks."""
        if second not in self.alarms:
            self.alarms[second] = alarms_of(check(self.write(f"without_{second}", SECOND[second])))
        new = alarms_of(answer) - self.alarms[second]
        return any(episodes is None or (episode is not None and episode in episodes) for _, episode in new)


def _contents(root: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in root.rglob("*") if path.is_file()}


def bench(base: DatasetBase, folder: Path) -> Bench:
    """Record and write a base's sound dataset."""
    (folder / "videos").mkdir(parents=True)
    made = Bench(base=base, folder=folder, store=VideoStore(folder / "videos"), sound=record(base, SEED, EPISODES))
    made.write("sound", SECOND[""])
    return made


def finds_leakage(made: Bench) -> bool:
    """Whether a training set and a validation set that share an episode are found."""
    others = record(made.base, SEED + 1, 4)
    others.episodes[2] = copied(made.sound).episodes[PLANTED]
    validation = write_dataset(others, made.folder / "validation", made.store)
    return ("leakage", 2) in alarms_of(check(made.folder / "sound", validation))


def episodes_of(name: str) -> range | None:
    """Episodes that a finding may name; None for any."""
    if FAULTS[name].is_whole:
        return None
    copies = {"copy": range(PLANTED, PLANTED + 2), "four copies": range(PLANTED, PLANTED + 4)}
    return copies.get(name, range(PLANTED - 1 if name == "shared piece" else PLANTED, PLANTED + 1))
