"""Hostile datasets, HDF5 files, runs, recordings and policies, each a function of its number and mostly valid."""

from __future__ import annotations

import copy
import json
import math
import random
import shutil
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from demorec.core.config import GenerateConfig
from demorec.core.plain import to_plain
from demorec.core.tables import FILE_CHECKS
from demorec.extensions.policies.evaluation import Evaluation, Settings
from demorec.mcap import Recording
from demorec.render.raster.renderer import warm_up
from support import hdf5
from support.export import export, make_run
from support.external import write_external
from support.foreign_dataset import write_foreign
from support.fuzz import changed_bytes
from support.mcap import rewritten
from support.recording import write_episode

_VALUES: tuple[Any, ...] = (
    None, True, False, 0, -1, 1, 0.5, 2**31, 2**63, 2**64, 10**30, -(10**30), 1e300, float("inf"), float("nan"),
    "", "text", "0", "\x00", "a\x00b", "\ud800", "\x1b[2J\u202e<script>", "../../etc/passwd", "/dev/zero",
    "{chunk_index}", "{x}", "{", "data/{chunk_index:09999d}.parquet", "data/{file_index!r}", [], [[]], [None],
    ["a", "a"], "x" * 100_000,
    [0] * 3, [1 << 24], [-1], [1e300], ["x"] * 5000, {}, {"a": 1}, {"": {}}, {"bytes": "x"}, [[1.0], []], [{}] * 2000,
)  # fmt: skip
_TYPES = (
    pa.int8(), pa.int64(), pa.uint64(), pa.float32(), pa.float64(), pa.bool_(), pa.string(), pa.binary(), pa.date32(),
    pa.timestamp("ns"), pa.null(), pa.list_(pa.float32()), pa.list_(pa.string()), pa.list_(pa.float32(), 3),
    pa.list_(pa.list_(pa.int64())), pa.struct([("bytes", pa.binary()), ("path", pa.string())]), pa.decimal128(30, 3),
    pa.list_(pa.struct([("role", pa.string())])), pa.large_string(), pa.map_(pa.string(), pa.int64()),
)  # fmt: skip
_CELLS: tuple[Any, ...] = (
    None, 0, 1, -1, 2**40, 2**62, 0.5, 1e30, float("nan"), float("inf"), "", "x", "x" * 10_000, True, [], [1.0], [None],
    ["x"], b"\x89PNG", {"bytes": b"x", "path": None}, {"bytes": None, "path": "/etc/passwd"}, [[1]], [{"role": "x"}],
)  # fmt: skip
_MAPPING = """
[robot]
name = "panda"
urdf = ""
[task]
text = "lift"
[clock]
fps = 20
[episodes]
group = "data"
mask = "train"
success = "rewards"
[[features."observation.state"]]
dataset = "obs/robot0_joint_pos"
unit = "rad"
elements = [0, 1, 2]
names = ["a", "b", "c"]
[[features.action]]
dataset = "actions"
[cameras.front]
dataset = "obs/agentview_image"
colors = "rgb"
"""
_CHECKS = tuple(name for name in FILE_CHECKS.names() if name.startswith("dataset_") and name != "lerobot_opens")
"""Commands on datasets; LeRobot takes seconds to load."""
Case = tuple[str, list[str]]


