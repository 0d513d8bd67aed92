"""A PyBullet client without PyBullet's chatter.

PyBullet prints its build time while it is imported and "argv[0]=" when it connects, from C and onto the same
streams as our tables and JSON.
"""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def _silence() -> Iterator[None]:
    """Send this process's stdout and stderr to nowhere, C's buffers included."""
    libc = ctypes.CDLL(None)
    for stream in (sys.stdout, sys.stderr):
        if stream is not None:
            stream.flush()
    libc.fflush(None)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    saved: list[tuple[int, int]] = []
    try:
        for descriptor in (1, 2):
            try:
                saved.append((descriptor, os.dup(descriptor)))
            except OSError:  # closed by whoever started us
                continue
            os.dup2(nowhere, descriptor)
        yield
    finally:
        libc.fflush(None)
        for descriptor, copy in saved:
            os.dup2(copy, descriptor)
            os.close(copy)
        os.close(nowhere)


def connect() -> Any:
    """A new `BulletClient` without a window."""
    with _silence():
        import pybullet
        from pybullet_utils.bullet_client import BulletClient

        return BulletClient(pybullet.DIRECT)
