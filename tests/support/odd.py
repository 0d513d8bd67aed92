"""Odd but well-formed input: random values at random places of everything that a command reads.

`Odd` holds a small recording, a run and a dataset; `case(number)` spoils one of them and says which command reads it.
"""

from __future__ import annotations

import json
import math
import random
import shutil
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from demorec.core.config import GenerateConfig
from demorec.mcap import SimulatedRecording
from demorec.runs.run_file import RunFile, inspect_recording, save_run_file
from support.export import export
from support.mcap import metadata_of, rewritten
from support.recording import write_episode

VALUES: tuple[Any, ...] = (
    None, True, False, 0, 1, -1, 2, 3, 7, 255, 2**31, 2**53, 2**63, 2**64, -(2**63), 10**30, 10**3999,
    0.0, -0.0, 0.5, -1.5, 1e-300, 1e300, math.pi, math.nan, math.inf, -math.inf,
    "", "x", "world", "panda", "cube", "front", "\x1b[2J", "\n", "\u202e", "\x00", "/", "..", "../../etc/passwd", "a:b",
    "a:b:c", "os", "%s", "{0}", "{chunk_index:99999999d}", "Ω" * 300, "0" * 5000, "\ud800",
    [], [0], [1, 2, 3], [[]], [[[0.5]]], ["x"], [None], [math.nan] * 3, {}, {"a": 1}, {"x": {"y": []}},
)  # fmt: skip
"""What is put in; those that JSON has no word for are written as Python writes them."""


