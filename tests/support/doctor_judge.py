"""Evaluate the checks of datasets: plant a fault, run `demorec check --json`, and search its output for the fault."""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from demorec.cli import main
from support.doctor_bases import DatasetBase, DemoDataset, record
from support.doctor_damage import copied, on, other_unit, put
from support.doctor_faults import FAULTS, PlantedFault
from support.doctor_writer import VideoStore, write_dataset

Alarms = frozenset[tuple[str, int | None]]

EPISODES = 8
PLANTED = 3
BAD, WITH_NAN = 6, 7
"""Episodes with the fault; with the second fault, another unit or a NaN."""
SEED = 11


def check(*paths: Path) -> dict[str, Any]:
    """Run `demorec check --json` in this process."""
    printed = io.StringIO()
    with (
        contextlib.redirect_stdout(printed),
        contextlib.redirect_stderr(io.StringIO()),
        contextlib.suppress(SystemExit),
    ):
        main(["check", *map(str, paths), "--json"])
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
    """Findings for every path in the output."""
    found = list(answer.get("findings", []))
    for path in answer.get("paths", []):
        found += path.get("findings", [])
    return found


def alarms_of(answer: dict[str, Any]) -> Alarms:
    """Check and episode of every finding."""
    return frozenset((finding["check"], finding["episode"]) for finding in findings_of(answer))


def is_found(fault: PlantedFault, answer: dict[str, Any], episodes: Iterable[int], alarms: Alarms) -> bool:
    """Whether the output reports the fault in these episodes; `alarms` are those of the sound dataset."""
    if answer.get("verdict") == "good":
        return False
    words = fault.words.split()
    for finding in findings_of(answer):
        if (finding["check"], finding["episode"]) in alarms:
            continue
        names_episode = fault.is_whole or finding["episode"] in set(episodes)
        if names_episode and any(word in finding["check"].lower() for word in words):
            return True
    return False


@dataclass(frozen=True, kw_only=True)
class Bench:
    """A base's sound dataset and its faulty ones, in a folder; `alarms` are those of the sound one."""

    base: DatasetBase
    folder: Path
    store: VideoStore
    sound: DemoDataset
    sound_digest: str
    alarms: Alarms

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
    return Bench(
        base=base, folder=folder, store=store, sound=sound, sound_digest=digest(root), alarms=alarms_of(check(root))
    )


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
    """Episodes that a finding may name."""
    copies = {"copy": range(PLANTED, PLANTED + 2), "four copies": range(PLANTED, PLANTED + 4)}
    return copies.get(name, range(PLANTED - 1 if name == "shared piece" else PLANTED, PLANTED + 1))
