"""Datasets, HDF5 files and mappings of less than a megabyte that claim very much: a sentence, little memory and time.

What is honest and large is read as before: the last tests.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from support.foreign_dataset import DATA, EPISODES, TASKS, write_foreign
from support.fuzz import LimitedCommands, problem_of

from demorec.core.errors import ExportError
from demorec.datasets.hdf5.foreign import ForeignFile
from demorec.datasets.lerobot.files import read_table
from demorec.datasets.lerobot.mp4_index import check_video
from demorec.datasets.lerobot.pages import longest_row, pages_of

pytestmark = pytest.mark.slow

_MODULES = (
    "demorec.check.run",
    "demorec.sources.dataset_import",
    "demorec.sources.hdf5_import",
    "demorec.report.gather",
)


@pytest.fixture(scope="module")
def commands() -> Iterator[LimitedCommands]:
    with LimitedCommands(_MODULES) as process:
        yield process


def _told(commands: LimitedCommands, *arguments: str | Path) -> str:
    told = commands.run(*arguments)
    assert not problem_of(told), (problem_of(told), told.text[-500:])
    assert told.code in (0, 1, 2)
    assert len(told.text) < 6000
    return told.text


def _set_column(path: Path, name: str, values: Any) -> None:
    table = pq.read_table(path)
    changed = table.set_column(table.column_names.index(name), name, values)
    pq.write_table(changed, path, compression="zstd")


def one_long_task(root: Path) -> None:
    """A text of 200 MB."""
    pq.write_table(pa.table({"task": ["x" * 200_000_000], "task_index": [0]}), root / TASKS, compression="zstd")


def a_long_task_again_and_again(root: Path) -> None:
    """One text of 20 MB in a dictionary, 64 times."""
    text = pa.DictionaryArray.from_arrays(pa.array(np.zeros(64, np.int8)), ["x" * 20_000_000])
    pq.write_table(pa.table({"task": text, "task_index": np.arange(64)}), root / TASKS, compression="zstd")


def long_tasks_in_a_list(root: Path) -> None:
    """One text of 10 MB, a hundred times in one row: Arrow reads no part of a row."""
    _set_column(root / EPISODES, "tasks", pa.array([["x" * 10_000_000] * 100, []], pa.list_(pa.string())))


def a_footer_that_says_little(root: Path) -> None:
    """Pages of 200 MB, of which the footer says that they are small."""
    one_long_task(root)
    data = (root / TASKS).read_bytes()
    said = pq.ParquetFile(root / TASKS).metadata.row_group(0).column(0).total_uncompressed_size

    def varint(number: int) -> bytes:
        found = b""
        while number > 127:
            found += bytes([number & 127 | 128])
            number >>= 7
        return found + bytes([number])

    large = varint(2 * said)
    small = varint(2 * 1000)[:-1] + b"\x8f" + b"\x80" * (len(large) - 3) + b"\x00"
    head, footer = data[: -len(data) // 4], data[-len(data) // 4 :]
    assert large in footer
    (root / TASKS).write_bytes(head + footer.replace(large, small))
    assert pq.ParquetFile(root / TASKS).metadata.row_group(0).column(0).total_uncompressed_size < 10**6


def rows_of_millions_of_numbers(root: Path) -> None:
    _set_column(root / DATA, "action", pa.array([np.zeros(3_000_000, np.float32)] * 16, pa.list_(pa.float32())))


def features_of_very_many_numbers(root: Path) -> None:
    info = json.loads((root / "meta/info.json").read_text())
    for name in ("observation.state", "action", "observation.more"):
        info["features"][name] = {"dtype": "float32", "shape": [1 << 24], "names": None}
    (root / "meta/info.json").write_text(json.dumps(info))


@pytest.mark.parametrize(
    "claim",
    [
        pytest.param(one_long_task, marks=pytest.mark.slow),
        a_long_task_again_and_again,
        pytest.param(long_tasks_in_a_list, marks=[pytest.mark.slow, pytest.mark.long]),
        pytest.param(a_footer_that_says_little, marks=pytest.mark.long),
        rows_of_millions_of_numbers,
        features_of_very_many_numbers,
    ],
)
def test_a_dataset_claims_very_much(claim: Callable[[Path], None], commands: LimitedCommands, tmp_path: Path) -> None:
    root = write_foreign(tmp_path / "dataset")
    claim(root)
    assert sum(path.stat().st_size for path in root.rglob("*") if path.is_file()) < 1_000_000
    _told(commands, "info", root)
    _told(commands, "report", root, "--out", tmp_path / "report.html")
    _told(commands, "check", root, "--only", "dataset_readable", "dataset_counts", "dataset_schema")
    said = _told(commands, "import", "lerobot", root, "--out", tmp_path / "run")
    assert said.startswith("demorec import: The ")
    assert len(said.splitlines()) == 1


def test_large_images_in_a_small_table(commands: LimitedCommands, tmp_path: Path) -> None:
    root = write_foreign(tmp_path / "large", length=200, size=(4000, 4000))
    assert (root / DATA).stat().st_size < 100_000
    said = _told(commands, "import", "lerobot", root, "--out", tmp_path / "run")
    assert "4000x4000 pixels in" in said
    root = write_foreign(tmp_path / "many", length=2000, size=(640, 480))
    said = _told(commands, "import", "lerobot", root, "--out", tmp_path / "other")
    assert "are too many for files of this size" in said


MAPPING = """
[robot]
name = "r"
[task]
text = "t"
[clock]
fps = 20
[episodes]
group = "data"
[[features."observation.state"]]
dataset = "state"
[[features.action]]
dataset = "action"
"""


def _episode(file: h5py.File, rows: int = 5, **options: Any) -> h5py.Group:
    group = file.create_group("data/demo_0")
    for name in ("state", "action"):
        group.create_dataset(name, data=np.zeros((rows, 2), np.float32), **options)
    return group


def groups_in_circles(file: h5py.File) -> None:
    groups = [_episode(file), *(file["data/demo_0"].create_group(f"g{number}") for number in range(40))]
    for group in groups:
        for number, other in enumerate(groups):
            group[f"to_{number}"] = other


def thousands_of_attributes(file: h5py.File) -> None:
    group = _episode(file)
    for number in range(3000):
        group.attrs[f"a{number}"] = number


def rows_of_zeros(file: h5py.File) -> None:
    _episode(file, 1_500_000, compression="gzip", chunks=(100_000, 2))


def one_episode_by_many_names(file: h5py.File) -> None:
    group = _episode(file)
    for number in range(1, 8000):
        file[f"data/demo_{number}"] = group


@pytest.mark.parametrize(
    ("claim", "said"),
    [
        (groups_in_circles, "1 episode, 5 frames"),
        (thousands_of_attributes, "1 episode, 5 frames"),
        (rows_of_zeros, "too many for a file of its size"),
        (one_episode_by_many_names, "the same group as data/demo_0"),
    ],
)
def test_an_hdf5_file_claims_very_much(
    claim: Callable[[h5py.File], None], said: str, commands: LimitedCommands, tmp_path: Path
) -> None:
    path, mapping = tmp_path / "file.hdf5", tmp_path / "mapping.toml"
    mapping.write_text(MAPPING)
    with h5py.File(path, "w", libver="latest") as file:
        claim(file)
    assert path.stat().st_size < 1_000_000
    _told(commands, "import", "hdf5", path, "--suggest")
    assert said in _told(commands, "import", "hdf5", path, "--mapping", mapping, "--out", tmp_path / "run")


@pytest.mark.parametrize("version", ["1.0", "2.0"])
@pytest.mark.parametrize("codec", ["none", "snappy", "zstd", "gzip", "brotli", "lz4"])
def test_the_longest_row_is_that_of_the_table(codec: str, version: Any, tmp_path: Path) -> None:
    """Of lists, and of lists of lists, over several pages and row groups."""
    random = np.random.default_rng(0)
    rows = [["t" * int(random.integers(1, 50))] * int(random.integers(0, 9)) for _ in range(5000)]
    rows[77] = ["abc"] * 1234
    table = pa.table({"x": pa.array(rows), "y": pa.array([[row, row[:3]] for row in rows])})
    path = tmp_path / "t.parquet"
    pages: dict[str, Any] = {"data_page_version": version, "data_page_size": 2000}
    pq.write_table(table, path, 3000, compression=codec, **pages)
    metadata = pq.ParquetFile(path).metadata
    with path.open("rb") as file:
        for depth in (1, 2):
            for number, part in enumerate((rows[:3000], rows[3000:])):
                lists = part if depth == 1 else [row + row[:3] for row in part]
                expected = max(len(text) for row in part for text in row) * max(max(1, len(row)) for row in lists)
                assert longest_row(file, metadata.row_group(number).column(depth - 1), depth) == expected
    assert read_table(path).equals(table)


def test_what_is_large_and_honest_is_read(tmp_path: Path) -> None:
    """Texts that every row repeats, images, and an hour of joints at 200 Hz."""
    rows = 5_000
    said = [[f"the robot does {number % 7}" * 5] * 30 for number in range(rows)]
    noise = np.random.default_rng(0).bytes(300_000)
    table = pa.table(
        {
            "said": pa.array(said),
            "state": pa.array(list(np.random.default_rng(0).normal(size=(rows, 7)))),
            "image": pa.array([noise[n % 100 :] for n in range(200)] + [None] * (rows - 200), pa.binary()),
        }
    )
    pq.write_table(table, tmp_path / "t.parquet")
    assert read_table(tmp_path / "t.parquet").equals(table)
    with h5py.File(tmp_path / "f.hdf5", "w") as file:
        states = np.random.default_rng(0).normal(size=(720_000, 7)).astype(np.float32)
        file.create_dataset("state", data=states, compression="gzip", compression_opts=1, chunks=(10_000, 7))
    with ForeignFile(tmp_path / "f.hdf5") as opened:
        assert len(opened.array("state")) == 720_000


@pytest.mark.parametrize(
    "header",
    [
        b"\x19" * 60_000,
        b"\x19\xf1" + b"\xff" * 8 + b"\x01",
        b"\x15\x00\x15\x02\x15\x02\x2c\x15\xfe\xff\xff\xff\x0f\x00\x00",
    ],
    ids=["lists in lists", "a list without end", "more values than the column"],
)
def test_the_header_of_a_page_claims_very_much(header: bytes, tmp_path: Path) -> None:
    """Bytes of Thrift's compact protocol: 0x19 is a list of one list, 0x1 of its elements a boolean."""
    path = tmp_path / "t.parquet"
    pq.write_table(pa.table({"x": ["a" * 100_000]}), path, compression="none", use_dictionary=False)
    place = pq.ParquetFile(path).metadata.row_group(0).column(0).data_page_offset
    data = path.read_bytes()
    path.write_bytes(data[:place] + header + data[place + len(header) :])
    column = pq.ParquetFile(path).metadata.row_group(0).column(0)
    with path.open("rb") as file, pytest.raises(ValueError, match=r"header|more values than its column"):
        list(pages_of(file, column))
    with pytest.raises(ExportError):
        read_table(path)


