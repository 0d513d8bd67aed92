"""Hostile inputs, each a function of its number: valid files of every format with a few parts changed.

Bytes are changed in files, values in JSON and tables, and lines in TOML and YAML.
"""

from __future__ import annotations

import base64
import copy
import io
import json
import random
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from mcap.writer import Writer
from PIL import Image
from rosbags.rosbag2 import StoragePlugin

from demorec.extensions.imports.dataset_import import import_lerobot
from demorec.mcap import Recording
from demorec.render.raster.renderer import warm_up
from support import bag_mappings, bags, hdf5
from support.export import export
from support.external import write_external
from support.foreign_dataset import write_foreign
from support.fuzz import changed_bytes
from support.generate import run_fake
from support.mcap import rewritten
from support.recording import write_episode

_VALUES: tuple[Any, ...] = (
    None, True, False, 0, -1, 1, 0.5, 2**31, 2**63, 2**64, 10**30, -(10**30), 1e300, float("inf"), float("nan"),
    "", "text", "0", "\x00", "a\x00b", "\ud800", "\x1b[2J\u202e<script>", "../../etc/passwd", "/dev/zero",
    "{chunk_index}", "{x}", "{", "data/{chunk_index:09999d}.parquet", "data/{file_index!r}", [], [[]], [None],
    ["a", "a"], "x" * 100_000,
    [0] * 3, [1 << 24], [-1], [1e300], ["x"] * 5000, {}, {"a": 1}, {"": {}}, {"bytes": "x"}, [[1.0], []], [{}] * 2000,
)  # fmt: skip
_COLUMNS = tuple(
    pa.array([value] * 3, kind)
    for kind, value in (
        (pa.int64(), 2**62), (pa.float32(), float("nan")), (pa.bool_(), True), (pa.string(), "x" * 10_000),
        (pa.binary(), b"\x89PNG"), (pa.null(), None), (pa.list_(pa.float32()), []), (pa.list_(pa.string()), ["x"]),
        (pa.struct([("bytes", pa.binary()), ("path", pa.string())]), {"bytes": None, "path": "/etc/passwd"}),
        (pa.list_(pa.struct([("role", pa.string())])), [{"role": "x"}]), (pa.timestamp("ns"), 0),
    )
)  # fmt: skip
_TOML = (
    "0", "-1", "1", "9" * 5000, "1e300", "inf", "nan", "true", '""', '"a\\u0000b"', "[]", "[[]]", "[[0, 1e300]]", "{}",
    "2001-99-99", '"grid"', '"/joints"', '"nearest"', '"' + "a." * 3000 + '"', '["a", "a"]', "[0, 0]", "[99999]",
    '"position[0]"', '"x[a=b]"', '"\\u202e<script>"', '"../../etc/passwd"',
)  # fmt: skip
_YAML = (
    "9" * 5000, "2001-99-99", "!!int abc", "!!python/object:os.system a", "*a", "&a [x, x]", "{<<: *a}", "null", "[]",
    "{}", "!!binary x", '"\\0"', "[bag.mcap, bag.mcap]", "- [", ".inf", "!!set {a}", "? x", "message", "zstd",
    "../bag.mcap",
)  # fmt: skip
MAPPING = (
    bag_mappings.HEAD.format(robot="r")
    + """
[[features."observation.state"]]
topic = "/joints"
field = "position"
[[features.action]]
next = "observation.state"
[cameras.front]
topic = "/image"
"""
)
_HDF5_MAPPING = """
[robot]
name = "panda"
[task]
text = "lift"
[clock]
fps = 20
[episodes]
group = "data"
success = "rewards"
[[features."observation.state"]]
dataset = "obs/robot0_joint_pos"
elements = [0, 1, 2]
[[features.action]]
dataset = "actions"
[cameras.front]
dataset = "obs/agentview_image"
"""
_IMAGE_FORMATS = ("jpeg", "png", "h264", "h265", "av1", "16UC1; compressedDepth", "16UC1; compressedDepth rvl", "\x00")
_POLICY: dict[str, Any] = {
    "type": "act",
    "input_features": {
        "observation.images.front": {"type": "VISUAL", "shape": [3, 96, 96]},
        "observation.state": {"type": "STATE", "shape": [8]},
    },
    "output_features": {"action": {"type": "ACTION", "shape": [8]}},
    "chunk_size": 8,
}
_STEPS: dict[str, Any] = {"name": "x", "steps": [{"registry_name": "rename"}, {"class": "os.path.join", "config": {}}]}
Words = list[object]
"""A command and its arguments."""