class FuzzedData:
    """Cases in a folder: each number gives the same arguments of a command every time."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        warm_up()  # compile once, at no command's expense
        self._good = write_episode(folder / "good.mcap", num_frames=12, cameras=("front",))
        self._external = write_external(folder / "collected.mcap")
        make_run(folder / "run", (4, 5), failures=(6,), cameras=())
        export(self._good, folder / "own")
        write_foreign(folder / "foreign")
        hdf5.write_robomimic(folder / "robomimic.hdf5")
        with Recording(self._good) as recording:
            names = ("demorec.episode", "demorec.outcome")
            self._metadata = {name: recording._container.metadata(name) or {} for name in names}

    def clear(self) -> None:
        """Remove a command's output."""
        for path in self.folder.glob("out*"):
            shutil.rmtree(path) if path.is_dir() else path.unlink()

    def case(self, number: int) -> Case:
        """Description of the change, and the arguments of the command that reads it."""
        chance = random.Random(number)
        made: Callable[[random.Random], Case] = chance.choice(
            (self._dataset,) * 3 + (self._hdf5, self._recording) * 2 + (self._run, self._policy)
        )
        return made(chance)

    def _dataset(self, chance: random.Random) -> Case:
        root = self.folder / "dataset"
        shutil.rmtree(root, ignore_errors=True)
        shutil.copytree(self.folder / chance.choice(("own", "foreign", "foreign")), root)
        file = chance.choice(sorted(path for path in root.rglob("*") if path.suffix in (".json", ".parquet", ".mp4")))
        if chance.random() < 0.4:
            file = root / "meta" / "info.json"
        what = f"{file.relative_to(root)}: {_change(file, chance)}"
        commands = (
            ["info", root], ["info", root], ["import", "lerobot", root, "--out", self.folder / "out"],
            ["check", root, "--only", *_CHECKS], ["report", root, "--out", self.folder / "out.html"],
            ["export", "lerobot", self._good, "--out", root, "--append", "--no-verify"], ["replay", root],
            ["view", root, "--save", self.folder / "out.rrd"],
            ["generate", "--config", root, "--out", self.folder / "out", "--workers", "0"],
        )  # fmt: skip
        return what, list(map(str, chance.choice(commands)))

    def _hdf5(self, chance: random.Random) -> Case:
        path, mapping = self.folder / "changed.hdf5", self.folder / "mapping.toml"
        shutil.copy(self.folder / "robomimic.hdf5", path)
        if chance.random() < 0.4:
            path.write_bytes(changed_bytes(path.read_bytes(), chance))
            what = "bytes"
        else:
            with h5py.File(path, "r+") as file:
                what = "; ".join(_change_hdf5(file, chance) for _ in range(chance.choice((1, 1, 2))))
        mapping.write_text(_MAPPING)
        rest = ["--suggest"] if chance.random() < 0.4 else ["--mapping", mapping, "--out", self.folder / "out"]
        return f"HDF5 {what}", list(map(str, ["import", "hdf5", path, *rest]))

    def _run(self, chance: random.Random) -> Case:
        root = self.folder / "changed"
        shutil.rmtree(root, ignore_errors=True)
        shutil.copytree(self.folder / "run", root)
        kind = chance.choice(("simulated", "collected"))
        (root / "run.json").write_text(json.dumps(_RUNS[kind]))
        what = f"run.json ({kind}): {_change(root / 'run.json', chance)}"
        commands = (
            ["info", root], ["info", root, "--json"], ["report", root, "--out", self.folder / "out.html"],
            ["export", "hdf5", root, "--out", self.folder / "out.hdf5"],
            ["import", "lerobot", self.folder / "foreign", "--out", root],
        )  # fmt: skip
        return what, list(map(str, chance.choice(commands)))

    def _recording(self, chance: random.Random) -> Case:
        path = self.folder / "changed.mcap"
        if chance.random() < 0.5:
            name = chance.choice(list(self._metadata))
            key = "info" if name == "demorec.episode" else "outcome"
            data = json.loads(self._metadata[name][key])
            what = f"{name}: {_change_json(data, chance)}"
            path.write_bytes(rewritten(self._good, change={name: {key: json.dumps(data)}}))
        elif chance.random() < 0.5:
            with Recording(self._good) as recording:
                wanted = chance.choice(sorted(recording.topics))
            share, what = chance.choice((0.05, 1.0)), f"messages of {wanted}"

            def spoilt(topic: str, data: bytes) -> bytes:
                return _change_message(data, chance) if topic == wanted and chance.random() < share else data

            path.write_bytes(rewritten(self._good, messages=spoilt))
        else:
            what = "bytes"
            source = chance.choice((self._good, self._external))
            path.write_bytes(changed_bytes(source.read_bytes(), chance))
        lerobot = ["export", "lerobot", path, "--out", self.folder / "out", "--no-verify"]
        commands = (
            ["info", path], ["info", path, "--json"], ["check", path],
            ["report", path, "--out", self.folder / "out.html"],
            ["check", path, "--no-images"],
            ["view", path, "--save", self.folder / "out.rrd"],
            [*lerobot, "--privileged"], [*lerobot, "--action", "ee_delta"],
            ["export", "hdf5", path, "--out", self.folder / "out.hdf5"],
            ["recover", path, "--out", self.folder / "out.mcap"], ["replay", path],
            ["render", path, "--cameras", "front", "--width", "32", "--height", "32", "--workers", "1",
             "--out", self.folder / "out.mcap"],
        )  # fmt: skip
        return f"recording {what}", list(map(str, chance.choice(commands)))

    def _policy(self, chance: random.Random) -> Case:
        root = self.folder / "policy"
        shutil.rmtree(root, ignore_errors=True)
        root.mkdir()
        (root / "config.json").write_text(json.dumps(_POLICY))
        (root / "train_config.json").write_text(json.dumps({"dataset": {"root": str(self.folder / "nowhere")}}))
        (root / "policy_preprocessor.json").write_text(json.dumps(_STEPS))
        out = self.folder / "out"
        out.mkdir(exist_ok=True)
        (out / "evaluation.json").write_text(json.dumps(to_plain(_EVALUATION)))
        file = chance.choice([*sorted(root.glob("*.json")), out / "evaluation.json"])
        what = f"policy {file.name}: {_change(file, chance)}"
        return what, ["evaluate", "--policy", str(root), "--action", "joint", "--out", str(out), "--num-episodes", "1"]