def places(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Every place within JSON data."""
    found = [path] if path else []
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, child in items:
        found += places(child, (*path, key))
    return found


def spoil(value: Any, rng: random.Random) -> Any:
    """A copy of JSON data with one to three values exchanged, left out, added or moved."""
    value = json.loads(json.dumps(value))
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        found = places(value)
        if not found:
            return rng.choice(VALUES)
        path = rng.choice(found)
        parent = value
        for key in path[:-1]:
            parent = parent[key]
        kind = rng.randrange(8)
        if kind == 0:
            del parent[path[-1]]
        elif kind == 1 and isinstance(parent, dict):
            parent[rng.choice(("odd", "", "name", "\x1b[31m"))] = rng.choice(VALUES)
        elif kind == 2:
            other: Any = value
            for key in rng.choice(found):
                other = other[key]
            parent[path[-1]] = json.loads(json.dumps(other))
        elif kind == 3 and isinstance(parent, list):
            parent.append(parent[path[-1]])
        else:
            parent[path[-1]] = rng.choice(VALUES)
    return value


def spoil_message(data: bytes, rng: random.Random) -> bytes:
    """A message cut off, longer, empty, or with other numbers in it."""
    kind = rng.randrange(6)
    if kind == 0:
        return data[: rng.randrange(len(data) + 1)]
    if kind == 1:
        return data + rng.randbytes(rng.randrange(1, 40))
    if kind == 2:
        return b""
    at = 4 + 8 * rng.randrange(max(1, (len(data) - 4) // 8))
    odd = rng.choice((0.0, -1.0, math.nan, math.inf, -math.inf, 1e300, 1e-310))
    word = struct.pack("<d", odd) if kind == 3 else struct.pack("<q", rng.choice((-1, 2**62, -(2**62), 0, 5)))
    if kind == 5:
        word = rng.randbytes(4)
    return data[:at] + word + data[at + len(word) :]


class Odd:
    """The good files, and how to spoil them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        good = folder / "good"
        run = good / "run"
        (run / "episodes").mkdir(parents=True)
        (run / "failed").mkdir()
        self.plain = write_episode(run / "episodes" / "episode_000000.mcap", num_frames=24, cameras=())
        self.filmed = write_episode(
            good / "filmed.mcap", num_frames=6, cameras=("front",), width=32, height=32, depth=True, segmentation=True
        )
        attempt = inspect_recording(self.plain)[0]
        config = GenerateConfig(cameras=())
        from dataclasses import replace

        attempts = (replace(attempt, file="episodes/episode_000000.mcap", seconds={"simulation": 1.0}),)
        save_run_file(RunFile(config=config, versions={"demorec": "0"}, num_episodes=1, attempts=attempts), run)
        self.run = run
        self.dataset = good / "dataset"
        export([self.plain], self.dataset)
        self.film_dataset = good / "film"
        export([self.filmed], self.film_dataset)
        self.metadata = {path: metadata_of(path) for path in (self.plain, self.filmed)}
        self.kinds: tuple[Callable[[random.Random, Path], list[Any]], ...] = (
            self._description, self._description, self._outcome, self._messages, self._messages, self._run_file,
            self._dataset_json, self._dataset_json, self._dataset_table,
        )  # fmt: skip

    def case(self, number: int) -> tuple[str, list[str]]:
        """What was done, and the command that is to be run."""
        rng = random.Random(number)
        place = self.folder / "case"
        shutil.rmtree(place, ignore_errors=True)
        place.mkdir()
        kind = rng.choice(self.kinds)
        return kind.__name__, [str(word) for word in kind(rng, place)]

    def _description(self, rng: random.Random, place: Path) -> list[Any]:
        source = rng.choice((self.plain, self.plain, self.filmed))
        found = self.metadata[source]["demorec.episode"]
        key = rng.choice(("info", "info", "info", "cameras", "format_version"))
        text = json.dumps(spoil(json.loads(found[key]), rng)) if key != "format_version" else str(rng.choice(VALUES))
        return self._recording(source, rng, place, change={"demorec.episode": {key: text}})

    def _outcome(self, rng: random.Random, place: Path) -> list[Any]:
        source = rng.choice((self.plain, self.filmed))
        text = json.dumps(spoil(json.loads(self.metadata[source]["demorec.outcome"]["outcome"]), rng))
        return self._recording(source, rng, place, change={"demorec.outcome": {"outcome": text}})

    def _messages(self, rng: random.Random, place: Path) -> list[Any]:
        source = rng.choice((self.plain, self.filmed))
        with SimulatedRecording(source) as recording:
            wanted = rng.choice(sorted(recording.topics))
        share = rng.choice((0.05, 1.0))
        return self._recording(
            source, rng, place,
            messages=lambda topic, data: spoil_message(data, rng) if topic == wanted and rng.random() < share else data,
        )  # fmt: skip

    def _recording(self, source: Path, rng: random.Random, place: Path, **how: Any) -> list[Any]:
        path = place / "odd.mcap"
        path.write_bytes(rewritten(source, **how))
        return rng.choice(
            (
                ["info", path], ["info", place, "--json"], ["check", path], ["check", path, "--json"],
                ["check", path, "--no-pictures", "--coverage-picture", place / "coverage.png"],
                ["view", path, "--save", place / "view.rrd"],
                ["view", path, self.plain, "--compare", "--save", place / "c.rrd"],
                ["export", "lerobot", path, "--out", place / "out", "--no-verify", "--privileged"],
                ["export", "lerobot", path, "--out", place / "out", "--no-verify", "--action", "ee_delta"],
                ["replay", path], ["replay", path, "--states"], ["recover", path, "--out", place / "recovered.mcap"],
                ["render", path, "--cameras", "front", "--width", "32", "--height", "32", "--out", place / "r.mcap",
                 "--workers", "1"],
            )
        )  # fmt: skip

    def _run_file(self, rng: random.Random, place: Path) -> list[Any]:
        path = place / "run"
        shutil.copytree(self.run, path)
        file = path / "run.json"
        file.write_text(json.dumps(spoil(json.loads(file.read_text()), rng)))
        return rng.choice(
            (
                ["info", path],
                ["info", path, "--json"],
                ["check", path, "--no-pictures"],
                ["view", path, "--save", place / "v.rrd"],
            )
        )

    def _dataset_json(self, rng: random.Random, place: Path) -> list[Any]:
        source = rng.choice((self.dataset, self.film_dataset))
        path = place / "dataset"
        shutil.copytree(source, path)
        file = path / rng.choice(
            ("meta/info.json", "meta/info.json", "meta/stats.json", "demorec/configs.json", "demorec/export.json")
        )
        file.write_text(json.dumps(spoil(json.loads(file.read_text()), rng)))
        return self._on_dataset(rng, path, place, source)

    def _dataset_table(self, rng: random.Random, place: Path) -> list[Any]:
        source = rng.choice((self.dataset, self.film_dataset))
        path = place / "dataset"
        shutil.copytree(source, path)
        file = rng.choice(sorted(path.rglob("*.parquet")))
        table = pq.read_table(file)
        name = rng.choice(table.column_names)
        index = table.column_names.index(name)
        kind = rng.randrange(4)
        if kind == 0:
            table = table.drop_columns([name])
        elif kind == 1:
            table = table.set_column(index, name, pa.nulls(len(table), table.schema.field(name).type))
        elif kind == 2:
            fill: Any = rng.choice(("x", math.nan, -5, 2**62, [], [0.5], None))
            other = pa.array([fill] * len(table))
            table = table.set_column(index, name, other)
        else:
            table = table.slice(0, rng.randrange(len(table)))
        pq.write_table(table, file)
        return self._on_dataset(rng, path, place, source)

    def _on_dataset(self, rng: random.Random, path: Path, place: Path, source: Path) -> list[Any]:
        origin = self.plain if source == self.dataset else self.filmed
        checks = ["dataset_readable", "dataset_counts", "dataset_videos", "dataset_statistics", "dataset_sidecar",
                  "dataset_picture_statistics", "duplicates", "coverage", "joint_limits",
                  "velocity_matches_position", "forward_kinematics", "dataset_action_lag"]  # fmt: skip
        return rng.choice(
            (
                ["info", path], ["info", path, "--json"], ["check", path, "--only", *checks],
                ["view", path, "--save", place / "v.rrd"], ["replay", path],
                ["export", "lerobot", origin, "--out", path, "--append", "--no-verify"],
                ["reproduce", path, "--out", place / "again", "--workers", "0"],
            )
        )  # fmt: skip
