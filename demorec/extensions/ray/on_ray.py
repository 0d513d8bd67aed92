"""Workers on a Ray cluster: the same worker function, one Ray task per attempt, over a folder that all nodes share.

Tasks, not actors: Ray places them on any free CPU, including nodes that join later, and keeps its worker processes warm
between tasks of one function. Lost tasks return to the driver, which submits them again, so that limits and messages
are those of the local executor.
"""

from __future__ import annotations

import logging
import math
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from demorec.core.config import EpisodePlan
from demorec.core.errors import ConfigError, GenerationError, MissingDependencyError, describe_error
from demorec.core.processes import available_cores
from demorec.generate.executor import SINGLE_THREADED, Executor, Report, attempt_episode, lost
from demorec.generate.options import RunOptions
from demorec.runs.run_file import RUN_NAME

try:
    import ray
except ImportError as error:
    raise MissingDependencyError("The Ray executor", "ray", "pip install 'demorec[ray]'") from error

_QUEUED_PER_WORKER = 0.25
"""Attempts submitted beyond the running ones: Ray gives a freed CPU the next one without asking the driver."""
_STORE_BYTES = 100 << 20
"""Object store of a cluster started here: only lines of run.json pass through it."""
_KNOCK_S = 10.0
"""Maximum time for a cluster's first answer, s."""
_RECOUNT_S = 5.0
"""Interval at which the cluster's size is queried, s."""


class RayExecutor(Executor):
    """Attempts as Ray tasks on the cluster of `connected`.

    The number of running attempts is bounded by the size of the cluster, which may change during the run. The workers
    must see the run's folder under the same path.

    Raises:
        ConfigError: The cluster has no room for a worker.
    """

    def __init__(self, maker: str, folder: Path, options: RunOptions) -> None:
        self._maker = maker
        self._folder = str(folder)
        self._asked = options.workers
        gpus = options.gpus_per_worker
        self._needs = {"CPU": 1.0, "GPU": gpus}
        self._pending: dict[Any, EpisodePlan] = {}
        self._node = ray.get_runtime_context().get_node_id()
        self._is_cut_off = False
        self._counted_at = -math.inf
        self._size = 0
        self._task = ray.remote(
            num_cpus=1,
            num_gpus=gpus,
            max_calls=options.recycle_after,
            max_retries=0,
            runtime_env={"env_vars": SINGLE_THREADED},
        )(_attempt)
        if self.workers < 1:
            have = ray.cluster_resources()
            self.close()
            raise ConfigError(
                f"The Ray cluster has {have.get('CPU', 0):g} CPUs and {have.get('GPU', 0):g} GPUs, too few for one "
                f"worker with 1 CPU and {gpus:g} GPUs: lower --gpus-per-worker, or add nodes."
            )

    @property
    def workers(self) -> int:
        """Number of attempts that the cluster has room for now, or the requested number.

        Raises:
            GenerationError: The node of this connection has ended, so that the cluster is out of reach.
        """
        if time.monotonic() - self._counted_at > _RECOUNT_S:
            self._counted_at = time.monotonic()
            have = ray.cluster_resources()
            self._size = min(int(have.get(name, 0) / need) for name, need in self._needs.items() if need > 0)
            self._is_cut_off |= any(node["NodeID"] == self._node and not node["Alive"] for node in ray.nodes())
        if self._is_cut_off:
            raise GenerationError(
                "The Ray node that this command is connected to has ended (perhaps for lack of memory): start it again "
                "if it was not ours (ray start), then run the same command again."
            )
        return self._size if self._asked is None else min(self._asked, self._size)

    @property
    def has_room(self) -> bool:
        """Whether fewer attempts are running than the cluster can take."""
        return self.pending < self.workers + int(self.workers * _QUEUED_PER_WORKER * (self._asked is None))

    @property
    def pending(self) -> int:
        """Number of running attempts."""
        return len(self._pending)

    def submit(self, plan: EpisodePlan) -> None:
        """Submit an attempt to Ray."""
        self._pending[self._task.remote(self._maker, plan, self._folder)] = plan

    def wait(self, timeout_s: float) -> list[Report]:
        """Return the attempts that have ended; waits up to `timeout_s` for the first."""
        waiting = list(self._pending)
        done, _ = ray.wait(waiting, num_returns=1, timeout=timeout_s)
        if done:
            done, _ = ray.wait(waiting, num_returns=len(waiting), timeout=0)
        reports: list[Report] = []
        for reference in done:
            plan = self._pending.pop(reference)
            try:
                reports.append(ray.get(reference))
            except ray.exceptions.TaskCancelledError:
                reports.append(lost(plan, "it was cancelled"))
            except ray.exceptions.RayTaskError as error:
                # The maker's exceptions arrive as reports; this is a worker that cannot even start.
                raise GenerationError(f"A Ray worker cannot work: {_last_line(error)}") from error
            except ray.exceptions.RuntimeEnvSetupError as error:
                raise GenerationError(f"A Ray worker cannot be set up: {_last_line(error)}") from error
            except ray.exceptions.LocalRayletDiedError:  # raised after the other reports have been processed
                self._pending[reference], self._is_cut_off = plan, True
            except ray.exceptions.RayError as error:
                self._counted_at = -math.inf  # it may have been a whole node
                reports.append(lost(plan, f"its Ray worker was lost ({type(error).__name__})"))
        return reports

    def close(self) -> None:
        """Cancel the running attempts."""
        if not ray.is_initialized():
            return
        for reference in self._pending:
            ray.cancel(reference, force=True)
        self._pending.clear()


