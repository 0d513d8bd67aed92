"""Atomic writes on file systems with and without renaming by a flag (network file systems)."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

import pytest

from demorec.core import atomic
from demorec.core.atomic import atomic_write
from demorec.core.errors import ConfigError
from demorec.core.replacing import ReplaceableKind

FILE = ReplaceableKind(name="a note", recognises=lambda path: True)
FOLDER = ReplaceableKind(name="a book", is_folder=True, recognises=lambda path: True)
pytestmark = pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")


@pytest.fixture(params=["flags", "links", "neither"], autouse=True)
def file_system(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """The features of the file system."""

    def refuse(*arguments: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    if request.param != "flags":
        monkeypatch.setattr(atomic, "_rename", lambda old, new, flag: False)
    if request.param == "neither":
        monkeypatch.setattr("os.link", refuse)


def fill(part: Path, kind: ReplaceableKind, text: str) -> None:
    (part / "page" if kind.is_folder else part).write_text(text)


def text_of(path: Path) -> str:
    return (path / "page" if path.is_dir() else path).read_text()


@pytest.mark.parametrize("kind", [FILE, FOLDER], ids=["file", "folder"])
def test_a_new_file_and_its_replacement(tmp_path: Path, kind: ReplaceableKind) -> None:
    for text in ("first", "second"):
        with atomic_write(tmp_path / "x.txt", kind, overwrite=True) as part:
            fill(part, kind, text)
            assert not (tmp_path / "x.txt").exists() or text_of(tmp_path / "x.txt") == "first"
        assert text_of(tmp_path / "x.txt") == text
        assert [path.name for path in tmp_path.iterdir()] == ["x.txt"]


@pytest.mark.parametrize("kind", [FILE, FOLDER], ids=["file", "folder"])
@pytest.mark.parametrize("replaces", [False, True])
def test_files_that_appear_meanwhile_stay_and_the_result_is_kept(
    tmp_path: Path, kind: ReplaceableKind, replaces: bool
) -> None:
    target = tmp_path / "x.txt"
    if replaces:
        with atomic_write(target, kind) as part:
            fill(part, kind, "old")
    kept = tmp_path / ("x.txt.1" if kind.is_folder else "x.1.txt")

    def write_and_disturb() -> None:
        with atomic_write(target, kind, overwrite=replaces) as part:
            fill(part, kind, "result")
            if kind.is_folder:
                target.mkdir(exist_ok=True)
            fill(target, kind, "mine, and longer")

    with pytest.raises(ConfigError, match=rf"left unchanged \(.*x\.txt.*kept as {kept}"):
        write_and_disturb()
    assert text_of(target) == "mine, and longer"
    assert text_of(kept) == "result"
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(["x.txt", kept.name])


def test_the_old_file_returns_after_a_kill_between_moving_it_away_and_naming_the_new_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(atomic, "_rename", lambda old, new, flag: False)
    target = tmp_path / "x.txt"
    target.write_text("old")
    if (child := os.fork()) == 0:
        monkeypatch.setattr(atomic, "take_name", lambda *_: os._exit(7))
        with atomic_write(target, FILE, overwrite=True) as part:
            part.write_text("new")
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 7
    assert not target.exists()
    with suppress(ZeroDivisionError), atomic_write(target, FILE, overwrite=True):
        raise ZeroDivisionError
    assert target.read_text() == "old"
    assert list(tmp_path.iterdir()) == [target]


def test_an_error_leaves_nothing_not_even_new_parents(tmp_path: Path) -> None:
    def fail() -> None:
        with atomic_write(tmp_path / "deep" / "er" / "x.txt", FILE) as part:
            part.write_text("half")
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert list(tmp_path.iterdir()) == []
