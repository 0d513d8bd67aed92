"""Datasets and HDF5 files of less than a megabyte that claim far more: one sentence, limited memory and CPU time.

HDF5 stores text of attributes in its global heap (HDF5 File Format Specification, III.E). A reference has a length, the
address of a collection and an index in it. The library cannot detect changes there.
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
from support.foreign_dataset import DATA, TASKS, write_foreign
from support.fuzz import LimitedCommands, problem_of
from support.hdf5 import write_robomimic

pytestmark = pytest.mark.slow

_MODULES = (
    "demorec.check.run",
    "demorec.extensions.imports.dataset_import",
    "demorec.extensions.imports.hdf5_import",
    "demorec.extensions.report.gather",
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


def rows_of_millions_of_numbers(root: Path) -> None:
    _set_column(root / DATA, "action", pa.array([np.zeros(3_000_000, np.float32)] * 16, pa.list_(pa.float32())))


def features_of_very_many_numbers(root: Path) -> None:
    info = json.loads((root / "meta/info.json").read_text())
    for name in ("observation.state", "action", "observation.more"):
        info["features"][name] = {"dtype": "float32", "shape": [1 << 24], "names": None}
    (root / "meta/info.json").write_text(json.dumps(info))


@pytest.mark.parametrize("claim", [one_long_task, rows_of_millions_of_numbers, features_of_very_many_numbers])
def test_a_dataset_with_huge_claims(claim: Callable[[Path], None], commands: LimitedCommands, tmp_path: Path) -> None:
    root = write_foreign(tmp_path / "dataset")
    claim(root)
    assert sum(path.stat().st_size for path in root.rglob("*") if path.is_file()) < 1_000_000
    _told(commands, "info", root)
    _told(commands, "report", root, "--out", tmp_path / "report.html")
    _told(commands, "check", root, "--only", "unreadable_episodes", "contradicting_counts", "table_schema")
    assert len(commands.refused("import", "lerobot", root, "--out", tmp_path / "run").splitlines()) == 1


def test_large_images_in_a_small_table(commands: LimitedCommands, tmp_path: Path) -> None:
    root = write_foreign(tmp_path / "large", length=200, size=(4000, 4000))
    assert (root / DATA).stat().st_size < 1_000_000
    _told(commands, "import", "lerobot", root, "--out", tmp_path / "run")


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
        (rows_of_zeros, "s of CPU time"),
        (one_episode_by_many_names, "data/demo_1 is a link, a type or a second name"),
    ],
)
def test_an_hdf5_file_with_huge_claims(
    claim: Callable[[h5py.File], None], said: str, commands: LimitedCommands, tmp_path: Path
) -> None:
    path, mapping = tmp_path / "file.hdf5", tmp_path / "mapping.toml"
    mapping.write_text(MAPPING)
    with h5py.File(path, "w", libver="latest") as file:
        claim(file)
    assert path.stat().st_size < 1_000_000
    _told(commands, "import", "hdf5", path, "--suggest")
    assert said in _told(commands, "import", "hdf5", path, "--mapping", mapping, "--out", tmp_path / "run")


@pytest.fixture
def file(tmp_path: Path, commands: LimitedCommands) -> Path:
    path = write_robomimic(tmp_path / "demo.hdf5")
    assert commands.run("import", "hdf5", path, "--suggest").code == 0
    return path


def heap_of(data: bytes | bytearray) -> int:
    assert data.count(b"GCOL") == 1
    return data.index(b"GCOL")


def test_a_text_that_claims_gigabytes(file: Path, commands: LimitedCommands) -> None:
    with h5py.File(file, "r") as opened:
        text = opened["data"].attrs["env_args"]
    assert json.loads(text)["env_name"] == "Lift"
    data = file.read_bytes()
    reference = struct.pack("<IQ", len(text), heap_of(data))
    assert data.count(reference) == 1
    file.write_bytes(data.replace(reference, struct.pack("<IQ", 2**31 - 1, heap_of(data))))
    assert commands.refused("import", "hdf5", file, "--suggest").count("\n") == 1
