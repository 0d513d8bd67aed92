"""Files of unknown origin: nothing is waited for, nothing is read without bounds."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable
from pathlib import Path

import pytest

from demorec.core.files import open_regular, read_json_limited, read_text_limited


def make_fifo(path: Path) -> None:
    os.mkfifo(path)


def make_socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as made:
        made.bind(os.path.relpath(path))  # an address of a socket may have 107 bytes


def make_link_to_fifo(path: Path) -> None:
    os.mkfifo(path.with_name("fifo"))
    path.symlink_to("fifo")


def make_link_to_device(path: Path) -> None:
    path.symlink_to("/dev/zero")


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (make_fifo, "it is a FIFO"),
        (make_link_to_fifo, "it is a FIFO"),
        (make_socket, "it is a socket"),
        (make_link_to_device, "it is a device"),
        (lambda path: path.mkdir(), "it is a folder"),
        (lambda path: None, "No such file"),
        (lambda path: path.symlink_to("nowhere"), "No such file"),
        (lambda path: path.symlink_to(path.name), "Too many levels"),
    ],
)
def test_whatever_else_is_there_is_refused_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, make: Callable[[Path], object], words: str
) -> None:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "file"
    make(path)
    with pytest.raises(OSError, match=words):
        open_regular(path)


def open_files() -> list[int]:
    return sorted(int(link.name) for link in Path("/proc/self/fd").iterdir())


def test_no_file_stays_open_after_a_refusal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Exchanged for a FIFO between the look and the opening."""
    os.mkfifo(tmp_path / "fifo")
    (tmp_path / "file").touch()
    before = open_files()
    regular = (tmp_path / "file").stat()
    monkeypatch.setattr(Path, "stat", lambda path: regular)
    with pytest.raises(OSError, match="it is a FIFO"):
        open_regular(tmp_path / "fifo")
    monkeypatch.undo()
    assert open_files() == before


def test_a_file_beyond_the_limit_is_refused_whatever_its_size_claims(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"12345")
    assert read_text_limited(tmp_path / "file", 5) == "12345"
    with pytest.raises(OSError, match="larger than 4 bytes"):
        read_text_limited(tmp_path / "file", 4)


@pytest.mark.parametrize("text", ["[" * 100_000, '{"a":' * 100_000, '[{"a":' * 5000 + "1" + "}]" * 5000])
def test_json_nested_deeply_is_an_ordinary_error(tmp_path: Path, text: str) -> None:
    (tmp_path / "file").write_text(text)
    with pytest.raises(ValueError, match="nested too deeply"):
        read_json_limited(tmp_path / "file", 10_000_000)


@pytest.mark.parametrize("data", [b"", b"\xff", b"{", b"1" * 5000])
def test_what_is_no_json_is_an_ordinary_error(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "file").write_bytes(data)
    with pytest.raises(ValueError):
        read_json_limited(tmp_path / "file", 10_000_000)
