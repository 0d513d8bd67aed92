"""Child processes: spawned (not forked, because threads and locks do not survive a fork), and ended with the parent."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from multiprocessing import connection, resource_tracker
from multiprocessing.context import SpawnContext, SpawnProcess
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn

from demorec.core.limited import end_with_parent, remove_limits
from demorec.core.streams import drop_output

_hiding = threading.Lock()
_starting = threading.Lock()


def available_cores() -> int:
    """Number of cores that this process may use: its affinity mask and, if any, the quota of its control group."""
    count = len(os.sched_getaffinity(0))
    try:
        quota, period = Path("/sys/fs/cgroup/cpu.max").read_text().split()
        if quota != "max":
            count = min(count, max(1, round(int(quota) / int(period))))
    except (OSError, ValueError):
        pass  # no control groups v2: the affinity mask is the only limit
    return count


class _Process(SpawnProcess):
    def start(self) -> None:
        _start_tracker()
        # The new process inherits the mask: Ctrl-C is held back until `run` can catch it, also during imports.
        with blocked(signal.SIGINT), _main_hidden():
            super().start()

    def run(self) -> None:
        sys.unraisablehook = _exit_if_interrupted
        try:
            signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
            threading.Thread(target=_end_with_parent, daemon=True).start()
            super().run()
        except KeyboardInterrupt:  # Ctrl-C reaches the whole process group; the parent reports it
            os._exit(130)


class _Context(SpawnContext):
    Process = _Process


SPAWN = _Context()
"""Like `multiprocessing.get_context("spawn")`, but its processes do not run the main module's file again.

They end when the parent ends, for any reason. Their functions are imported by name: a script that calls demorec needs
no `if __name__ == "__main__"`, and a worker does not load the command line's libraries.
"""


@contextmanager
def process_pool(workers: int) -> Iterator[ProcessPoolExecutor]:
    """Pool of worker processes. Ctrl-C, which also reaches the workers, ends them; a second one while they end kills
    them.

    No exception may be raised during the join: a thread being joined would count as ended and never end.
    """
    _start_tracker()
    pool = ProcessPoolExecutor(workers, mp_context=SPAWN)

    def kill(number: int, frame: FrameType | None) -> None:
        for process in list((pool._processes or {}).values()):
            process.kill()

    try:
        yield pool
    finally:
        with handled(kill, signal.SIGINT):
            pool.shutdown(cancel_futures=True)


def in_turn[Item, Result](
    function: Callable[[Item], Result], items: Sequence[Item], workers: int, *, ahead: int | None = None
) -> Iterator[Result]:
    """Yield the function's result for each item, in order, from several processes if `workers` is more than one.

    Other processes import the function by name. `ahead` limits, for their memory, by how many items each of them may be
    ahead of the consumer.
    """
    workers = min(workers, len(items))
    if workers < 2:
        yield from map(function, items)
        return
    waiting: deque[Future[Result]] = deque()
    with process_pool(workers) as pool:
        for item in items:
            waiting.append(pool.submit(function, item))
            if ahead is not None and len(waiting) >= workers * ahead:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()


def _start_tracker() -> None:
    """Start Python's resource tracker, unless it runs, so that it prints nothing if this process is killed.

    It removes the semaphores of a killed process, and would report them as leaked on the terminal.
    """
    quiet = f"ignore::UserWarning:{resource_tracker.__name__}"
    with _starting:
        before = os.environ.get("PYTHONWARNINGS")
        with environment({"PYTHONWARNINGS": f"{before},{quiet}" if before else quiet}):
            resource_tracker.ensure_running()


@contextmanager
def environment(variables: Mapping[str, str]) -> Iterator[None]:
    """Set environment variables for a child that starts inside the context; libraries read them on import."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextmanager
def blocked(*numbers: signal.Signals) -> Iterator[None]:
    """Block signals, here and in a child that starts inside the context, until each is ready for them."""
    held = signal.pthread_sigmask(signal.SIG_BLOCK, numbers)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, held)


def start_program(command: Sequence[str], **options: Any) -> subprocess.Popen[Any]:
    """Start a program, without limits and with an empty standard input, that is killed when the calling thread ends.

    `options` are those of `subprocess.Popen`.
    """

    def prepare() -> None:
        remove_limits()
        end_with_parent(parent)

    parent = os.getpid()
    return subprocess.Popen(command, stdin=subprocess.DEVNULL, preexec_fn=prepare, **options)  # noqa: PLW1509 (two system calls)


def _exit_if_interrupted(ignored: sys.UnraisableHookArgs) -> None:
    """Exit at a Ctrl-C that Python raised in a destructor or a weak reference's callback: it would print and go on."""
    if ignored.exc_type is KeyboardInterrupt:
        os._exit(130)
    sys.__unraisablehook__(ignored)


def _end_with_parent() -> None:
    """End this process when the parent dies: the parent's end of a pipe closes, for any cause of death.

    The queue of a ProcessPoolExecutor does not close: its workers hold both ends of that pipe.
    """
    parent = multiprocessing.parent_process()
    assert parent is not None
    connection.wait([parent.sentinel])
    os._exit(1)


@contextmanager
def _main_hidden() -> Iterator[None]:
    # multiprocessing.spawn.get_preparation_data makes a child run the file in __spec__ or __file__.
    main = sys.modules["__main__"]
    with _hiding:
        held: dict[str, Any] = {k: v for k, v in vars(main).items() if k in ("__spec__", "__file__")}
        main.__spec__ = None
        vars(main).pop("__file__", None)
        try:
            yield
        finally:
            vars(main).update(held)


def terminate_as_interrupt() -> AbstractContextManager[None]:
    """Context in which SIGTERM raises KeyboardInterrupt like Ctrl-C, so that every `finally` runs."""
    return handled(signal.default_int_handler, signal.SIGTERM)


def exit_silently(number: int, frame: FrameType | None) -> NoReturn:
    """Exit in order; a signal handler.

    Python would print the traceback of an exit within a destructor or an `atexit` callback.
    """
    drop_output(sys.stderr.fileno())
    sys.exit(1)


@contextmanager
def handled(handler: Callable[[int, FrameType | None], None], *numbers: signal.Signals) -> Iterator[None]:
    """Set a signal handler in this context; does nothing outside the main thread, where Python forbids it."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, usual in before.items():
            signal.signal(number, usual)
