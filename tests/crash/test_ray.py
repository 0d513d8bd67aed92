"""The Ray executor on a real cluster of two nodes: same run as a local one, even when nodes and workers are killed."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import psutil
import pytest
from support.generate import inspect, num_finished

from demorec.core.config import GenerateConfig
from demorec.core.errors import ConfigError
from demorec.extensions.ray import on_ray
from demorec.generate.options import RunOptions, RunResult
from demorec.generate.run import generate
from demorec.runs.run_file import load_run_file

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]
NUM_EPISODES = 60
REAL = GenerateConfig(seed=5, cameras=("wrist",), width=32, height=32)
NUM_REAL = 12


def run_on_ray(out: Path, *, maker: str, **options: Any) -> RunResult:
    return generate(
        GenerateConfig(cameras=()),
        RunOptions(out=out, num_episodes=NUM_EPISODES, executor="ray", **options),
        maker=f"support.makers:{maker}",
        inspect=inspect,
    )


@pytest.fixture(scope="module")
def cluster() -> Iterator[object]:
    """Two nodes with one CPU each, for all tests; no process of the cluster survives them."""
    import ray
    from ray.cluster_utils import Cluster

    with pytest.MonkeyPatch.context() as patch:
        # The nodes' workers import the stand-in makers and the package under test like this process.
        patch.setenv("PYTHONPATH", os.pathsep.join([str(Path(__file__).parents[1]), *sys.path]))
        patch.setenv("RAY_worker_niceness", "0")  # the default of 15 is too short next to other tests
        # Nodes without Ray's dashboard: its agent takes seconds to start, and a node gives up after 15 s.
        patch.setattr(ray._private.utils, "get_dashboard_dependency_error", lambda: "left out")
        nodes = Cluster()
        add_node(nodes, include_dashboard=False)
        add_node(nodes)
        ray.init(address=nodes.address, log_to_driver=False)
        family = processes_of_ray()
        assert family
        yield nodes
        family |= processes_of_ray()
        ray.shutdown()
        nodes.shutdown()
        _, alive = psutil.wait_procs(family, timeout=60)
        assert not alive


def processes_of_ray(above: int | None = None) -> set[psutil.Process]:
    """Descendants of this process, or of the one with the given PID: nodes, their services, workers."""
    found = set()
    for process in psutil.Process(above).children(recursive=True):
        with suppress(psutil.Error):
            command = " ".join(process.cmdline())
            if "/ray/" in command or command.startswith("ray::"):
                found.add(process)
    return found


def add_node(cluster: Any, **options: object) -> object:
    """Add a node with one CPU and without unneeded services. Returns when it is ready.

    A node gives up when its services need over 15 s to start, so a busy machine gets five attempts.
    """
    for tries_left in reversed(range(5)):
        before = processes_of_ray()
        try:
            return cluster.add_node(num_cpus=1, include_log_monitor=False, no_monitor=True, **options)
        except Exception:  # Ray raises no more specific error
            for process in processes_of_ray() - before:
                with suppress(psutil.Error):
                    process.kill()
            if not tries_left:
                raise
    raise AssertionError("unreachable")


def when_finished(out: Path, count: int, act: Callable[[], None]) -> threading.Thread:
    """Call a function once the given number of episodes exist."""

    def wait() -> None:
        while len(list((out / "episodes").glob("*"))) < count:
            time.sleep(0.02)
        act()

    thread = threading.Thread(target=wait, daemon=True)
    thread.start()
    return thread


class Killer:
    """Kill workers and a node with SIGKILL once the run has the given numbers of episodes."""

    def __init__(self, out: Path) -> None:
        self.workers: list[int] = []
        self.nodes = 0
        self._out = out
        self._threads: list[threading.Thread] = []

    def worker_at(self, *counts: int) -> None:
        self._threads += [when_finished(self._out, count, self._kill_worker) for count in counts]

    def node_at(self, count: int, cluster: Any, node: object) -> None:
        def kill() -> None:
            cluster.remove_node(node, allow_graceful=False)
            self.nodes += 1

        self._threads.append(when_finished(self._out, count, kill))

    def join(self) -> None:
        for thread in self._threads:
            thread.join(timeout=60)

    def _kill_worker(self) -> None:
        """Kill a worker that is executing a task."""
        for process in psutil.process_iter(["cmdline"]):
            if (process.info["cmdline"] or [""])[0].startswith("ray::_attempt") and process.pid not in self.workers:
                process.kill()
                self.workers.append(process.pid)
                return


def test_a_complete_run_is_the_same_for_every_executor(tmp_path: Path, cluster: object) -> None:
    """One worker, and Ray on two nodes with workers and a third node killed."""
    one = generate(REAL, RunOptions(out=tmp_path / "one", num_episodes=NUM_REAL, workers=1))
    killer = Killer(tmp_path / "ray")
    killer.node_at(4, cluster, add_node(cluster))
    killer.worker_at(2, 5, 8)
    ray = generate(REAL, RunOptions(out=tmp_path / "ray", num_episodes=NUM_REAL, executor="ray"))
    killer.join()
    assert killer.nodes == 1
    assert len(killer.workers) >= 2
    assert len(one.run.successes) == NUM_REAL
    assert ray.run.digest == one.run.digest
    assert [a.sha256 for a in ray.run.attempts] == [a.sha256 for a in one.run.attempts]


@pytest.mark.long
def test_a_node_that_ends_on_its_own_machine_ends_the_run_with_an_error(tmp_path: Path) -> None:
    """A node ends with its dashboard agent, which is one of the first processes that the kernel kills when memory runs
    out.
    """
    number = 40
    one = generate(REAL, RunOptions(out=tmp_path / "one", num_episodes=number, workers=2))
    out, entry = tmp_path / "ray", "from demorec.cli import generate_dataset_main as main; main()"
    arguments = ["--out", str(out), "--num-episodes", str(number), "--seed", "5", "--no-export", "--no-check"]
    arguments += ["--cameras", "wrist", "--width", "32", "--height", "32", "--workers", "2"]
    command = [sys.executable, "-c", entry, *arguments]
    with subprocess.Popen([*command, "--executor", "ray"], stderr=subprocess.PIPE, text=True) as process:
        while num_finished(out) < 2:
            assert process.poll() is None
            time.sleep(0.05)
        family = processes_of_ray(process.pid)
        agents = [p for p in family if p.cmdline() and p.cmdline()[0].startswith("ray::DashboardAgent")]
        assert agents
        for agent in agents:
            agent.kill()
        _, errors = process.communicate()
    assert process.returncode == 1, errors
    assert "The Ray node that this command is connected to has ended" in errors
    assert f"{num_finished(out)} of {number} episodes are complete and kept" in errors
    assert 2 <= num_finished(out) < number
    _, alive = psutil.wait_procs(family, timeout=60)
    assert not alive
    subprocess.run(command, check=True)
    assert load_run_file(out).digest == one.run.digest


def test_too_large_workers_are_refused(tmp_path: Path, cluster: object) -> None:
    # Ray may still count a node that an earlier test killed.
    with pytest.raises(ConfigError, match=r"has \d CPUs and 0 GPUs, too few for one worker with 1 CPU and 1 GPUs"):
        run_on_ray(tmp_path / "run", maker="make", gpus_per_worker=1.0)


@pytest.mark.parametrize("address", ["127.0.0.1:1", "nowhere.invalid:6379", "127.0.0.1:99999"])
def test_an_unreachable_cluster_is_reported_at_once(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ray.is_initialized", lambda: False)
    with (
        pytest.raises(ConfigError, match=r"cannot be reached .* give the address that `ray start --head` has printed"),
        on_ray.connected(address, 1),
    ):
        pass
