"""Things that are read and then written, several at a time in processes of our own, with results in their order."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, wait
from contextlib import contextmanager
from typing import Any

from demorec.core.processes import SPAWN


class _Here(Executor):
    """Does everything at once, in this process."""

    def submit[R](self, function: Callable[..., R], /, *args: Any, **kwargs: Any) -> Future[R]:
        """The result, or what was raised; Ctrl-C is not kept for later."""
        future: Future[R] = Future()
        try:
            future.set_result(function(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


@contextmanager
def processes(workers: int) -> Iterator[Executor]:
    """So many processes, or this one alone. An interrupt ends them; what they were writing is left unfinished."""
    if workers == 1:
        yield _Here()
        return
    with ProcessPoolExecutor(workers, mp_context=SPAWN) as pool:
        try:
            yield pool
        except Exception:
            pool.shutdown(cancel_futures=True)
            raise
        except BaseException:
            for process in list(pool._processes.values()):
                process.kill()
            raise


def in_order[Item, Read, Job, Written](
    items: Iterable[Item],
    pool: Executor,
    *,
    ahead: int,
    read: Callable[[Item], Read],
    accept: Callable[[Item, Future[Read]], Job | None],
    write: Callable[[Job], Written],
) -> Iterator[Written]:
    """What `write` returns, in the order of the items.

    Args:
        items: Things to be read.
        pool: Calls `read` and `write`, which are imported by name where they are called in other processes.
        ahead: How many items are under way at a time: bounds the memory.
        accept: Called here, in the order of the items, with what was read: what shall be written, if anything. What it
            raises is raised after all items before have been written.
    """
    waiting = deque(items)
    reading: deque[tuple[Item, Future[Read]]] = deque()
    writing: deque[Future[Written]] = deque()
    failure: Exception | None = None
    while waiting or reading or writing:
        while waiting and len(reading) + len(writing) < ahead:
            item = waiting.popleft()
            reading.append((item, pool.submit(read, item)))
        if writing and writing[0].done():
            yield writing.popleft().result()
        elif reading and reading[0][1].done():
            try:
                job = accept(*reading.popleft())
            except Exception as error:
                failure = error
                waiting.clear()
                reading.clear()
                continue
            if job is not None:
                writing.append(pool.submit(write, job))
        else:
            first: list[Future[Any]] = [*list(writing)[:1], *(future for _, future in list(reading)[:1])]
            wait(first, return_when=FIRST_COMPLETED)
    if failure is not None:
        raise failure
