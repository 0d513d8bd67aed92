"""Files of unknown origin: reading never blocks and is always bounded."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from demorec.core.files import open_regular, read_json_limited, read_text_limited


def open_files() -> list[int]:
    return sorted(int(link.name) for link in Path("/proc/self/fd").iterdir())


def test_no_file_stays_open_after_a_refusal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The file is replaced by a FIFO between inspection and opening."""
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
        read_json_limited(tmp_path / "file")


@pytest.mark.parametrize("data", [b"", b"\xff", b"{", b"1" * 5000])
def test_invalid_json_is_an_ordinary_error(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "file").write_bytes(data)
    with pytest.raises(ValueError):
        read_json_limited(tmp_path / "file")
