"""What may become of the process that verifies a dataset; imported there by name, so that it loads little."""

from __future__ import annotations

import os
import signal
import time
from multiprocessing.connection import Connection
from typing import Any

from demorec.core.errors import resource_error


def never_end(pipe: Connection[Any, Any], cache: str) -> None:
    """As a library that is loaded with too little memory and waits for its own threads."""
    time.sleep(3600)


def never_listen(pipe: Connection[Any, Any], cache: str) -> None:
    """The same, and no signal reaches it."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    pipe.send("deaf")
    never_end(pipe, cache)


def die(pipe: Connection[Any, Any], cache: str) -> None:
    """As when the system ends it."""
    os._exit(3)


def lack_memory(pipe: Connection[Any, Any], cache: str) -> None:
    """As when an allocation fails."""
    pipe.recv()
    pipe.send(resource_error(MemoryError()))
