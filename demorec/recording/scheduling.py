"""Keeps an encoder from taking the machine over."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


@contextmanager
def ordinary_scheduling() -> Iterator[None]:
    """Give the threads of this process back, at the end, how they were scheduled before; new ones are as the caller is.

    SVT-AV1 gives its threads, and the one that starts it, the highest real-time priority when root runs it (as in most
    containers): all that the process starts later inherits that, and whatever else runs on the machine stands still.
    """
    if not hasattr(os, "sched_setscheduler"):  # not Linux
        yield
        return
    own = (os.sched_getscheduler(0), os.sched_getparam(0))
    before = dict(_scheduling())
    try:
        yield
    finally:
        for thread, found in _scheduling():
            wanted = before.get(thread, own)
            if found[0] != wanted[0]:
                with suppress(ProcessLookupError):
                    os.sched_setscheduler(thread, *wanted)


def _scheduling() -> Iterator[tuple[int, tuple[int, os.sched_param]]]:
    """(thread, (policy, parameters)) of every thread of this process."""
    for task in Path("/proc/self/task").iterdir():
        with suppress(ProcessLookupError):  # it has ended meanwhile
            thread = int(task.name)
            yield thread, (os.sched_getscheduler(thread), os.sched_getparam(thread))
