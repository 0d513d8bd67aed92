"""Files written atomically, and a lock of a folder."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from lerobot_policy_act_keypoints.errors import RequestError

LOCK_NAME = ".lock"


def atomic_write(path: Path, text: str) -> None:
    """Write a file; the existing one stays until all of the text is on the disk. Raises OSError if that fails."""
    part = path.with_name(f"{path.name}.part")
    part.unlink(missing_ok=True)
    with part.open("x") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    part.replace(path)


@contextmanager
def folder_lock(folder: Path) -> Iterator[None]:
    """Hold a folder, which is made if missing, until the context ends or the process dies.

    The lock file stays: removing it would let two processes lock different files of the same name.

    Raises:
        RequestError: Another process holds the folder, or it cannot be written to.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOFOLLOW
        descriptor = os.open(folder / LOCK_NAME, flags, 0o666)
    except OSError as error:
        raise RequestError(
            f"The folder cannot be written to ({error.strerror}), choose another --out: {folder}"
        ) from error
    try:
        _lock(descriptor, folder)
        yield
    finally:
        os.close(descriptor)


def _lock(descriptor: int, folder: Path) -> None:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise RequestError(
            f"Another process is training in this folder: wait until it ends, or choose another --out: {folder}"
        ) from error