def test_boxes_within_boxes(tmp_path: Path) -> None:
    """3,000 of them, by ISO/IEC 14496-12: their length, their kind, what is in them."""
    path, boxes = tmp_path / "t.mp4", b""
    for _ in range(3000):
        boxes = struct.pack(">I4s", 8 + len(boxes), b"moov") + boxes
    path.write_bytes(struct.pack(">I4s", 16, b"ftyp") + b"isom\0\0\0\0" + boxes)
    check_video(path)
    path.write_bytes(path.read_bytes()[:-8] + struct.pack(">I4s", 99, b"trak"))
    with pytest.raises(ExportError, match="cut off"):
        check_video(path)


def test_whole_numbers_are_looked_at_within_bounds(commands: LimitedCommands, tmp_path: Path) -> None:
    """A column of 64 bits is looked through, whether float64 holds it; here it is one text of 50 MB in every row."""
    root = write_foreign(tmp_path / "dataset")
    info = json.loads((root / "meta/info.json").read_text())
    info["features"]["counted"] = {"dtype": "int64", "shape": [1], "names": None}
    (root / "meta/info.json").write_text(json.dumps(info))
    table = pq.read_table(root / DATA)
    text = pa.DictionaryArray.from_arrays(pa.array(np.zeros(len(table), np.int8)), ["x" * 50_000_000])
    pq.write_table(table.append_column("counted", text), root / DATA, compression="zstd")
    assert len(table) >= 16
    assert "counted" in _told(commands, "import", "lerobot", root, "--out", tmp_path / "run")
