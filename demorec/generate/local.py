"""Workers on this machine: spawned processes, one pipe each, so that killing one cannot harm the others.

A shared queue (multiprocessing.Queue, ProcessPoolExecutor) has locks that a killed worker never releases; with a
separate pipe a worker's death is just an end-of-file.
"""

from __future__ import annotations

import os
import signal
import sys
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import connection
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from pathlib import Path
from types import FrameType

from demorec.core.config import EpisodePlan
from demorec.core.processes import SPAWN, blocked, environment
from demorec.generate.executor import SINGLE_THREADED, Executor, Report, attempt_episode, lost

_OF_THE_GROUP = frozenset({signal.SIGINT, signal.SIGTERM})
_LEAVE = signal.SIGUSR1
"""Signal from the driver to abandon the attempt."""


class _Interrupted(BaseException):
    """Raised in a worker to abandon its attempt; passes every `except Exception`, so that the part file stays."""


@dataclass(eq=False)
class _Worker:
    process: SpawnProcess
    pipe: Connection[EpisodePlan | None, Report]
    plan: EpisodePlan | None = None
    given: int = 0


class LocalExecutor(Executor):
    """A fixed number of worker processes, started on demand, replaced when they die or reach their number of attempts.

    Args:
        maker: Function that runs a plan, as "module:function".
        folder: Folder of the run.
        workers: Number of processes.
        recycle_after: Attempts after which a worker is replaced.
    """

    def __init__(self, maker: str, folder: Path, *, workers: int, recycle_after: int) -> None:
        self._maker = maker
        self._folder = folder
        self._num_workers = workers
        self._recycle_after = recycle_after
        self._live: list[_Worker] = []
        self._retired: list[_Worker] = []

    @property
    def workers(self) -> int:
        """Number of processes."""
        return self._num_workers

    @property
    def pending(self) -> int:
        """Number of busy workers."""
        return sum(worker.plan is not None for worker in self._live)

    def submit(self, plan: EpisodePlan) -> None:
        """Pass the plan to an idle worker, or to a new one."""
        worker = next((w for w in self._live if w.plan is None), None)
        if worker is None:
            worker = self._start()
        worker.plan = plan
        worker.given += 1
        # A worker that died while idle is detected at the next wait: the plan is then reported as lost.
        with suppress(OSError):
            worker.pipe.send(plan)

    def wait(self, timeout_s: float) -> list[Report]:
        """Return the attempts that have ended; waits up to `timeout_s` for the first."""
        reports: list[Report] = []
        by_pipe = {worker.pipe: worker for worker in self._live}
        for pipe in connection.wait(list(by_pipe), timeout_s):
            worker = by_pipe[pipe]  # type: ignore[index]
            plan, worker.plan = worker.plan, None
            try:
                reports.append(worker.pipe.recv())
                if worker.given >= self._recycle_after:
                    self._retire(worker)
            except (EOFError, OSError):
                self._live.remove(worker)
                worker.process.join()
                worker.pipe.close()
                if plan is not None:
                    reports.append(lost(plan, _death(worker.process.exitcode)))
        return reports

    def interrupt(self) -> None:
        """Ask every worker to abandon its attempt and end."""
        for worker in self._live:
            if worker.process.pid is not None and worker.process.is_alive():
                os.kill(worker.process.pid, _LEAVE)

    def close(self) -> None:
        """End every worker: idle ones by message, busy ones by SIGKILL (their part files stay)."""
        for worker in list(self._live):
            if worker.plan is None:
                self._retire(worker)
            else:
                worker.process.kill()
        for worker in self._live + self._retired:
            worker.process.join(timeout=5.0)
            if worker.process.exitcode is None:
                worker.process.kill()
                worker.process.join()
            worker.pipe.close()
        self._live.clear()
        self._retired.clear()

    def _start(self) -> _Worker:
        ours, theirs = SPAWN.Pipe()
        process = SPAWN.Process(
            target=_worker_main, args=(theirs, self._maker, self._folder), name="demorec-worker", daemon=True
        )
        with environment(SINGLE_THREADED), blocked(*_OF_THE_GROUP):
            process.start()
        theirs.close()  # otherwise the pipe would never report that the worker is gone
        worker = _Worker(process=process, pipe=ours)
        self._live.append(worker)
        return worker

    def _retire(self, worker: _Worker) -> None:
        self._live.remove(worker)
        self._retired = [w for w in self._retired if w.process.exitcode is None]
        self._retired.append(worker)
        with suppress(OSError):
            worker.pipe.send(None)


def _worker_main(pipe: Connection[Report, EpisodePlan | None], maker: str, folder: Path) -> None:
    """Run a worker: plans in, reports out, until None, the signal to abandon, or the driver's death."""
    # Both may reach the whole process group (Ctrl-C, timeout); the driver decides their meaning.
    for number in _OF_THE_GROUP:
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _OF_THE_GROUP)
    signal.signal(_LEAVE, _raise_interrupted)
    try:
        while (plan := pipe.recv()) is not None:
            pipe.send(attempt_episode(maker, plan, folder))
    except (EOFError, OSError, _Interrupted):
        pass
    # Nothing is left to flush, and native libraries may crash or stall during teardown.
    sys.stderr.flush()
    os._exit(0)


def _raise_interrupted(number: int, frame: FrameType | None) -> None:
    signal.signal(_LEAVE, signal.SIG_IGN)
    raise _Interrupted


def _death(exitcode: int | None) -> str:
    if exitcode is not None and exitcode < 0:
        name = signal.Signals(-exitcode).name
        return f"its worker was ended by {name}" + (" (out of memory?)" if exitcode == -signal.SIGKILL else "")
    return f"its worker ended with exit code {exitcode}"
