"""A PyBullet client without PyBullet's chatter, freed whoever forgets to.

PyBullet prints its build time while it is imported, "argv[0]=" when it connects and warnings about models, from C and
onto the same streams as our tables and JSON.
"""

from __future__ import annotations

import ctypes
import functools
import inspect
import os
import sys
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def silence() -> Iterator[None]:
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


class BulletClient:
    """One simulation of this process: PyBullet's functions, each bound to it at its first use.

    It is freed by `disconnect`, else when nothing refers to it any more, at the latest before the interpreter ends
    (`pybullet_utils` has a client that is freed so late that PyBullet is gone, and that binds at every call).
    """

    def __init__(self) -> None:
        import pybullet

        self._number: int = pybullet.connect(pybullet.DIRECT)
        self._free = weakref.finalize(self, pybullet.disconnect, physicsClientId=self._number)

    def __getattr__(self, name: str) -> Any:
        import pybullet

        attribute = getattr(pybullet, name)
        if inspect.isbuiltin(attribute):
            attribute = functools.partial(attribute, physicsClientId=self._number)
        setattr(self, name, attribute)
        return attribute

    def disconnect(self) -> None:
        """Free the simulation; harmless when called twice."""
        free = self._free
        vars(self).clear()  # PyBullet gives the number to the next client, which these functions must not reach
        self._number, self._free = -1, free
        free()


def connect() -> BulletClient:
    """A new client without a window."""
    with silence():
        return BulletClient()
