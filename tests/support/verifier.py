"""Failures of the process that verifies a dataset, imported there by name; this module loads little."""

from __future__ import annotations

import os
import signal
import time
from multiprocessing.connection import Connection
from typing import Any

from demorec.core.errors import resource_error


def never_end(pipe: Connection[Any, Any], cache: str) -> None:
    """Hang like a library that waits for its own threads after running out of memory."""
    time.sleep(3600)


def never_listen(pipe: Connection[Any, Any], cache: str) -> None:
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    pipe.send("deaf")
    never_end(pipe, cache)


def die(pipe: Connection[Any, Any], cache: str) -> None:
    os._exit(3)


def lack_memory(pipe: Connection[Any, Any], cache: str) -> None:
    pipe.recv()
    pipe.send(resource_error(MemoryError()))
