"""Files of unknown origin, opened without waiting and read within bounds; locks; files written in one step; the cache.

A folder may hold anything under the name that is looked for: opening a FIFO waits for its other end for ever, reading
a device never ends, and a file of some gigabytes fills the memory before anybody has looked at its first byte.
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import json
import os
import platform
import stat
import tempfile
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from io import BufferedReader
from pathlib import Path
from typing import Any, Self

from demorec.core.errors import ConfigError, DemorecError, resource_error, write_error
from demorec.core.plain import parse_json

MCAP_MAGIC = b"\x89MCAP0\r\n"
RERUN_MAGICS = (b"RRF", b"RRIO")
HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"
"""First bytes by which files are known."""

_KINDS = {
    stat.S_IFIFO: "a FIFO",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFDIR: "a folder",
}


_LFS_POINTER = b"version https://git-lfs.github.com/spec/v1"
"""Beginning of the text that Git LFS leaves in place of a file that was not fetched."""


def open_regular(path: Path) -> BufferedReader:
    """Open a regular file (or a link to one) for reading, without ever waiting.

    Raises:
        OSError: There is none, it cannot be opened, it is a folder, FIFO, socket or device, or Git LFS has left a
            pointer in its place; `strerror` says which.
    """
    if "\0" in str(path):
        raise OSError(errno.EINVAL, "its name holds a zero byte", str(path))
    _refuse_irregular(path, path.stat().st_mode)
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        _refuse_irregular(path, os.fstat(descriptor).st_mode)  # it may have been exchanged in between
        if os.pread(descriptor, len(_LFS_POINTER), 0) == _LFS_POINTER:
            raise OSError(errno.ENODATA, "it is a pointer of Git LFS: fetch the file itself by git lfs pull", str(path))
        return os.fdopen(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise


def read_text_limited(path: Path, limit: int) -> str:
    """The text of a regular UTF-8 file of at most `limit` bytes.

    Raises:
        OSError: As `open_regular`, or the file is larger.
        UnicodeDecodeError: It is no UTF-8.
    """
    with open_regular(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size > limit:
            raise OSError(errno.EFBIG, f"it is larger than {limit:,} bytes", str(path))
        data = file.read(size)
    return data.decode()


MAX_JSON_BYTES = 2 << 30
"""Above this no JSON file is read: of a run.json some million episodes, which take ten times as much memory."""


def read_json_limited(path: Path, limit: int) -> Any:
    """The content of a regular JSON file of at most `limit` bytes.

    Raises:
        OSError: As `read_text_limited`.
        ValueError: It is no UTF-8, no JSON, or nested too deeply to be read.
    """
    try:
        return json.loads(read_text_limited(path, limit))
    except RecursionError:
        raise ValueError("its values are nested too deeply") from None


MAX_SETTINGS_BYTES = 16 << 20
"""Of a JSON file of settings or results; ours, and LeRobot's, have some kilobytes."""


def read_json_object(path: Path) -> dict[str, Any]:
    """The JSON object in a regular file of settings or results, nested no deeper than code can walk.

    Raises:
        OSError: As `read_text_limited`.
        ValueError: It is no UTF-8, no JSON, no object, or nested too deeply.
    """
    found = parse_json(read_text_limited(path, MAX_SETTINGS_BYTES), allow_nan=True)
    if not isinstance(found, dict):
        raise ValueError("it is no JSON object")
    return found


def make_folder(path: Path) -> None:
    """Make a folder for results, and those above it; one that is there is fine.

    Raises:
        DemorecError: It cannot be made.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise resource_error(error) or write_error("The output folder", error, path, DemorecError) from error


def replace_text(path: Path, text: str) -> None:
    """Write a file anew, in one step: what is there stays until all of the text is on the disk.

    It is written beside its place first, to a new file: what else has that name is never written through.

    Raises:
        OSError: It cannot be written.
    """
    part = path.with_name(f"{path.name}.part")
    part.unlink(missing_ok=True)
    with part.open("x") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    part.replace(path)


def irregular_kind(mode: int) -> str:
    """What something that is no regular file is, by its `st_mode`: "a FIFO"."""
    return _KINDS.get(stat.S_IFMT(mode), "something else")


def _refuse_irregular(path: Path, mode: int) -> None:
    if not stat.S_ISREG(mode):
        raise OSError(errno.EINVAL, f"it is {irregular_kind(mode)}, not a regular file", str(path))


class Closing(ABC):
    """A context manager that is closed when its block ends, however that ends."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @abstractmethod
    def close(self) -> None:
        """Free what is held."""


