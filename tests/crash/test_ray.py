"""The Ray executor on a real cluster of two nodes: the same run as locally, also when a node or a worker is lost."""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil
import pytest
from helpers_generate import Remembers, expected_attempts, inspect, run_fake

from demorec.config import GenerateConfig
from demorec.errors import ConfigError, GenerationError
from demorec.generate.options import RunOptions
from demorec.generate.run import NoProgress, RunResult, generate

pytestmark = pytest.mark.slow
NUM_EPISODES = 60


def run_on_ray(out: Path, *, maker: str, progress: NoProgress | None = None, **options: float) -> RunResult:
    return generate(
        GenerateConfig(cameras=()),
        RunOptions(out=out, num_episodes=NUM_EPISODES, executor="ray", **options),
        progress=progress,
        maker=f"helpers_makers:{maker}",
        inspect=inspect,
    )


@pytest.fixture(scope="module")
def reference(tmp_path_factory) -> str:
    result = run_fake(tmp_path_factory.mktemp("reference") / "run", num_episodes=NUM_EPISODES)
    return result.run.digest


@pytest.fixture
def cluster(monkeypatch) -> Iterator[object]:
    """Two nodes with one CPU each."""
    import ray
    from ray.cluster_utils import Cluster

    # The nodes' workers import the stand-in makers and the package under test as this process does.
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(Path(__file__).parents[1]), *sys.path]))
    monkeypatch.setenv("RAY_raylet_start_wait_time_s", "300")  # a busy machine is no failure
    nodes = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    nodes.add_node(num_cpus=1)
    ray.init(address=nodes.address, log_to_driver=False)
    yield nodes
    ray.shutdown()
    nodes.shutdown()


def when_finished(out: Path, count: int, act: Callable[[], None]) -> threading.Thread:
    """Do something when so many episodes are there."""

    def wait() -> None:
        while len(list((out / "episodes").glob("*"))) < count:
            time.sleep(0.02)
        act()

    thread = threading.Thread(target=wait, daemon=True)
    thread.start()
    return thread


def ray_workers() -> list[psutil.Process]:
    """Processes that carry out tasks now."""
    return [p for p in psutil.process_iter(["cmdline"]) if (p.info["cmdline"] or [""])[0].startswith("ray::_attempt")]


def test_two_nodes_make_the_same_run(tmp_path, cluster, reference):
    result = run_on_ray(tmp_path / "run", maker="report_pid")
    assert result.run.digest == reference
    assert result.session.workers == 2
    seen = [p.name for p in (tmp_path / "run/unfinished").glob("pid-*")]
    assert len(seen) >= 2, "both nodes must have worked"
    assert {name.split("-")[2] for name in seen} == {"1"}


def test_a_node_that_goes_away_changes_nothing(tmp_path, cluster, reference):
    heard = Remembers()
    out = tmp_path / "run"
    (node,) = cluster.worker_nodes
    thread = when_finished(out, 10, lambda: cluster.remove_node(node, allow_graceful=False))
    result = run_on_ray(out, maker="make_quickly", progress=heard)
    thread.join(timeout=60)
    assert not cluster.worker_nodes
    assert result.run.digest == reference
    assert {(a.episode_index, a.attempt): a.success for a in result.run.attempts} == expected_attempts(NUM_EPISODES)


def test_killed_workers_are_made_up_for(tmp_path, cluster, reference):
    out = tmp_path / "run"
    killed = []

    def kill_one() -> None:
        for process in ray_workers()[:1]:
            process.kill()
            killed.append(process.pid)

    threads = [when_finished(out, count, kill_one) for count in (5, 15, 25)]
    result = run_on_ray(out, maker="make_quickly")
    for thread in threads:
        thread.join(timeout=60)
    assert len(killed) >= 2
    assert result.run.digest == reference


def test_a_run_begun_on_ray_goes_on_without_it(tmp_path, cluster, reference):
    out = tmp_path / "run"
    with pytest.raises(GenerationError, match="the disk is full"):
        run_on_ray(out, maker="fill_the_disk")
    assert run_fake(out, num_episodes=NUM_EPISODES).run.digest == reference


def test_too_large_workers_are_refused(tmp_path, cluster):
    with pytest.raises(ConfigError, match="has 2 CPUs and 0 GPUs, too few for one worker with 1 CPUs and 1 GPUs"):
        run_on_ray(tmp_path / "run", maker="make", gpus_per_worker=1.0)


def test_an_unreachable_cluster_is_told(tmp_path):
    with pytest.raises(ConfigError, match="cannot be reached"):
        generate(
            GenerateConfig(cameras=()),
            RunOptions(out=tmp_path / "run", num_episodes=2, executor="ray", address="auto"),
            maker="helpers_makers:make",
            inspect=inspect,
        )
