"""Atomic writes: a file or folder appears under its name complete or not at all, and never takes an existing name.

The content is written in the workshop, a hidden folder next to the target: `.NAME.demorec-part`. A lock in it excludes
a second command, and its content marks the workshop as demorec's. The last step takes the name only if it is still
free, or, with `--overwrite`, if the existing target is unchanged since the start.

One system call renames a single target, or exchanges it with the target that it replaces. Several targets are moved in
sequence, the old ones first: the next command with the same targets reads a journal and undoes an interrupted move. The
lock is removed last, so that the next command recognises and removes the remains of a crash.
"""

from __future__ import annotations

import errno
import json
import os
import shutil
import stat
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from demorec.core.errors import ConfigError, DemorecError, ExportError, resource_error, write_error
from demorec.core.files import open_locked, sync_path
from demorec.core.replacing import ReplaceableKind, check_replaceable, json_object, shown

_LOCK, _JOURNAL, _NEW, _OLD = "lock", "journal.json", "new", "old"
"""Content of a workshop: the lock, the journal of moves, the new targets and the old ones."""
_MARK = b"demorec is writing here; its next command to the same place removes this folder.\n"
_AT_FDCWD = -100
_NO_REPLACE = 1
"""Flag of renameat2(2): fail if the target exists."""
_EXCHANGE = 2
"""Flag of renameat2(2): exchange both."""
_UNSUPPORTED = (errno.ENOSYS, errno.EINVAL, errno.ENOTSUP)

Snapshot = dict[str, list[int]]
"""Name of each file and folder of a target, "" for the target itself -> inode and, for files, size and modification
time.
"""


@contextmanager
def atomic_write(
    target: Path, kind: ReplaceableKind, *, overwrite: bool = False, sources: Iterable[Path] = ()
) -> Iterator[Path]:
    """Yield a path to write to, which becomes `target` when the block ends without an error.

    The path is an empty folder if the kind is a folder; otherwise it does not exist yet. The parent of `target` is
    created if it is missing.

    Args:
        target: Path of the result.
        kind: Kind of the result, which decides the files that it may replace.
        overwrite: Whether the user asks for replacement.
        sources: Inputs of the result, which are never replaced.

    Raises:
        ConfigError: The target exists and must stay, another command is writing it, or another file has appeared there.
        In the last case the result is kept next to it, under the name in the error message.
        ExportError: It cannot be written for another reason, such as a full disk.
        DemorecError: A source has disappeared or cannot be read.
    """
    with atomic_write_all([target], kind, overwrite=overwrite, sources=sources) as (part,):
        yield part


@contextmanager
def atomic_write_all(
    targets: Sequence[Path], kind: ReplaceableKind, *, overwrite: bool = False, sources: Iterable[Path] = ()
) -> Iterator[list[Path]]:
    """Yield a path to write to for each target; all targets appear when the block ends. See `atomic_write`."""
    sources = tuple(sources)
    places = [(Path.cwd() / target).resolve() for target in targets]
    workshop = places[0].parent / f".{places[0].name}.demorec-part"

    def check() -> None:
        for target in targets:
            check_replaceable(Path.cwd() / target, kind, overwrite=overwrite, sources=sources)

    try:
        if not os.path.lexists(workshop):  # otherwise undo the remains of an interrupted move of several targets first
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
    except BrokenPipeError:  # the reader of standard output has closed it
        raise
    except OSError as error:
        if isinstance(error.filename, str) and _is_below(error.filename, sources, other_than=(workshop, *places)):
            raise DemorecError(f"The source cannot be read ({error.strerror}): {error.filename}") from error
        what = f"{kind.name[0].upper()}{kind.name[1:]}"
        raise resource_error(error) or write_error(what, error, targets[0], ExportError) from error


def _is_below(name: str, folders: Iterable[Path], *, other_than: Iterable[Path]) -> bool:
    path = Path.cwd() / name
    is_other = any(path.resolve().is_relative_to(place) for place in other_than)
    return not is_other and any(path.is_relative_to(Path.cwd() / folder) for folder in folders)


def snapshot(path: Path) -> Snapshot:
    """Identify a file, or a folder with all its content; empty for a missing path or an empty folder."""
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
    """Rename a file or folder to a free name; an empty folder is replaced by a folder.

    If the file system can neither rename without replacing nor link, the name is checked just before.

    Raises:
        FileExistsError: The name is taken.
    """
    if new.is_dir():
        try:
            new.rename(target)
        except OSError as error:
            if error.errno in (errno.ENOTEMPTY, errno.ENOTDIR):
                raise _taken(target) from error
            raise
    elif not _rename(new, target, _NO_REPLACE):
        try:
            os.link(new, target)
        except FileExistsError:
            raise
        except OSError:
            if os.path.lexists(target):
                raise _taken(target) from None
            new.rename(target)
        else:
            new.unlink()


def _taken(path: Path) -> FileExistsError:
    return FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path))


