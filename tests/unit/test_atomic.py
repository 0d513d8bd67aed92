"""Atomic writes on file systems with and without renaming by a flag (network file systems)."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.export import content_of

from demorec.core import atomic
from demorec.core.atomic import atomic_write, atomic_write_all
from demorec.core.errors import ConfigError
from demorec.core.replacing import ReplaceableKind

FILE = ReplaceableKind(name="a note", recognises=lambda path: True)
FOLDER = ReplaceableKind(name="a book", is_folder=True, recognises=lambda path: True)


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


@pytest.mark.parametrize("kind", [FILE, FOLDER], ids=["file", "folder"])
def test_several_appear_together_or_none(tmp_path: Path, kind: ReplaceableKind) -> None:
    targets = [tmp_path / name for name in ("a", "b", "c")]
    with atomic_write_all(targets, kind) as parts:
        for part in parts:
            fill(part, kind, "old")
        assert not any(target.exists() for target in targets)
    before = content_of(tmp_path)

    def write_and_disturb() -> None:
        with atomic_write_all(targets, kind, overwrite=True) as parts:
            for part in parts:
                fill(part, kind, "new")
            fill(targets[1], kind, "mine, and longer")

    with pytest.raises(ConfigError, match=r"left unchanged \(.*b"):
        write_and_disturb()
    mine = {name: b"mine, and longer" for name in before if name.startswith("b")}
    kept = {f"{name[0]}.1{name[1:]}": b"new" for name in before}
    assert content_of(tmp_path) == before | mine | kept


def test_an_error_leaves_nothing_not_even_new_parents(tmp_path: Path) -> None:
    def fail() -> None:
        with atomic_write(tmp_path / "deep" / "er" / "x.txt", FILE) as part:
            part.write_text("half")
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert list(tmp_path.iterdir()) == []