class Fuzzed:
    """Cases in a folder: each number gives the same arguments of a command every time."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        warm_up()  # compile once, at no command's expense
        notes = bags.in_order(bags.so101(0.3))
        rosbag2 = bags.write_rosbag2(notes, folder / "rosbag2", storage=StoragePlugin.SQLITE3)
        self._metadata = (rosbag2 / "metadata.yaml").read_text()
        self._bags = (
            (bags.write_mcap(notes, folder / "plain.mcap", compression="", use_chunking=False), bag_mappings.SO101),
            (bags.write_mcap(notes, folder / "chunked.mcap"), bag_mappings.SO101),
            (bags.write_trossen(bags.in_order(bags.trossen(0.3)), folder / "trossen.mcap"), bag_mappings.TROSSEN),
            (bags.write_ros1(notes, folder / "ros1.bag"), bag_mappings.SO101),
            (next(rosbag2.glob("*.db3")), bag_mappings.SO101),
        )
        still = bags.image(bags.EPOCH_NS, 0)
        png = io.BytesIO()
        Image.fromarray(still).save(png, format="PNG")
        self._images = (
            bags.jpeg(still), png.getvalue(), bytes(12) + png.getvalue(), bags.video([still], gop=1)[0],
            bags.video([still], gop=1, codec="libx265")[0],
        )  # fmt: skip
        self._good = write_episode(folder / "good.mcap", num_frames=12, cameras=("front",))
        self._external = write_external(folder / "collected.mcap")
        export(self._good, folder / "own")
        write_foreign(folder / "foreign")
        run_fake(folder / "simulated", num_episodes=2, workers=0)
        import_lerobot([folder / "foreign"], None, folder / "imported")
        hdf5.write_robomimic(folder / "robomimic.hdf5")

    def clear(self) -> None:
        for path in self.folder.glob("out*"):
            shutil.rmtree(path) if path.is_dir() else path.unlink()

    def case(self, number: int) -> tuple[str, list[str]]:
        """Description of the change, and the arguments of the command that reads it."""
        chance = random.Random(number)
        makers: tuple[Callable[[random.Random], Words], ...] = (
            self._bag, self._rosbag2, self._mapping, self._messages, self._image, self._dataset, self._hdf5,
            self._recording, self._run, self._policy,
        )  # fmt: skip
        make = makers[number % len(makers)]
        return make.__name__, list(map(str, make(chance)))

    def _imported(self, bag: Path, mapping: str, chance: random.Random) -> Words:
        path = self.folder / "mapping.toml"
        path.write_text(mapping, encoding="utf-8", errors="replace")
        return ["import", bag, *self._mapped(path, chance)]

    def _mapped(self, mapping: Path, chance: random.Random) -> Words:
        return ["--suggest"] if chance.random() < 0.4 else ["--mapping", mapping, "--out", self.folder / "out"]

    def _bag(self, chance: random.Random) -> Words:
        source, mapping = chance.choice(self._bags)
        path, data = self.folder / f"changed{source.suffix}", source.read_bytes()
        path.write_bytes(data[:16] + changed_bytes(data[16:], chance))
        return self._imported(path, mapping, chance)

    def _rosbag2(self, chance: random.Random) -> Words:
        bag = self.folder / "folder"
        bag.mkdir(exist_ok=True)
        shutil.copy(self._bags[-1][0], bag / "rosbag2.db3")
        (bag / "metadata.yaml").write_text(_changed_lines(self._metadata, ": ", _YAML, chance))
        return self._imported(bag, bag_mappings.SO101, chance)

    def _mapping(self, chance: random.Random) -> Words:
        keys = chance.choice(("", "max_trim_s = 1\n", 'stamp = "log"\n'))
        text = MAPPING.replace("fps = 30\n", f"fps = 30\n{keys}")
        return self._imported(
            self._json_bag(lambda topic, values: None), _changed_lines(text, "= ", _TOML, chance), chance
        )

    def _messages(self, chance: random.Random) -> Words:
        wanted = chance.choice(("/joints", "/image"))

        def change(topic: str, values: Any) -> None:
            if topic == wanted and chance.random() < 0.7:
                _change_json(values, chance)

        return self._imported(self._json_bag(change), MAPPING, chance)

    def _json_bag(self, change: Callable[[str, Any], None]) -> Path:
        """Write a bag of JSON messages, each of which `change` may change."""
        path = self.folder / "json.mcap"
        pixels = base64.b64encode(bags.image(bags.EPOCH_NS, 0).tobytes()).decode()
        with path.open("wb") as file:
            writer = Writer(file)
            writer.start()
            channels = {name: writer.register_channel(name, "json", 0) for name in ("/joints", "/image")}
            for number in range(12):
                moment = bags.EPOCH_NS + number * bags.NS // 30
                for name, fields in (
                    ("/joints", {"name": ["a", "b"], "position": [0.1 * number, 0.2]}),
                    ("/image", {"encoding": "rgb8", "width": bags.WIDTH, "height": bags.HEIGHT, "data": pixels}),
                ):
                    values = {"header": {"stamp": {"sec": moment // bags.NS, "nsec": moment % bags.NS}}, **fields}
                    change(name, values)
                    writer.add_message(channels[name], moment, json.dumps(values).encode(errors="replace"), moment)
            writer.finish()
        return path

    def _image(self, chance: random.Random) -> Words:
        data, form = chance.choice(self._images), chance.choice(_IMAGE_FORMATS)
        sizes = [chance.choice((64, 48, 0, 1, 3, 2**31, 2**32 - 1)) for _ in range(3)]
        is_raw, encoding = chance.random() < 0.3, chance.choice(("rgb8", "bayer_rggb8", "uyvy", "16UC1", "32FC1", "x"))

        def body(_: int) -> dict[str, Any]:
            pixels = np.frombuffer(changed_bytes(data, chance), np.uint8)
            if is_raw:
                return {"encoding": encoding, "width": sizes[0], "height": sizes[1], "step": sizes[2], "data": pixels}
            return {"format": form, "data": pixels}

        kind = f"sensor_msgs/msg/{'Image' if is_raw else 'CompressedImage'}"
        notes = bags.joints("/joints", ("a", "b"), bags.times(50, 0.3))
        notes += bags.messages("/image", kind, bags.times(30, 0.3), body)
        bag = bags.write_mcap(bags.in_order(notes), self.folder / "image.mcap")
        return self._imported(bag, MAPPING, chance)

    def _dataset(self, chance: random.Random) -> Words:
        root = self.folder / "dataset"
        shutil.rmtree(root, ignore_errors=True)
        shutil.copytree(self.folder / chance.choice(("own", "foreign", "foreign")), root)
        file = chance.choice(sorted(path for path in root.rglob("*") if path.suffix in (".json", ".parquet", ".mp4")))
        _change(root / "meta" / "info.json" if chance.random() < 0.4 else file, chance)
        commands: tuple[Words, ...] = (
            ["info", root], ["import", "lerobot", root, "--out", self.folder / "out"],
            ["check", root], ["report", root, "--out", self.folder / "out.html"],
            ["export", "lerobot", self._good, "--out", root, "--append", "--no-verify"],
            ["view", root, "--save", self.folder / "out.rrd"],
            ["generate", "--config", root, "--out", self.folder / "out", "--workers", "0"],
        )  # fmt: skip
        return chance.choice(commands)

    def _hdf5(self, chance: random.Random) -> Words:
        path, mapping = self.folder / "changed.hdf5", self.folder / "mapping.toml"
        shutil.copy(self.folder / "robomimic.hdf5", path)
        if chance.random() < 0.4:
            path.write_bytes(changed_bytes(path.read_bytes(), chance))
        else:
            with h5py.File(path, "r+") as file:
                _change_hdf5(file, chance)
        mapping.write_text(_HDF5_MAPPING)
        return ["import", "hdf5", path, *self._mapped(mapping, chance)]

    def _recording(self, chance: random.Random) -> Words:
        path = self.folder / "changed.mcap"
        with Recording(self._good) as recording:
            wanted = chance.choice(sorted(recording.topics))
            metadata = recording._container.metadata("demorec.episode") or {}
        match chance.randrange(3):
            case 0:
                data = json.loads(metadata["info"])
                _change_json(data, chance)
                path.write_bytes(rewritten(self._good, change={"demorec.episode": {"info": json.dumps(data)}}))
            case 1:

                def spoilt(topic: str, data: bytes) -> bytes:
                    return changed_bytes(data, chance) if topic == wanted else data

                path.write_bytes(rewritten(self._good, messages=spoilt))
            case _:
                source = chance.choice((self._good, self._external))
                path.write_bytes(changed_bytes(source.read_bytes(), chance))
        commands: tuple[Words, ...] = (
            ["info", path], ["check", path], ["report", path, "--out", self.folder / "out.html"],
            ["view", path, "--save", self.folder / "out.rrd"],
            ["export", "lerobot", path, "--out", self.folder / "out", "--no-verify", "--privileged"],
            ["export", "hdf5", path, "--out", self.folder / "out.hdf5"],
            ["recover", path, "--out", self.folder / "out.mcap"], ["replay", path],
            ["render", path, "--cameras", "front", "--width", "32", "--height", "32", "--workers", "1",
             "--out", self.folder / "out.mcap"],
        )  # fmt: skip
        return chance.choice(commands)

    def _run(self, chance: random.Random) -> Words:
        root = self.folder / "changed"
        shutil.rmtree(root, ignore_errors=True)
        shutil.copytree(self.folder / chance.choice(("simulated", "imported")), root)
        _change(root / "run.json", chance)
        commands: tuple[Words, ...] = (
            ["info", root], ["info", root, "--json"], ["report", root, "--out", self.folder / "out.html"],
            ["export", "hdf5", root, "--out", self.folder / "out.hdf5"],
            ["import", "lerobot", self.folder / "foreign", "--out", root],
        )  # fmt: skip
        return chance.choice(commands)

    def _policy(self, chance: random.Random) -> Words:
        root = self.folder / "policy"
        root.mkdir(exist_ok=True)
        for name, data in (
            ("config.json", _POLICY), ("policy_preprocessor.json", _STEPS),
            ("train_config.json", {"dataset": {"root": str(self.folder / "nowhere")}}),
        ):  # fmt: skip
            (root / name).write_text(json.dumps(data))
        file = chance.choice(sorted(root.glob("*.json")))
        _change(file, chance)
        return ["evaluate", "--policy", root, "--action", "joint", "--out", self.folder / "out", "--num-episodes", "1"]


def _changed_lines(text: str, separator: str, values: Sequence[str], chance: random.Random) -> str:
    """Copy TOML or YAML with another value in one to three lines."""
    lines = text.splitlines()
    for _ in range(chance.choice((1, 1, 3))):
        at = chance.randrange(len(lines))
        lines[at] = (lines[at].partition(separator)[0] or "x") + separator + chance.choice(values)
    return "\n".join(lines)


def _change(file: Path, chance: random.Random) -> None:
    """Change a file in place: values in JSON, a column of a table, bytes of others."""
    if file.suffix == ".json" and chance.random() < 0.85:
        data = json.loads(file.read_text())
        for _ in range(chance.choice((1, 1, 1, 2, 4))):
            _change_json(data, chance)
        file.write_text("[" * 100_000 + "]" * 100_000 if chance.random() < 0.03 else json.dumps(data))
    elif file.suffix == ".parquet" and chance.random() < 0.7:
        table = pq.read_table(file)
        number = chance.randrange(table.num_columns)
        column = chance.choice((*_COLUMNS, *table.columns))
        rows = pa.array(np.arange(table.num_rows) % max(1, len(column)))
        changed = table.remove_column(number)
        if chance.random() < 0.8:
            changed = table.set_column(number, table.column_names[number], column.take(rows))
        pq.write_table(changed.slice(chance.choice((0, 0, 1))), file)
    else:
        file.write_bytes(changed_bytes(file.read_bytes(), chance))


def _places(value: Any) -> list[tuple[Any, Any]]:
    """(container, key) of every value within."""
    found: list[tuple[Any, Any]] = []
    for key, child in value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ():
        found += [(value, key), *_places(child)]
    return found


def _change_json(data: Any, chance: random.Random) -> None:
    """Exchange, remove, rename or repeat one value."""
    if not (places := _places(data)):
        return
    parent, key = chance.choice(places)
    match chance.randrange(5):
        case 0:
            del parent[key]
        case 1:
            other, name = chance.choice(places)
            parent[key] = copy.deepcopy(other[name])
        case 2 if isinstance(parent, dict):
            parent[chance.choice(("x", "", "a/b", "..", "observation.x", "\x1b\u202e"))] = parent.pop(key)
        case _:
            parent[key] = copy.deepcopy(chance.choice(_VALUES))


def _change_hdf5(file: h5py.File, chance: random.Random) -> None:
    """Change an open file: remove, exchange or link one of its groups or datasets, or set an attribute."""
    places: list[str] = []
    file.visit(places.append)
    place = chance.choice(places)
    match chance.randrange(4):
        case 0:
            del file[place]
        case 1:
            del file[place]
            shape = chance.choice(((), (0,), (5,), (5, 7), (5, 0), (5, 5000), (5, 2, 2), (5, 48, 64, 3), (5, 48, 64)))
            file[place] = np.zeros(shape, chance.choice(("u1", "i8", "f2", "f4", ">f8", "?", "c8", "S3", "u2")))
        case 2:
            value = chance.choice((0, -1, 1e300, np.nan, "", "x" * 60_000, "{" * 5000, b"\xff", np.zeros(3), True))
            owner = file[chance.choice((place, "data", "/"))]
            owner.attrs[chance.choice(("env_args", "num_samples", "model_file", "fps", "success", "names"))] = value
        case _:
            file["data/again"] = chance.choice(
                (h5py.SoftLink("/data"), h5py.ExternalLink("/etc/passwd", "/"), file[place])
            )