LOCK_NAME = ".lock"


def open_locked(path: Path, *, waits: bool = False) -> int:
    """Open a file for writing, made if it is not there, locked until the descriptor is closed or the process dies.

    Neither a FIFO is waited for nor a link followed, since what is opened is written to.

    Args:
        path: The file.
        waits: Whether to wait for another process that holds the lock.

    Raises:
        BlockingIOError: Another process holds the lock.
        OSError: It is no regular file, or cannot be opened.
    """
    if os.path.lexists(path):
        _refuse_irregular(path, path.lstat().st_mode)
    flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOFOLLOW
    descriptor = os.open(path, flags, 0o666)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX if waits else fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BaseException:
        os.close(descriptor)
        raise
    return descriptor


@contextmanager
def run_lock(folder: Path) -> Iterator[None]:
    """Hold `folder` for this process until the context ends or the process dies, however it dies.

    The file stays: removing it would let two runs lock two different files of the same name. Child processes do
    not inherit the lock (the descriptor is closed on exec).

    Raises:
        ConfigError: Another process holds it (which one is said), or the folder cannot be written to.
    """
    path = folder / LOCK_NAME
    try:
        descriptor = open_locked(path)
    except BlockingIOError as error:
        owner = read_text_limited(path, 200).strip() or "another process"
        raise ConfigError(
            f"Another run is writing here ({owner}): wait until it ends, or choose another --out: {folder}"
        ) from error
    except OSError as error:
        if os.path.lexists(path) and not stat.S_ISREG(path.lstat().st_mode):
            raise ConfigError(
                f"The lock of the output folder is no file: remove it, or choose another --out: {path}"
            ) from error
        raise resource_error(error) or write_error("The output folder", error, folder, DemorecError) from error
    try:
        with suppress(OSError):  # on a full disk, whose it is cannot be said
            os.ftruncate(descriptor, 0)
            os.pwrite(descriptor, f"process {os.getpid()} on {platform.node()}\n".encode(), 0)
        yield
    finally:
        os.close(descriptor)


def free_name(path: Path) -> Path:
    """The path itself, or with the first number behind it that nothing is called."""
    free, number = path, 0
    while os.path.lexists(free):
        number += 1
        free = path.with_name(f"{path.name}.{number}")
    return free


def sha256_of(path: Path) -> str:
    """SHA-256 (hex) of a file's bytes."""
    with open_regular(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def sync_path(path: Path) -> None:
    """Make a file, or the names in a folder, last through a power cut."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def cache_folder(*parts: str) -> Path:
    """A folder below the user's cache folder, created when missing; `DEMOREC_CACHE` moves it elsewhere."""
    import platformdirs

    root = os.environ.get("DEMOREC_CACHE") or platformdirs.user_cache_dir("demorec", appauthor=False)
    folder = Path(root).joinpath(*parts)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        # A home that cannot be written to (containers): work goes on, and is lost with the temporary folder.
        folder = Path(tempfile.gettempdir()).joinpath(f"demorec-{os.getuid()}", *parts)
        folder.mkdir(parents=True, exist_ok=True)
    return folder


def write_whole(path: Path, write: Callable[[Path], object]) -> None:
    """Let `write` fill a temporary file beside `path`, then move it there: readers see all of it or nothing."""
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=path.stem, suffix=path.suffix)
    os.close(handle)
    temporary = Path(name)
    try:
        write(temporary)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def folder_lock(folder: Path) -> Iterator[None]:
    """Hold a lock between processes for as long as the context lasts; the system frees it if the process dies.

    A folder that cannot be written to is not locked: nothing will be kept in it.
    """
    try:
        descriptor = open_locked(folder / "lock", waits=True)
    except OSError:
        yield
        return
    try:
        yield
    finally:
        os.close(descriptor)