def _rename(old: Path, new: Path, flag: int) -> bool:
    """Rename with the system call that takes a flag; False if the system or the file system lacks it."""
    import ctypes

    try:
        rename = ctypes.CDLL(None, use_errno=True).renameat2
    except AttributeError:
        return False
    result = rename(_AT_FDCWD, os.fsencode(old), _AT_FDCWD, os.fsencode(new), flag)
    code = ctypes.get_errno()
    if result != 0 and code not in _UNSUPPORTED:
        raise OSError(code, os.strerror(code), str(new))
    return bool(result == 0)


def _sync(part: Path) -> None:
    """Flush a file, or all files and names in a folder, to the disk so that they survive a power cut."""
    if not part.is_dir():
        sync_path(part)
    for folder, _, names in os.walk(part, topdown=False):
        for path in (*(Path(folder, name) for name in names), Path(folder)):
            sync_path(path)


@contextmanager
def _locked(workshop: Path, target: Path) -> Iterator[None]:
    """Lock a workshop, created if missing, and clear it at the end; the lock dies with the process."""
    missing = [folder for folder in workshop.parents if not folder.exists()]
    while True:
        with suppress(FileExistsError):
            workshop.mkdir(parents=True)
        try:
            _check_ours(workshop)
            handle = open_locked(workshop / _LOCK)
        except FileNotFoundError:  # the previous holder has just removed it
            continue
        except BlockingIOError as error:
            raise ConfigError(
                f"Another command is writing here: wait until it ends, or choose another name: {target}"
            ) from error
        # The previous holder may have removed the lock between the two calls.
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
    """Reject a folder with the workshop's name that no command has made."""
    is_folder = stat.S_ISDIR(workshop.lstat().st_mode)
    found = {path.name for path in workshop.iterdir()} if is_folder else {""}
    lock = workshop / _LOCK
    is_marked = lock.is_file() and lock.read_bytes() == _MARK
    if not found <= {_LOCK, _JOURNAL, _NEW, _OLD} or (found - {_LOCK} and not is_marked):
        raise ConfigError(f"This was not made by demorec and is in the way, move it elsewhere: {workshop}")


def _clear(workshop: Path) -> None:
    """Remove a workshop, its lock last, unless its journal lists moves that the next command must undo."""
    if (workshop / _JOURNAL).exists():
        return
    for folder in (_NEW, _OLD):
        shutil.rmtree(workshop / folder, ignore_errors=True)
    with suppress(OSError):  # files that cannot be removed stay marked
        if {path.name for path in workshop.iterdir()} == {_LOCK}:
            (workshop / _LOCK).unlink()
            workshop.rmdir()


def _publish(workshop: Path, parts: Sequence[Path], places: Sequence[Path], before: Sequence[Snapshot]) -> None:
    """Give all parts their names; ConfigError, with the parts kept, if another file has taken a name meanwhile."""
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
            f"Files have appeared or changed while this command ran, and are left unchanged ({shown(changed)}); the "
            f"result is kept as {shown([str(path) for path in kept])}"
        ) from error
    for folder in {place.parent for place in places}:
        sync_path(folder)


def _exchanged(part: Path, place: Path, before: Snapshot) -> bool:
    """Exchange a part with the target that it replaces; False if the file system cannot.

    Raises:
        FileExistsError: The target has changed since the start; it is back in its place.
    """
    try:
        if not _rename(part, place, _EXCHANGE):
            return False
    except FileNotFoundError:  # the target to be replaced is gone
        take_name(part, place)
        return True
    if snapshot(part) != before:
        _rename(part, place, _EXCHANGE)
        raise _taken(place)
    return True


def _move_all(workshop: Path, parts: Sequence[Path], places: Sequence[Path], before: Sequence[Snapshot]) -> None:
    """Move all old targets away, then all parts into place; undo the moves if one fails."""
    made = {str(place): snapshot(part) for place, part in zip(places, parts, strict=True)}
    # A journal cut off here lists nothing, because nothing has been moved yet.
    (workshop / _JOURNAL).write_text(json.dumps(made))
    sync_path(workshop / _JOURNAL)
    sync_path(workshop)
    try:
        for place, was in zip(places, before, strict=True):
            old = workshop / _OLD / place.name
            if was and os.path.lexists(place):
                place.rename(old)
                if snapshot(old) != was:
                    raise _taken(place)
        for place, part in zip(places, parts, strict=True):
            take_name(part, place)
            sync_path(place.parent)
    except BaseException:
        _undo(workshop)
        raise
    (workshop / _JOURNAL).unlink()  # no undo after this point


def _undo(workshop: Path) -> None:
    """Undo the moves in a journal: new targets into the workshop, old ones to their places."""
    made: dict[str, Any] = json_object(workshop / _JOURNAL)
    for name, new in made.items():
        place = Path(name)
        part, old = workshop / _NEW / place.name, workshop / _OLD / place.name
        if not os.path.lexists(part) and snapshot(place) == new:  # otherwise it was changed or removed meanwhile
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
