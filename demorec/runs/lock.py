"""One run a folder: a lock that the kernel drops with its owner, so that no crash leaves a folder locked."""

from __future__ import annotations

import fcntl
import os
import platform
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from demorec.core.errors import ConfigError, resource_error

LOCK_NAME = ".lock"


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
        if os.path.lexists(path) and not stat.S_ISREG(path.lstat().st_mode):
            raise ConfigError(f"The lock of the output folder is no file: remove it, or choose another --out: {path}")
        # Neither a FIFO is waited for nor a link followed: what is opened is written to.
        flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOFOLLOW
        descriptor = os.open(path, flags, 0o644)
    except OSError as error:
        unusable = ConfigError(
            f"The output folder cannot be written to ({error.strerror}): choose another --out: {folder}"
        )
        raise resource_error(error) or unusable from error
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            owner = os.pread(descriptor, 200, 0).decode(errors="replace").strip() or "another process"
            raise ConfigError(
                f"Another run is writing here ({owner}): wait until it ends, or choose another --out: {folder}"
            ) from error
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, f"process {os.getpid()} on {platform.node()}\n".encode(), 0)
        yield
    finally:
        os.close(descriptor)
