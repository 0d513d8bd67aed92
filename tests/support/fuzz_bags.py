"""Hostile bags, each a function of its number: structurally valid, with parts exchanged, enlarged or cut off."""

from __future__ import annotations

import io
import json
import random
import shutil
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType, Writer
from PIL import Image
from rosbags.rosbag2 import StoragePlugin

from support import bag_mappings, bags
from support.fuzz import changed_bytes

_NUMBERS: tuple[Any, ...] = (
    0, -1, 1, 2**31, 2**63 - 1, 2**63, 10**19, 1e30, 1e300, float("inf"), float("-inf"), float("nan"), None, True,
    "text", "", "12", [], [1], {}, {"a": 1}, [[1.0], []], ["a", None], "\ud800", "\x00\x1b[2J\u202e", 0.5,
)  # fmt: skip
_TOML_VALUES = (
    "0", "-1", "1", "9" * 30, "9" * 5000, "1e300", "-1e300", "inf", "nan", "true", '""', '"\\u0000"', '"a\\u0000b"',
    "[]", "[[]]", "[[0, 1]]", "[[0, 1e300]]", "[[-5, 1e9]]", "{}", "{a = 1}", "2001-99-99", "2001-01-01", '"grid"',
    '"/joints"', '"/image"', '"nearest"', '"' + "a." * 3000 + '"', '["a", "a"]', "[0, 0]", "[99999]",
    '"position[0]"', '"[0][0]"', '"x[a=b]"', '"header.stamp"', '"\\u202e<script>"', '"/"', '"../../etc/passwd"', '"."',
)  # fmt: skip
_YAML_VALUES = (
    "9" * 5000, "2001-99-99", "!!int abc", "!!float x", "!!python/object:os.system a", "*a", "&a [x, x]", "{<<: *a}",
    "null", "~", "[]", "{}", "!!binary x", "!!timestamp abc", "'\\0'", '"\\0"', "0x", "[bag.mcap, bag.mcap]", "- [",
    ".inf", "!!set {a}", "!!omap [a]", "? x", "message", "file", "zstd", "../bag.mcap", '"\\x00bag.mcap"', "? {a: b}",
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
info_topic = "/info"
"""
)
_EXTRAS = (
    '[episodes]\ncut = "marker"\ntopic = "/text"\n',
    '[episodes]\ncut = "times"\ntimes_s = [[0.0, 0.2], [0.1, 0.3]]\n', '[subtasks]\ntopic = "/text"\n',
    "",
)  # fmt: skip


class FuzzedBags:
    """Cases in a folder: each number gives the same arguments of a command every time."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        notes = bags.in_order(bags.so101(0.3))
        self._plain = bags.write_mcap(notes, folder / "plain.mcap", compression="", use_chunking=False).read_bytes()
        self._chunked = bags.write_mcap(notes, folder / "chunked.mcap").read_bytes()
        self._trossen = bags.write_trossen(bags.in_order(bags.trossen(0.3)), folder / "trossen.mcap").read_bytes()
        self._ros1 = bags.write_ros1(notes, folder / "plain.bag").read_bytes()
        rosbag2 = bags.write_rosbag2(notes, folder / "rosbag2", storage=StoragePlugin.SQLITE3)
        self._db3 = next(rosbag2.glob("*.db3")).read_bytes()
        self._metadata = (rosbag2 / "metadata.yaml").read_text()
        moment = bags.EPOCH_NS
        still = bags.image(moment, 0)
        self._jpeg, self._still = bags.jpeg(still), still
        png = io.BytesIO()
        Image.fromarray(still).save(png, format="PNG")
        self._coded = {
            "jpeg": self._jpeg,
            "png": png.getvalue(),
            "h264": bags.video([still], gop=1)[0],
            "h265": bags.video([still], gop=1, codec="libx265")[0],
            "av1": b"\x12\x00\x0a\x0b\x00\x00\x00\x24\xcf\x7f\x0d\xbf\xff\x38\x18" + bytes(40),
            "16UC1; compressedDepth": bytes(12) + png.getvalue(),
            "16UC1; compressedDepth rvl": bytes(12) + struct.pack("<II", 64, 48) + bytes(200),
        }

    def clear(self) -> None:
        """Remove the run that a command has made."""
        shutil.rmtree(self.folder / "run", ignore_errors=True)

    def case(self, number: int) -> tuple[str, list[str]]:
        """Description of the case, and the arguments of `demorec`."""
        chance = random.Random(number)
        kinds: tuple[Callable[[random.Random, Path], tuple[Path, str]], ...] = (
            self._bytes, self._ros1_bytes, self._database_bytes, self._yaml, self._toml,
            self._json, self._json, self._image, self._image,
        )  # fmt: skip
        make = kinds[number % len(kinds)]
        bag, mapping = make(chance, self.folder)
        if chance.random() < 0.4:
            return make.__name__, ["import", "--suggest", str(bag)]
        path = self.folder / "mapping.toml"
        path.write_text(mapping, encoding="utf-8", errors="replace")
        return make.__name__, ["import", str(bag), "--mapping", str(path), "--out", str(self.folder / "run")]

    def _bytes(self, chance: random.Random, folder: Path) -> tuple[Path, str]:
        data, mapping = chance.choice(
            (
                (self._plain, bag_mappings.SO101),
                (self._chunked, bag_mappings.SO101),
                (self._trossen, bag_mappings.TROSSEN),
            )
        )
        path = folder / "bytes.mcap"
        path.write_bytes(changed_bytes(data, chance))
        return path, mapping

    def _ros1_bytes(self, chance: random.Random, folder: Path) -> tuple[Path, str]:
        path = folder / "bytes.bag"
        path.write_bytes(self._ros1[:13] + changed_bytes(self._ros1[13:], chance))
        return path, bag_mappings.SO101

    def _database_bytes(self, chance: random.Random, folder: Path) -> tuple[Path, str]:
        data = self._db3 if chance.random() < 0.7 else self._db3[: int(len(self._db3) * chance.random())]
        path = folder / "bytes.db3"
        path.write_bytes(b"SQLite format 3\0" + changed_bytes(data, chance)[16:])
        return path, bag_mappings.SO101

    def _yaml(self, chance: random.Random, folder: Path) -> tuple[Path, str]:
        bag = folder / "folder"
        bag.mkdir(exist_ok=True)
        (bag / "rosbag2.db3").write_bytes(self._db3)
        lines = self._metadata.splitlines()
        for _ in range(chance.choice((1, 1, 3))):
            at = chance.randrange(len(lines))
            key, colon, _ = lines[at].partition(": ")
            lines[at] = key + (colon or " ") + chance.choice(_YAML_VALUES)
            if chance.random() < 0.2:
                lines.insert(at, chance.choice(("a: &a [b, b]", "  x: &a {b: c}", "\t", "%YAML 9.9", "---", "...")))
        (bag / "metadata.yaml").write_text("\n".join(lines))
        return bag, bag_mappings.SO101

    def _toml(self, chance: random.Random, folder: Path) -> tuple[Path, str]:
        lines = (MAPPING + chance.choice(_EXTRAS)).splitlines()
        keys = (
            "urdf", "urdf_topic", "max_age_s", "max_trim_s", "stamp", "sample", "rows", "elements", "names", "joints",
            "unit", "to", "prefix", "times_s", "when_old", "fps", "field", "cut",
        )  # fmt: skip
        for _ in range(chance.choice((1, 1, 2, 4))):
            at = chance.randrange(len(lines))
            value = chance.choice(_TOML_VALUES)
            if chance.random() < 0.5:
                lines[at] = f"{lines[at].partition('=')[0] or 'x'}= {value}"
            elif chance.random() < 0.9:
                lines.insert(at + 1, f"{chance.choice(keys)} = {value}")
            else:
                lines.insert(
                    at + 1, chance.choice(("[" + "a." * 5000 + "a]", "[[features.x]]", "[features]", "a.b = 1"))
                )
        return self._json_bag(folder, lambda topic, values: values), "\n".join(lines)

    def _json(self, chance: random.Random, folder: Path) -> tuple[Path, str]:
        topic = chance.choice(("/joints", "/image", "/info", "/text"))
        spoilt = [chance.choice(_NUMBERS) for _ in range(3)]
        how = chance.randrange(4)

        def change(name: str, values: Any) -> Any:
            if name != topic or (how == 3 and chance.random() < 0.5):
                return values
            inner = values
            while True:
                key = chance.choice(list(inner))
                if isinstance(inner[key], dict) and inner[key] and chance.random() < 0.7:
                    inner = inner[key]
                    continue
                inner[key] = chance.choice(spoilt)
                return values

        return self._json_bag(folder, change), MAPPING + chance.choice(_EXTRAS)

    def _json_bag(self, folder: Path, change: Callable[[str, Any], Any]) -> Path:
        import base64

        path = folder / "json.mcap"
        with path.open("wb") as file:
            writer = Writer(file, compression=CompressionType.NONE)
            writer.start()
            channels = {
                name: writer.register_channel(name, "json", 0) for name in ("/joints", "/image", "/info", "/text")
            }
            for number in range(12):
                moment = bags.EPOCH_NS + number * bags.NS // 30
                stamp = {"sec": moment // bags.NS, "nsec": moment % bags.NS}
                header = {"stamp": stamp, "frame_id": "camera"}
                coded = base64.b64encode(self._still.tobytes()).decode()
                for name, values in (
                    ("/joints", {"header": dict(header), "name": ["a", "b"], "position": [0.1 * number, 0.2]}),
                    ("/image", {"header": dict(header), "encoding": "rgb8", "width": bags.WIDTH, "height": bags.HEIGHT,
                                "step": 3 * bags.WIDTH, "is_bigendian": 0, "data": coded}),
                    ("/info", {"header": dict(header), "width": 64, "height": 48, "D": [0.0] * 5,
                               "K": [60.0, 0, 32, 0, 60.0, 24, 0, 0, 1]}),
                    ("/text", {"header": dict(header), "data": ("start", "stop")[number // 2 % 2], "info":
                               {"event_type": number % 4, "sequence_number": number, "client_gid": "g"}}),
                ):  # fmt: skip
                    values["header"]["stamp"] = dict(stamp)  # type: ignore[index]
                    text = json.dumps(change(name, values))
                    writer.add_message(channels[name], moment, text.encode(errors="replace"), moment)
            writer.finish()
        return path

    def _image(self, chance: random.Random, folder: Path) -> tuple[Path, str]:
        name, data = chance.choice(sorted(self._coded.items()))
        told = chance.choice(
            (name, name, name, "jpeg", "h264", "h265", "av1", "zstd: 64", "", "\x00", "16UC1; compressedDepth")
        )
        notes = bags.joints("/joints", ("a", "b"), bags.times(50, 0.3))
        is_raw = chance.random() < 0.3
        encoding = chance.choice(("rgb8", "mono8", "bayer_rggb8", "uyvy", "16UC1", "32FC1", "x", ""))
        width, height, step = (chance.choice((64, 48, 0, 1, 2, 3, 2**31, 2**32 - 1, 4000)) for _ in range(3))
        for moment in bags.times(30, 0.3):
            body: dict[str, Any] = {
                "format": told,
                "data": np.frombuffer(changed_bytes(data, chance) if chance.random() < 0.8 else data, np.uint8),
            }
            if is_raw:
                pixels = np.frombuffer(self._still.tobytes()[: chance.choice((0, 100, 9216))], np.uint8)
                body = {"encoding": encoding, "width": width, "height": height, "step": step, "data": pixels}
            kind = "sensor_msgs/msg/Image" if is_raw else "sensor_msgs/msg/CompressedImage"
            notes.append(bags.Note(topic="/image", type=kind, log_ns=moment, header_ns=moment, body=body))
        path = bags.write_mcap(bags.in_order(notes), folder / "image.mcap")
        return path, MAPPING.replace('info_topic = "/info"\n', "")
