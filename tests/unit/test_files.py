"""Files of unknown origin: reading never blocks and is always bounded."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from demorec.core.files import open_regular, read_text_limited


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
