"""A PyBullet client without PyBullet's console output, freed even without `disconnect`.

PyBullet prints its build time during import, "argv[0]=" when it connects, and warnings about models. It does so from C,
to the same streams as our tables and JSON.
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
    """Redirect this process's stdout and stderr to the null device, including C's buffers."""
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
            except OSError:  # closed by the parent process
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
    """One simulation of this process; each PyBullet function is bound to it at its first use.

    `disconnect` frees it, else the garbage collector does, at the latest before the interpreter exits.
    (`pybullet_utils` has a client that is freed after PyBullet itself, and that binds at every call.)
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
        """Free the simulation; safe to call twice."""
        free = self._free
        vars(self).clear()  # PyBullet reuses the number for its next client, which these functions must not reach
        self._number, self._free = -1, free
        free()


def connect() -> BulletClient:
    """Create a client without a window."""
    with silence():
        return BulletClient()
