"""Atomic writes: a file or folder appears under its name whole, or not at all, and never takes another one's name.

It is made in a hidden folder next to its place, `.NAME.demorec-part`, the workshop. A lock in it keeps two commands
apart, and its content marks the workshop as ours. The last step takes the name only if it is still free, or, with
`--overwrite`, if it still holds what was there at the start.

A single target is renamed, or changes places with what it replaces, by one system call. Several targets are moved one
after the other, the old ones first: a journal lets the next command to the same targets undo what a crash cut off.
The lock is removed last, so that whatever a crash leaves is recognised, and cleared by the next command.
"""

from __future__ import annotations

import errno
import json
import os
import shutil
import stat
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from demorec.core.errors import ConfigError, ExportError, resource_error, write_error
from demorec.core.files import open_locked, sync_path
from demorec.core.replacing import ReplaceableKind, check_replaceable, json_object, shown

_LOCK, _JOURNAL, _NEW, _OLD = "lock", "journal.json", "new", "old"
"""All that a workshop holds: the lock, what is being moved where, what is made, and what it replaces."""
_MARK = b"demorec is writing here; its next command to the same place removes this folder.\n"
_AT_FDCWD = -100
_EXCHANGE = 2
_NO_REPLACE = 4 if sys.platform == "darwin" else 1
_UNSUPPORTED = (errno.ENOSYS, errno.EINVAL, errno.ENOTSUP)

Snapshot = dict[str, list[int]]
"""Name of each file and folder of a target, "" for itself -> inode and, for files, size and time of the last change."""


@contextmanager
def atomic_write(
    target: Path, kind: ReplaceableKind, *, overwrite: bool = False, sources: Iterable[Path] = ()
) -> Iterator[Path]:
    """Give a path to write to, which becomes `target` when the block ends without an error.

    The path is an empty folder for a kind that is a folder; for others there is no file yet. The parent of `target` is
    made if it is missing.

    Args:
        target: Where the result goes.
        kind: What it is, and what it may replace.
        overwrite: Whether the user asks for replacing.
        sources: What the result is made from, which is never replaced.

    Raises:
        ConfigError: The target exists and must stay, another command is writing it, or something has appeared there
            meanwhile. In the last case the result is kept next to it, under the name that the error reports.
        ExportError: It cannot be written for another reason, such as a full disk.
    """
    with atomic_write_all([target], kind, overwrite=overwrite, sources=sources) as (part,):
        yield part


@contextmanager
def atomic_write_all(
    targets: Sequence[Path], kind: ReplaceableKind, *, overwrite: bool = False, sources: Iterable[Path] = ()
) -> Iterator[list[Path]]:
    """Give a path to write to for each target, which all appear when the block ends; else as `atomic_write`."""
    sources = tuple(sources)
    places = [(Path.cwd() / target).resolve() for target in targets]
    workshop = places[0].parent / f".{places[0].name}.demorec-part"

    def check() -> None:
        for target in targets:
            check_replaceable(Path.cwd() / target, kind, overwrite=overwrite, sources=sources)

    try:
        if not os.path.lexists(workshop):  # else what a crash left of several targets is undone first
            check()
        with _locked(workshop, targets[0]):
            _undo(workshop)
            for folder in (_NEW, _OLD):
                shutil.rmtree(workshop / folder, ignore_errors=True)
                (workshop / folder).mkdir()
            check()
            before = [snapshot(place) for place in places]
            parts = [workshop / _NEW / place.name for place in places]
            if kind.is_folder:
                for part in parts:
                    part.mkdir()
            yield parts
            for part in parts:
                _sync(part)
            _publish(workshop, parts, places, before)
    except BrokenPipeError:  # the reader of standard output has left
        raise
    except OSError as error:
        what = f"{kind.name[0].upper()}{kind.name[1:]}"
        raise resource_error(error) or write_error(what, error, targets[0], ExportError) from error