_POLICY: dict[str, Any] = {
    "type": "act",
    "input_features": {
        "observation.images.front": {"type": "VISUAL", "shape": [3, 96, 96]},
        "observation.state": {"type": "STATE", "shape": [8]},
    },
    "output_features": {"action": {"type": "ACTION", "shape": [8]}},
    "chunk_size": 8,
}
_EVALUATION = Evaluation(
    settings=Settings(
        policy="p", policy_type="act", policy_digest="0" * 16, config=GenerateConfig(), action="joint",
        action_steps=None, privileged=False, state="joint", episode_length=None,
    ),
    versions={"demorec": "0.1.0"},
)  # fmt: skip
_STEPS: dict[str, Any] = {"name": "x", "steps": [{"registry_name": "rename"}, {"class": "os.path.join", "config": {}}]}
_LINE: dict[str, Any] = {
    "episode_index": 0, "file": "episodes/episode_000000.mcap", "sha256": "0" * 64, "digest": "0" * 64, "num_frames": 4,
    "num_bytes": 4000, "success": True,
}  # fmt: skip
_RUNS: dict[str, dict[str, Any]] = {
    "simulated": {
        "format": 1, "digest": "0" * 16, "num_episodes": 2, "versions": {"demorec": "0.1.0"},
        "config": {"task": "pick_place", "seed": 0}, "export": None, "sessions": [{"started": "x", "machine": {}}],
        "episodes": [{**_LINE, "attempt": 0, "seed": 0, "phase": "", "reason": ""}],
    },
    "collected": {
        "format": 1, "kind": "collected", "digest": "0" * 16, "robot": "x", "fps": 10, "sessions": [{"started": "x"}],
        "episodes": [{**_LINE, "instruction": "x", "drops": {}, "reason": ""}],
    },
}  # fmt: skip


def _change(file: Path, chance: random.Random) -> str:
    """Change a file in place; return a description."""
    if file.suffix == ".json" and chance.random() < 0.85:
        data = json.loads(file.read_text())
        what = "; ".join(_change_json(data, chance) for _ in range(chance.choice((1, 1, 1, 2, 4))))
        if chance.random() < 0.05:
            data, what = chance.choice((*_VALUES, [data])), "as a whole"
        file.write_text(json.dumps(data))
        if chance.random() < 0.03:
            file.write_text("[" * 100_000 + "]" * 100_000)
        return what
    if file.suffix == ".parquet" and chance.random() < 0.7:
        table = pq.read_table(file)
        changed, what = _change_table(table, chance)
        pq.write_table(changed, file, compression=chance.choice(("snappy", "zstd", "none")))
        return what
    file.write_bytes(changed_bytes(file.read_bytes(), chance))
    return "bytes"


def _places(value: Any, parent: Any = None, key: Any = None) -> list[tuple[Any, Any]]:
    """(container, key) of every value within."""
    found = [] if parent is None else [(parent, key)]
    pairs = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for name, child in pairs:
        found += _places(child, value, name)
    return found


def _change_json(data: Any, chance: random.Random) -> str:
    places = _places(data)
    if not places:
        return "nothing"
    parent, key = chance.choice(places)
    match chance.randrange(5):
        case 0 | 1:
            parent[key] = copy.deepcopy(chance.choice(_VALUES))
        case 2:
            del parent[key]
            return f"without {key}"
        case 3:
            other, name = chance.choice(places)
            if name in (other if isinstance(other, dict) else range(len(other))):
                parent[key] = copy.deepcopy(other[name])
        case _:
            if isinstance(parent, dict):
                parent[chance.choice(("x", "", "a/b", "..", "observation.x", "\x1b\u202e"))] = parent.pop(key)
            else:
                parent.insert(0, copy.deepcopy(parent[key]))
    shown = parent.get(key) if isinstance(parent, dict) else parent
    return f"{key}: {repr(shown)[:100]}"


