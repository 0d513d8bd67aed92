"""HDF5 files that the HDF5 library cannot refuse: one sentence, where it would end or keep the process.

The damage is made here, in the global heap, where texts of attributes are (HDF5 File Format Specification, III.E): a
reference to a text is its length, the address of a collection, and a number in it.
"""

from __future__ import annotations

import json
import struct
import subprocess
import sys
from pathlib import Path

import h5py
import pytest
from support.commands import exit_code
from support.hdf5 import write_robomimic

from demorec.core.errors import ResourceError
from demorec.datasets.hdf5 import trial

_SIZE_OF_FIRST = 24
"""Where a collection says how long its first object is: after its own head (16), number, references and reserved."""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return write_robomimic(tmp_path / "demo.hdf5")


def heap_of(data: bytes | bytearray) -> int:
    assert data.count(b"GCOL") == 1
    return data.index(b"GCOL")


def test_a_text_that_claims_gigabytes(file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_code("import", "hdf5", file, "--suggest") == 0
    capsys.readouterr()
    with h5py.File(file, "r") as opened:
        text = opened["data"].attrs["env_args"]
    assert json.loads(text)["env_name"] == "Lift"
    data = file.read_bytes()
    reference = struct.pack("<IQ", len(text), heap_of(data))
    assert data.count(reference) == 1
    file.write_bytes(data.replace(reference, struct.pack("<IQ", 2**31 - 1, heap_of(data))))
    assert exit_code("import", "hdf5", file, "--suggest") == 1
    told = capsys.readouterr().err
    assert "it is damaged, or has texts of more than 512 MB" in told
    assert told.strip().count("\n") == 0


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.timeout(400)
def test_a_file_with_which_the_library_never_ends(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = bytearray(file.read_bytes())
    assert data[heap_of(data) + _SIZE_OF_FIRST + 1] == 0
    data[heap_of(data) + _SIZE_OF_FIRST + 1] = 1
    file.write_bytes(data)
    reading = f"import h5py; h5py.File({str(file)!r})['data'].attrs['env_args']"
    with pytest.raises(subprocess.TimeoutExpired):
        subprocess.run([sys.executable, "-c", reading], check=True, timeout=8)
    assert exit_code("import", "hdf5", file, "--suggest") == 1
    assert "the HDF5 library does not come to an end with it" in capsys.readouterr().err


def test_a_process_that_crashes_is_a_sentence(
    file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    crashing = tmp_path / "python"
    crashing.write_text("#!/bin/sh\nkill -SEGV $$\n")
    crashing.chmod(0o755)
    with monkeypatch.context() as patched:
        patched.setattr(sys, "executable", str(crashing))
        assert exit_code("import", "hdf5", file, "--suggest") == 1
        assert "is damaged: the HDF5 library crashes when it reads it" in capsys.readouterr().err
    assert trial.why_not_read(file) == "it is damaged: the HDF5 library crashes when it reads it"  # asked once


def test_a_sound_file_is_walked_through_whole(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    attributes: list[bytes] = []
    datasets: list[bytes] = []
    monkeypatch.setattr(trial, "_read_attribute", lambda found, attribute: attributes.append(attribute.name))
    monkeypatch.setattr(trial, "_read_dataset", lambda found, end: datasets.append(h5py.h5i.get_name(found)))
    trial.walk(file)
    names: list[str] = []
    attributes_of: list[int] = []
    with h5py.File(file, "r") as opened:
        opened.visititems(lambda name, found: names.append(f"/{name}") if isinstance(found, h5py.Dataset) else None)
        opened.visititems(lambda name, found: attributes_of.append(len(found.attrs)))
    assert sorted(datasets) == sorted(name.encode() for name in names)
    assert len(attributes) == sum(attributes_of) > 5


@pytest.mark.long
@pytest.mark.slow
def test_many_datasets_and_long_texts_are_no_damage(tmp_path: Path) -> None:
    """The library keeps some 70 kB of each open dataset in chunks, which the walk's memory would not hold."""
    path = tmp_path / "many.h5"
    with h5py.File(path, "w") as opened:
        frames = opened.create_group("frames")
        for number in range(trial._MEMORY_BYTES // 70_000):
            frames.create_dataset(str(number), shape=(4,), dtype="u1", chunks=(2,))
        opened.create_dataset("files", (700,), dtype="S1000000", compression="gzip")
        opened.attrs["about"] = "x" * (trial.MAX_ATTRIBUTE_BYTES + 1)
    assert trial.why_not_read(path) == ""


def test_an_object_that_cannot_be_read_hides_no_other(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[bytes] = []

    def attribute(found: h5py.h5g.GroupID, attribute: h5py.h5a.AttrID) -> None:
        raise OSError("spoilt")

    names = trial._names

    def spoilt(group: h5py.h5g.GroupID) -> list[bytes]:
        if h5py.h5i.get_name(group) == b"/data/demo_0":
            raise OSError("spoilt")
        return names(group)

    monkeypatch.setattr(trial, "_names", spoilt)
    monkeypatch.setattr(trial, "_read_attribute", attribute)
    monkeypatch.setattr(trial, "_read_dataset", lambda found, end: seen.append(h5py.h5i.get_name(found)))
    trial.walk(file)
    with h5py.File(file, "r") as opened:
        others = [name for name in opened["data"] if name != "demo_0"]
    assert others
    assert {name.split(b"/")[2].decode() for name in seen if name.startswith(b"/data/")} == set(others)


def test_a_process_that_is_ended_says_nothing_about_the_file(
    file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As the system does when memory runs out; another time the file is read."""
    killed = tmp_path / "python"
    killed.write_text("#!/bin/sh\nkill -KILL $$\n")
    killed.chmod(0o755)
    with monkeypatch.context() as patched:
        patched.setattr(sys, "executable", str(killed))
        with pytest.raises(ResourceError, match="could not be tried in a process of its own, which ended with 9"):
            trial.why_not_read(file)
    assert trial.why_not_read(file) == ""