def snapshot(path: Path) -> Snapshot:
    """Identify a file, or a folder with all that is in it; empty where nothing is, or an empty folder."""
    if not os.path.lexists(path):
        return {}
    found = {"": _identity(path)}
    for folder, folders, files in os.walk(path):
        for name in (*folders, *files):
            entry = Path(folder, name)
            found[entry.relative_to(path).as_posix()] = _identity(entry)
    return {} if len(found) == 1 and path.is_dir() and not path.is_symlink() else found


def _identity(path: Path) -> list[int]:
    status = path.lstat()
    if path.is_dir() and not path.is_symlink():
        return [status.st_ino]
    return [status.st_ino, status.st_size, status.st_mtime_ns]


def take_name(new: Path, target: Path) -> None:
    """Rename a file or folder to a name that is free; an empty folder gives way to a folder.

    A file system that can neither rename without replacing nor link is looked at just before.

    Raises:
        FileExistsError: The name is taken.
    """
    if new.is_dir():
        try:
            new.rename(target)
        except OSError as error:
            if error.errno in (errno.ENOTEMPTY, errno.ENOTDIR):
                raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(target)) from error
            raise
    elif not _rename(new, target, _NO_REPLACE):
        try:
            os.link(new, target)
        except FileExistsError:
            raise
        except OSError:
            if os.path.lexists(target):
                raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(target)) from None
            new.rename(target)
        else:
            new.unlink()


def _rename(old: Path, new: Path, flag: int) -> bool:
    """Rename by the system call that takes a flag; False where the system or the file system lacks it."""
    import ctypes

    library = ctypes.CDLL(None, use_errno=True)
    names = os.fsencode(old), os.fsencode(new)
    try:
        if sys.platform == "darwin":
            result = library.renamex_np(*names, flag)
        else:
            result = library.renameat2(_AT_FDCWD, names[0], _AT_FDCWD, names[1], flag)
    except AttributeError:
        return False
    code = ctypes.get_errno()
    if result != 0 and code not in _UNSUPPORTED:
        raise OSError(code, os.strerror(code), str(new))
    return bool(result == 0)


def _sync(part: Path) -> None:
    """Make a file, or all files and names in a folder, last through a power cut."""
    if not part.is_dir():
        sync_path(part)
    for folder, _, names in os.walk(part, topdown=False):
        for path in (*(Path(folder, name) for name in names), Path(folder)):
            sync_path(path)


@contextmanager
def _locked(workshop: Path, target: Path) -> Iterator[None]:
    """Hold a workshop, made if it is missing, and clear it at the end; the lock dies with the process."""
    missing = [folder for folder in workshop.parents if not folder.exists()]
    while True:
        with suppress(FileExistsError):
            workshop.mkdir(parents=True)
        try:
            _check_ours(workshop)
            handle = open_locked(workshop / _LOCK)
        except FileNotFoundError:  # the holder before us has just removed it
            continue
        except BlockingIOError as error:
            raise ConfigError(
                f"Another command is writing here: wait until it ends, or choose another name: {target}"
            ) from error
        # The holder before us may have removed the lock between the two calls.
        with suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(handle), (workshop / _LOCK).stat()):
                break
        os.close(handle)
    try:
        os.pwrite(handle, _MARK, 0)
        yield
    finally:
        _clear(workshop)
        os.close(handle)
        for folder in missing:
            with suppress(OSError):  # it holds the result
                folder.rmdir()


def _check_ours(workshop: Path) -> None:
    """Refuse a folder of the workshop's name that no command has made."""
    is_folder = stat.S_ISDIR(workshop.lstat().st_mode)
    found = {path.name for path in workshop.iterdir()} if is_folder else {""}
    lock = workshop / _LOCK
    is_marked = lock.is_file() and lock.read_bytes() == _MARK
    if not found <= {_LOCK, _JOURNAL, _NEW, _OLD} or (found - {_LOCK} and not is_marked):
        raise ConfigError(f"This was not made by demorec and is in the way, move it elsewhere: {workshop}")


