"""HDF5 files that the HDF5 library cannot refuse: one sentence, where it would end or keep the process.

The damage is made here, in the global heap, where texts of attributes are (HDF5 File Format Specification, III.E): a
reference to a text is its length, the address of a collection, and a number in it.
"""

from __future__ import annotations

import json
import struct
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import h5py
import pytest
from support.fuzz import LimitedCommands
from support.hdf5 import write_robomimic

_SIZE_OF_FIRST = 24
"""Where a collection says how long its first object is: after its own head (16), number, references and reserved."""


@pytest.fixture(scope="module")
def commands() -> Iterator[LimitedCommands]:
    with LimitedCommands(("demorec.sources.hdf5_suggest",)) as process:
        yield process


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


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.timeout(400)
def test_a_file_with_which_the_library_never_ends(file: Path, commands: LimitedCommands) -> None:
    data = bytearray(file.read_bytes())
    assert data[heap_of(data) + _SIZE_OF_FIRST + 1] == 0
    data[heap_of(data) + _SIZE_OF_FIRST + 1] = 1
    file.write_bytes(data)
    reading = f"import h5py; h5py.File({str(file)!r})['data'].attrs['env_args']"
    with pytest.raises(subprocess.TimeoutExpired):
        subprocess.run([sys.executable, "-c", reading], check=True, timeout=8)
    said = commands.refused("import", "hdf5", file, "--suggest")
    assert " s of CPU time" in said
    assert said.count("\n") == 1
