"""A folder that is made beside its place and takes it in one step: whole or not at all.

Everything is written below `.NAME.demorec-export/new`. At the end the two folders change places by one system call
(renameat2 with RENAME_EXCHANGE on Linux, renamex_np on macOS): at no moment is the dataset missing or half written.
Leftovers of a crash lie in that one folder, which a line in its lock file marks as ours, and are removed by the next
export to the same place. What is replaced is deleted last.
"""

from __future__ import annotations

import ctypes
import errno
import fcntl
import os
import shutil
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from demorec.core.errors import ConfigError, ExportError, write_error
from demorec.core.files import sync_path
from demorec.core.replacing import ReplaceableKind, check_replaceable

_RENAME_EXCHANGE = 2
_AT_FDCWD = -100
_RENAME_SWAP_MACOS = 2
_MARK = b"demorec export\n"
"""What the lock file of a workshop holds."""
_AT_ONCE = 1 << 16
"""Bytes: pages of the file cache are taken faster one by one than a quarter of a megabyte together."""
NEW, OLD, CODED, _LOCK = "new", "old", "coded", "lock"
"""All that a workshop holds: the folder in the making, the one that it replaces, images of the export's processes."""


@contextmanager
def staged_folder(target: Path, kind: ReplaceableKind, *, replace: bool, sources: Iterable[Path]) -> Iterator[Path]:
    """Give an empty folder that becomes `target` when the block ends without an error.

    Args:
        target: Where the folder shall be; its parent is made if it is missing.
        kind: What may be replaced.
        replace: Whether a folder of that kind that is there is replaced (and then deleted).
        sources: What the new folder is made from, which is never replaced.

    Raises:
        ConfigError: The target is there and not to be replaced, another export is writing to it, or it is no place for
            a folder.
        ExportError: It cannot be written for another reason; the disk is full, for example.
    """
    target, sources = Path.cwd() / target, tuple(sources)

    def check() -> None:
        check_replaceable(target, kind, overwrite=replace, sources=sources)

    check()
    target = target.resolve()
    workshop = target.parent / f".{target.name}.demorec-export"
    try:
        workshop.mkdir(parents=True, exist_ok=True)
        with _locked(workshop, target):
            new = workshop / NEW
            if (workshop / OLD).exists() and not target.exists():  # a crash between the two renames
                (workshop / OLD).rename(target)
                check()
            try:
                if new.exists():
                    shutil.rmtree(new)
                new.mkdir()
                yield new
                for folder, _, _ in os.walk(new, topdown=False):
                    sync_path(Path(folder))
                check()  # much may have been put there meanwhile
                _take_place(new, target)
                sync_path(target.parent)
            finally:
                if target.exists() or not (workshop / OLD).exists():
                    shutil.rmtree(workshop, ignore_errors=True)
    except OSError as error:
        raise write_error("The dataset", error, target, ExportError) from error


def _check_ours(workshop: Path) -> None:
    """Refuse a folder of the workshop's name that no export has made."""
    found = {path.name for path in workshop.iterdir()} if not workshop.is_symlink() else {""}
    lock = workshop / _LOCK
    is_marked = lock.is_file() and lock.read_bytes() == _MARK
    if not found <= {NEW, OLD, CODED, _LOCK} or (found - {_LOCK} and not is_marked):
        raise ConfigError(f"This folder was not made by demorec and is in the way, move it elsewhere: {workshop}")


@contextmanager
def _locked(workshop: Path, target: Path) -> Iterator[None]:
    """Hold the workshop; the lock dies with the process, so a crash leaves none."""
    while True:
        _check_ours(workshop)
        handle = os.open(workshop / _LOCK, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            os.close(handle)
            raise ConfigError(f"Another export is writing this dataset, wait until it is done: {target}") from error
        # The holder before us may have removed the folder, and its lock file with it, between the two calls.
        if (workshop / _LOCK).exists() and os.path.samestat(os.fstat(handle), (workshop / _LOCK).stat()):
            break
        os.close(handle)
        workshop.mkdir(parents=True, exist_ok=True)
    try:
        os.pwrite(handle, _MARK, 0)
        yield
    finally:
        os.close(handle)


def _take_place(new: Path, target: Path) -> None:
    if not target.exists():
        new.rename(target)
        return
    try:
        _exchange(new, target)
    except OSError as error:
        if error.errno not in (errno.ENOSYS, errno.EINVAL, errno.ENOTSUP):
            raise
        # A file system without the exchange: two renames, the second one undone if it fails.
        aside = new.with_name(OLD)
        target.rename(aside)
        try:
            new.rename(target)
        except BaseException:
            aside.rename(target)
            raise


def _exchange(a: Path, b: Path) -> None:
    library = ctypes.CDLL(None, use_errno=True)
    try:
        if sys.platform == "darwin":
            result = library.renamex_np(os.fsencode(a), os.fsencode(b), _RENAME_SWAP_MACOS)
        else:
            result = library.renameat2(_AT_FDCWD, os.fsencode(a), _AT_FDCWD, os.fsencode(b), _RENAME_EXCHANGE)
    except AttributeError:
        raise OSError(errno.ENOSYS, "no exchange of folders in this C library") from None
    if result != 0:
        code = ctypes.get_errno()
        raise OSError(code, os.strerror(code), str(b))


def copy_bytes(source: IO[bytes], begin: int, count: int, target: IO[bytes]) -> None:
    """Append a part of a file to another, both without a buffer.

    Raises:
        OSError: The part is not there, or cannot be written.
    """
    place = target.tell()
    while count:
        # In whole pages of the target: of parts that lie at any byte the kernel's own copying takes half as much again.
        data = os.pread(source.fileno(), min(count, _AT_ONCE - place % _AT_ONCE), begin)
        if not data:
            raise OSError(errno.EIO, "the file ends before it should", source.name)
        done = target.write(data)
        begin, count, place = begin + done, count - done, place + done