def _clear(workshop: Path) -> None:
    """Remove a workshop, its lock last, unless the next command must undo what a journal lists."""
    if (workshop / _JOURNAL).exists():
        return
    for folder in (_NEW, _OLD):
        shutil.rmtree(workshop / folder, ignore_errors=True)
    with suppress(OSError):  # what cannot be removed stays marked
        if {path.name for path in workshop.iterdir()} == {_LOCK}:
            (workshop / _LOCK).unlink()
            workshop.rmdir()


def _publish(workshop: Path, parts: Sequence[Path], places: Sequence[Path], before: Sequence[Snapshot]) -> None:
    """Give all parts their names; ConfigError, with the parts kept, where another one has a name meanwhile."""
    try:
        if len(parts) > 1:
            _move_all(workshop, parts, places, before)
        elif not before[0]:
            take_name(parts[0], places[0])
        elif not _exchanged(parts[0], places[0], before[0]):
            _move_all(workshop, parts, places, before)
    except FileExistsError as error:
        found = zip(places, before, strict=True)
        changed = [str(place / name) for place, was in found for name in _differences(was, snapshot(place))]
        kept = [_kept(part, place) for part, place in zip(parts, places, strict=True)]
        raise ConfigError(
            f"Something has appeared or changed while this command ran, and stays as it is ({shown(changed)}); the "
            f"result is kept as {shown([str(path) for path in kept])}"
        ) from error
    for folder in {place.parent for place in places}:
        sync_path(folder)


def _exchanged(part: Path, place: Path, before: Snapshot) -> bool:
    """Let a part change places with what it replaces; False where the file system cannot.

    Raises:
        FileExistsError: Something else is there than at the start; it is back in its place.
    """
    try:
        if not _rename(part, place, _EXCHANGE):
            return False
    except FileNotFoundError:  # what was to be replaced is gone
        take_name(part, place)
        return True
    if snapshot(part) != before:
        _rename(part, place, _EXCHANGE)
        raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(place))
    return True


def _move_all(workshop: Path, parts: Sequence[Path], places: Sequence[Path], before: Sequence[Snapshot]) -> None:
    """Move all old targets away and then all parts into their places; undone when one of them cannot be moved."""
    made = {str(place): snapshot(part) for place, part in zip(places, parts, strict=True)}
    (workshop / _JOURNAL).write_text(json.dumps(made))  # one that is cut off lists nothing: nothing was moved yet
    sync_path(workshop / _JOURNAL)
    sync_path(workshop)
    try:
        for place, was in zip(places, before, strict=True):
            old = workshop / _OLD / place.name
            if was and os.path.lexists(place):
                place.rename(old)
                if snapshot(old) != was:
                    raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(place))
        for place, part in zip(places, parts, strict=True):
            take_name(part, place)
            sync_path(place.parent)
    except BaseException:
        _undo(workshop)
        raise
    (workshop / _JOURNAL).unlink()  # from here on nothing is undone


def _undo(workshop: Path) -> None:
    """Bring back what a journal lists: new targets into the workshop, old ones to their places."""
    made: dict[str, Any] = json_object(workshop / _JOURNAL)
    for name, new in made.items():
        place = Path(name)
        part, old = workshop / _NEW / place.name, workshop / _OLD / place.name
        if not os.path.lexists(part) and snapshot(place) == new:  # else somebody has changed or removed it
            place.rename(part)
        if os.path.lexists(old):
            try:
                take_name(old, place)
            except FileExistsError:
                _kept(old, place)
    (workshop / _JOURNAL).unlink(missing_ok=True)


def _kept(part: Path, place: Path) -> Path:
    """Keep a result under a free name next to its place: NAME.1, or NAME.1.html for a file."""
    stem, suffix = (place.name, "") if part.is_dir() else (place.stem, place.suffix)
    number = 1
    while True:
        path = place.with_name(f"{stem}.{number}{suffix}")
        try:
            if not os.path.lexists(path):
                take_name(part, path)
                return path
        except FileExistsError:
            pass
        number += 1


def _differences(before: Snapshot, now: Snapshot) -> list[str]:
    return sorted(name for name in {*before, *now} if before.get(name) != now.get(name))
