"""Atomic writes: a file or folder appears under its name complete or not at all, and never takes an existing name.

The content is written in the workshop, a hidden folder next to the target: `.NAME.demorec-part`. A lock in it excludes
a second command, and its content marks the workshop as demorec's. The last step takes the name only if it is still
free, or, with `--overwrite`, if the existing target is unchanged since the start.

One system call renames the result, or exchanges it with the target that it replaces. Where the file system cannot
exchange, the old target is first moved into the workshop: the next command with the same target moves it back if a
crash came in between. The lock is removed last, so that the next command recognises and removes the remains of a crash.
"""

from __future__ import annotations

import errno
import os
import shutil
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path

from demorec.core.errors import ConfigError, DemorecError, ExportError, resource_error, write_error
from demorec.core.files import open_locked, sync_path
from demorec.core.replacing import ReplaceableKind, check_replaceable

_LOCK, _NEW, _OLD = "lock", "new", "old"
"""Content of a workshop: the lock, and folders for the result and the target that it replaces."""
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
    sources = tuple(sources)
    place = (Path.cwd() / target).resolve()
    workshop = place.parent / f".{place.name}.demorec-part"
    part = workshop / _NEW / place.name

    def check() -> None:
        check_replaceable(Path.cwd() / target, kind, overwrite=overwrite, sources=sources)

    try:
        if not os.path.lexists(workshop):  # otherwise the target of an interrupted command is restored first
            check()
        with _locked(workshop, target):
            _restore(workshop, place)
            for folder in (_NEW, _OLD):
                shutil.rmtree(workshop / folder, ignore_errors=True)
                (workshop / folder).mkdir()
            check()
            before = snapshot(place)
            if kind.is_folder:
                part.mkdir()
            yield part
            _sync(part)
            _publish(workshop, part, place, before)
    except BrokenPipeError:  # the reader of standard output has closed it
        raise
    except OSError as error:
        if isinstance(error.filename, str) and _is_below(error.filename, sources, other_than=(workshop, place)):
            raise DemorecError(f"The source cannot be read ({error.strerror}): {error.filename}") from error
        what = f"{kind.name[0].upper()}{kind.name[1:]}"
        raise resource_error(error) or write_error(what, error, target, ExportError) from error


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
    if not found <= {_LOCK, _NEW, _OLD} or (found - {_LOCK} and not is_marked):
        raise ConfigError(f"This was not made by demorec and is in the way, move it elsewhere: {workshop}")


def _clear(workshop: Path) -> None:
    """Remove a workshop, its lock last, unless the next command must move the old target back."""
    if all(any((workshop / folder).glob("*")) for folder in (_NEW, _OLD)):
        return
    for folder in (_NEW, _OLD):
        shutil.rmtree(workshop / folder, ignore_errors=True)
    with suppress(OSError):  # files that cannot be removed stay marked
        if {path.name for path in workshop.iterdir()} == {_LOCK}:
            (workshop / _LOCK).unlink()
            workshop.rmdir()


def _publish(workshop: Path, part: Path, place: Path, before: Snapshot) -> None:
    """Give the result its name; ConfigError, with the result kept, if another file has taken the name meanwhile."""
    try:
        if not before:
            take_name(part, place)
        elif not _exchanged(part, place, before):
            _replace(workshop, part, place, before)
    except FileExistsError as error:
        raise ConfigError(
            f"Files have appeared or changed while this command ran, and are left unchanged ({place}); the result is "
            f"kept as {_kept(part, place)}"
        ) from error
    sync_path(place.parent)


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


def _replace(workshop: Path, part: Path, place: Path, before: Snapshot) -> None:
    """Move the old target away and the result into its place; errors as in `_exchanged`."""
    old = workshop / _OLD / place.name
    try:
        if os.path.lexists(place):
            place.rename(old)
            if snapshot(old) != before:
                raise _taken(place)
        take_name(part, place)
    except BaseException:
        _restore(workshop, place)
        raise


def _restore(workshop: Path, place: Path) -> None:
    """Move the old target back, unless the result has taken its place."""
    part, old = workshop / _NEW / place.name, workshop / _OLD / place.name
    if os.path.lexists(part) and os.path.lexists(old):
        try:
            take_name(old, place)
        except FileExistsError:
            _kept(old, place)


def _kept(part: Path, place: Path) -> Path:
    """Keep a result under a free name next to its place: NAME.1, or NAME.1.html for a file."""
    stem, suffix = (place.name, "") if part.is_dir() else (place.stem, place.suffix)
    for number in count(1):
        path = place.with_name(f"{stem}.{number}{suffix}")
        with suppress(FileExistsError):
            if not os.path.lexists(path):
                take_name(part, path)
                break
    return path