def _attempt(maker: str, plan: EpisodePlan, folder: str) -> Report:
    """Run an attempt on a node."""
    path = Path(folder)
    if not (path / RUN_NAME).exists():
        raise FileNotFoundError(
            f"the node {ray.util.get_node_ip_address()} does not see the output folder: put it on storage that all "
            f"nodes share under one path: {folder}"
        )
    return attempt_episode(maker, plan, path)


@contextmanager
def executor_on_ray(options: RunOptions) -> Iterator[Callable[[str, Path], Executor]]:
    """Connect to the cluster of the options; returns a function that makes an executor there. Errors as `connected`."""
    with connected(options.address, options.workers):
        yield lambda maker, folder: RayExecutor(maker, folder, options)


@contextmanager
def connected(address: str, workers: int | None) -> Iterator[None]:
    """Connect to a cluster unless this process is connected, and disconnect at exit.

    "local" starts a cluster on this machine with `workers` CPUs (None: every core), and ends it. Raises ConfigError if
    the cluster cannot be reached.
    """
    if ray.is_initialized():
        yield
        return
    options: dict[str, Any] = {"logging_level": logging.ERROR, "log_to_driver": False}
    if address == "local":
        cores = workers or available_cores()
        options |= {"num_cpus": cores, "object_store_memory": _STORE_BYTES, "include_dashboard": False}
    _knock(address)
    try:
        ray.init(address=address, **options)
    except Exception as error:  # Ray raises a bare Exception if its own node does not start in time
        ray.shutdown()
        place = "on this machine cannot be started" if address == "local" else f"at {address!r} cannot be reached"
        raise ConfigError(f"The Ray cluster {place}: {_last_line(error)}") from error
    try:
        yield
    finally:
        ray.shutdown()


def _knock(address: str) -> None:
    """Check that HOST:PORT accepts connections: Ray itself would try for minutes before giving up."""
    host, _, port = address.rpartition(":")
    if not host or "/" in host or not port.isdecimal():
        return  # "local", "auto", ray://...: resolved by Ray
    try:
        with socket.create_connection((host.strip("[]"), int(port)), timeout=_KNOCK_S):
            pass
    except (OSError, OverflowError) as error:
        raise ConfigError(
            f"The Ray cluster at {address!r} cannot be reached ({describe_error(error)}): give the address that "
            "`ray start --head` has printed, or --address auto on a machine of the cluster."
        ) from error


def _last_line(error: BaseException) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[-1] if lines else type(error).__name__
