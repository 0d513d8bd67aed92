"""Processes of our own: started afresh (not forked, since threads and locks do not survive that), ending with us."""

from __future__ import annotations

import multiprocessing
import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import connection
from multiprocessing.context import SpawnContext, SpawnProcess
from typing import Any

_hiding = threading.Lock()


class _Process(SpawnProcess):
    def start(self) -> None:
        with _main_hidden():
            super().start()

    def run(self) -> None:
        threading.Thread(target=_end_with_parent, daemon=True).start()
        super().run()


class _Context(SpawnContext):
    Process = _Process


SPAWN = _Context()
"""Like `multiprocessing.get_context("spawn")`, but its processes do not run the main module's file again.

They end when the process that started them ends, whatever it dies of. All that they carry out is imported by name: a
script that calls demorec needs no `if __name__ == "__main__"`, and a worker does not load the command line's libraries.
"""


def _end_with_parent() -> None:
    """Leave no orphan behind when the parent is killed: its end of a pipe closes, whatever it died of.

    The queue of a ProcessPoolExecutor does not tell: its workers hold both ends of that pipe themselves.
    """
    parent = multiprocessing.parent_process()
    assert parent is not None
    connection.wait([parent.sentinel])
    os._exit(1)


@contextmanager
def _main_hidden() -> Iterator[None]:
    # multiprocessing.spawn.get_preparation_data tells a child to run what __spec__ or __file__ name.
    main = sys.modules["__main__"]
    with _hiding:
        held: dict[str, Any] = {k: v for k, v in vars(main).items() if k in ("__spec__", "__file__")}
        main.__spec__ = None
        vars(main).pop("__file__", None)
        try:
            yield
        finally:
            vars(main).update(held)
