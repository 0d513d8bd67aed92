"""Files of unknown origin, opened without blocking and read within limits; locks; atomic writes; the cache.

A folder may hold anything under an expected name: opening a FIFO blocks forever, reading a device never ends, and a
file of several gigabytes fills the memory before its first byte is checked.
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import json
import os
import stat
import tempfile
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from io import BufferedReader
from pathlib import Path
from typing import Any, Self

from demorec.core.errors import ConfigError, DemorecError, resource_error, write_error
from demorec.core.plain import parse_json

MCAP_MAGIC = b"\x89MCAP0\r\n"
RERUN_MAGICS = (b"RRF", b"RRIO")
HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"
"""Magic bytes of file formats."""

_KINDS = {
    stat.S_IFIFO: "a FIFO",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFDIR: "a folder",
}


_LFS_POINTER = b"version https://git-lfs.github.com/spec/v1"
"""First line of the text file that Git LFS leaves in place of a file that was not fetched."""


def open_regular(path: Path) -> BufferedReader:
    """Open a regular file (or a link to one) for reading without blocking.

    Raises:
        OSError: It is missing, cannot be opened, is a folder, FIFO, socket or device, or is a Git LFS pointer;
        `strerror` says which.
    """
    if "\0" in str(path):
        raise OSError(errno.EINVAL, "its name holds a zero byte", str(path))
    _refuse_irregular(path, path.stat().st_mode)
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        _refuse_irregular(path, os.fstat(descriptor).st_mode)  # it may have been replaced in between
        if os.pread(descriptor, len(_LFS_POINTER), 0) == _LFS_POINTER:
            raise OSError(errno.ENODATA, "it is a pointer of Git LFS: fetch the file itself by git lfs pull", str(path))
        return os.fdopen(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise


def read_text_limited(path: Path, limit: int) -> str:
    """Read a regular UTF-8 file; OSError as in `open_regular` or for more than `limit` bytes."""
    with open_regular(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size > limit:
            raise OSError(errno.EFBIG, f"it is larger than {limit:,} bytes", str(path))
        data = file.read(size)
    return data.decode()


MAX_JSON_BYTES = 2 << 30
"""Maximum size of a JSON file: a run.json of about a million episodes, which takes ten times as much memory."""


def read_json_limited(path: Path) -> Any:
    """Read a regular JSON file of at most `MAX_JSON_BYTES`; OSError as in `read_text_limited`, or ValueError."""
    try:
        return json.loads(read_text_limited(path, MAX_JSON_BYTES))
    except RecursionError:
        raise ValueError("its values are nested too deeply") from None


MAX_SETTINGS_BYTES = 16 << 20
"""Maximum size of a JSON file of settings or results; demorec's and LeRobot's have a few kilobytes."""


def read_json_object(path: Path) -> dict[str, Any]:
    """Read the JSON object in a file of settings or results; OSError as in `read_text_limited`, or ValueError."""
    found = parse_json(read_text_limited(path, MAX_SETTINGS_BYTES), allow_nan=True)
    if not isinstance(found, dict):
        raise ValueError("it is not a JSON object")
    return found


def make_folder(path: Path) -> None:
    """Create a folder for results and its parents, unless it exists; DemorecError if that fails."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise resource_error(error) or write_error("The output folder", error, path, DemorecError) from error


def replace_text(path: Path, text: str) -> None:
    """Write a file atomically: the existing file stays until all of the text is on the disk.

    The text is first written to a new file next to it, so an existing link or device is never written through.
    """
    part = path.with_name(f"{path.name}.part")
    part.unlink(missing_ok=True)
    with part.open("x") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    part.replace(path)


def irregular_kind(mode: int) -> str:
    """Describe the kind of an irregular file by its `st_mode`: "a FIFO"."""
    return _KINDS.get(stat.S_IFMT(mode), "something else")


def _refuse_irregular(path: Path, mode: int) -> None:
    if not stat.S_ISREG(mode):
        raise OSError(errno.EINVAL, f"it is {irregular_kind(mode)}, not a regular file", str(path))


class Closing(ABC):
    """A context manager whose `close` runs when its block ends, with or without an error."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @abstractmethod
    def close(self) -> None:
        """Free all resources."""


LOCK_NAME = ".lock"


def open_locked(path: Path, *, waits: bool = False) -> int:
    """Open a file for writing, created if missing, locked until the descriptor is closed or the process dies.

    Does not block on a FIFO or follow a link, because the file is written to.

    Raises:
        BlockingIOError: Another process holds the lock, unless this call `waits`.
        OSError: It is not a regular file, or cannot be opened.
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
    """Lock `folder` for this process until the context ends or the process dies.

    The file stays: removing it would let two runs lock two different files of the same name. Child processes do
    not inherit the lock (the descriptor is closed on exec).

    Raises:
        ConfigError: Another process holds it, the lock is not a file, or the folder cannot be written to.
    """
    path = folder / LOCK_NAME
    try:
        descriptor = open_locked(path)
    except BlockingIOError as error:
        raise ConfigError(
            f"Another run is writing here: wait until it ends, or choose another --out: {folder}"
        ) from error
    except OSError as error:
        raise resource_error(error) or write_error("The lock of the run", error, path, DemorecError) from error
    try:
        yield
    finally:
        os.close(descriptor)


def free_name(path: Path) -> Path:
    """Return the path itself, or the path with the first free number appended."""
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
    """Flush a file, or a folder's entries, to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def cache_folder(*parts: str) -> Path:
    """A folder in the user's cache folder, created if missing; `DEMOREC_CACHE` moves it."""
    import platformdirs

    root = os.environ.get("DEMOREC_CACHE") or platformdirs.user_cache_dir("demorec", appauthor=False)
    folder = Path(root).joinpath(*parts)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        # The home folder may be read-only (containers): the cache is then lost with the temporary folder.
        folder = Path(tempfile.gettempdir()).joinpath(f"demorec-{os.getuid()}", *parts)
        folder.mkdir(parents=True, exist_ok=True)
    return folder


def write_whole(path: Path, write: Callable[[Path], object]) -> None:
    """Let `write` fill a temporary file next to `path`, then move it there: readers see all of it or nothing."""
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
    """Hold a lock between processes while the context lasts; the system frees it if the process dies.

    A read-only folder is not locked: nothing can be stored in it.
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