def _change_message(data: bytes, chance: random.Random) -> bytes:
    """Make a message shorter, longer or empty, or change numbers in it."""
    kind = chance.randrange(6)
    if kind == 0:
        return data[: chance.randrange(len(data) + 1)]
    if kind == 1:
        return data + chance.randbytes(chance.randrange(1, 40))
    if kind == 2:
        return b""
    at = 4 + 8 * chance.randrange(max(1, (len(data) - 4) // 8))
    odd = chance.choice((0.0, -1.0, math.nan, math.inf, -math.inf, 1e300, 1e-310))
    word = struct.pack("<d", odd) if kind == 3 else struct.pack("<q", chance.choice((-1, 2**62, -(2**62), 0, 5)))
    if kind == 5:
        word = chance.randbytes(4)
    return data[:at] + word + data[at + len(word) :]


def _change_table(table: pa.Table, chance: random.Random) -> tuple[pa.Table, str]:
    number = chance.randrange(table.num_columns)
    name = table.column_names[number]
    match chance.randrange(6):
        case 0:
            return table.drop_columns([name]), f"without {name}"
        case 1:
            return table.slice(chance.randrange(table.num_rows + 1)), "fewer rows"
        case 2:
            other = chance.choice(table.column_names)
            return table.set_column(number, name, table.column(other)), f"{name} as {other}"
        case 3:
            return pa.concat_tables([table] * chance.choice((2, 50))), "rows twice"
        case 4:
            kind = chance.choice(_TYPES)
            cells = [chance.choice(_CELLS) for _ in range(table.num_rows)]
            return table.set_column(number, name, pa.array(_fitting(cells, kind), kind)), f"{name} as {kind}"
        case _:
            kind = table.schema.field(name).type
            cells = table.column(name).to_pylist()
            for _ in range(min(len(cells), chance.choice((1, 3)))):
                cells[chance.randrange(len(cells))] = chance.choice(_CELLS)
            return table.set_column(number, name, pa.array(_fitting(cells, kind), kind)), f"values of {name}"


def _fitting(cells: list[Any], kind: pa.DataType) -> list[Any]:
    """Replace each value that a column of this type cannot hold with null."""
    found = []
    for cell in cells:
        try:
            pa.array([cell], kind)
            found.append(cell)
        except (pa.ArrowException, TypeError, ValueError, OverflowError):
            found.append(None)
    return found


def _change_hdf5(file: h5py.File, chance: random.Random) -> str:
    """Change an open file; return a description. Changes that the library refuses have no effect."""
    try:
        return _changed_hdf5(file, chance)
    except (OSError, ValueError, RuntimeError, KeyError, TypeError) as error:
        return f"nothing ({error})"


def _changed_hdf5(file: h5py.File, chance: random.Random) -> str:
    places: list[str] = []
    file.visit(places.append)
    place = chance.choice(places)
    match chance.randrange(6):
        case 0:
            del file[place]
            return f"without {place}"
        case 1:
            del file[place]
            shape = chance.choice(((), (0,), (5,), (5, 7), (5, 0), (5, 5000), (5, 2, 2), (5, 48, 64, 3), (5, 48, 64)))
            file[place] = np.zeros(shape, chance.choice(("u1", "i8", "f2", "f4", ">f8", "?", "c8", "S3", "u2")))
            return f"{place} of {shape}"
        case 2:
            owner = file[chance.choice((place, "data", "/"))]
            value = chance.choice(
                (0, -1, 1e300, np.nan, "", "x" * 60_000, "{" * 5000, b"\xff", np.zeros(3), np.inf, True)
            )
            name = chance.choice(("env_args", "num_samples", "model_file", "fps", "success", "x", "names"))
            owner.attrs[name] = value
            return f"{name} of {owner.name}"
        case 3:
            parent = chance.choice([name for name in places if isinstance(file.get(name), h5py.Group)])
            file[f"{parent}/again"] = chance.choice(
                (h5py.SoftLink("/data"), h5py.ExternalLink("/etc/passwd", "/"), file[place])
            )
            return f"a link in {parent}"
        case 4:
            other = chance.choice(places)
            if other != place and not other.startswith(place) and not place.startswith(other):
                del file[place]
                file[place] = file[other]
            return f"{place} as {other}"
        case _:
            found = file[place]
            if isinstance(found, h5py.Dataset) and found.dtype.kind == "f" and found.size:
                found[(0,) * found.ndim] = chance.choice((np.nan, np.inf, 1e300, -0.0))
            return f"a value of {place}"
