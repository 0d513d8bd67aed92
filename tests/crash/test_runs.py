"""Runs with real processes and stand-in recordings: resumed, killed, interrupted, with every fault that occurs."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import psutil
import pytest
from support.commands import workers_of
from support.generate import Remembers, attempts_of, expected_attempts, num_finished, run_fake

from demorec.core.errors import ConfigError, DemorecError, GenerationError
from demorec.generate.options import RunResult
from demorec.generate.run import GRACE_S
from demorec.runs.run_file import load_run_file

pytestmark = pytest.mark.slow

PATIENCE_S = 120.0
"""Not a measurement: an event that takes longer will not happen even on the busiest machine."""


def driver(out: Path, maker: str, num_episodes: int, grace_s: float = GRACE_S) -> subprocess.Popen[str]:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(Path(__file__).parents[1]), *sys.path])}
    return subprocess.Popen(
        [sys.executable, "-m", "support.generate", str(out), maker, str(num_episodes), "2", str(grace_s)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
    )


def wait_for(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, "it never happened"
        time.sleep(0.01)


def assert_gone(processes: list[psutil.Process]) -> None:
    assert processes
    _, alive = psutil.wait_procs(processes, timeout=PATIENCE_S)
    assert not alive


def wait_until_busy(process: subprocess.Popen[str], out: Path) -> None:
    """Wait until both workers have begun an episode that never ends."""
    wait_for(lambda: len(list((out / "unfinished").glob("busy-*"))) == 2 or process.poll() is not None)
    assert process.poll() is None, process.communicate()


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> RunResult:
    """A run of 8 episodes by one undisturbed worker."""
    result = run_fake(tmp_path_factory.mktemp("reference") / "run", workers=1)
    assert attempts_of(result) == expected_attempts(8)
    assert any(not success for success in attempts_of(result).values()), "the seed must make some attempt fail"
    return result


@pytest.fixture
def finished(reference: RunResult, tmp_path: Path) -> Path:
    """A copy of the reference's folder."""
    return shutil.copytree(reference.folder, tmp_path / "run")


@pytest.mark.parametrize(
    ("workers", "episodes", "recycle_after"),
    [(2, None, 500), (1, list(reversed(range(8))), 500), (3, [5, 0, 7, 2, 1, 6, 3, 4], 2)],
)
def test_neither_workers_nor_order_nor_recycling_change_a_run(
    tmp_path: Path, reference: RunResult, workers: int, episodes: list[int] | None, recycle_after: int
) -> None:
    result = run_fake(tmp_path / "run", workers=workers, episodes=episodes, recycle_after=recycle_after)
    assert result.run.digest == reference.run.digest
    assert attempts_of(result) == attempts_of(reference)
    files = sorted(p.name for p in (tmp_path / "run").rglob("*.mcap"))
    assert files == sorted(p.name for p in reference.folder.rglob("*.mcap"))


def test_workers_are_other_processes_with_one_thread_each_and_are_recycled(tmp_path: Path) -> None:
    run_fake(tmp_path / "run", maker="report_pid", workers=2, recycle_after=2)
    seen = [p.name.split("-")[1:] for p in (tmp_path / "run/unfinished").glob("pid-*")]
    assert {threads for _, threads in seen} == {"1"}
    assert str(os.getpid()) not in {pid for pid, _ in seen}
    assert len(seen) >= len(expected_attempts(8)) / 2


def test_more_episodes_extend_a_run_and_fewer_leave_it(tmp_path: Path, reference: RunResult) -> None:
    out = tmp_path / "run"
    run_fake(out, num_episodes=3)
    grown = run_fake(out, num_episodes=8)
    assert grown.run.digest == reference.run.digest
    assert len(grown.made) == len(expected_attempts(8)) - len(expected_attempts(3))
    heard = Remembers()
    again = run_fake(out, num_episodes=3, progress=heard)
    assert again.made == ()
    assert again.run == grown.run
    assert again.run.is_complete
    assert heard.said == ["8 episodes have been begun before, so the run has 8 (export --episodes selects)."]


def test_overwrite_starts_again_and_keeps_foreign_files(tmp_path: Path) -> None:
    run_fake(tmp_path / "run")
    mine = [tmp_path / "run/notes.txt", tmp_path / "run/unfinished/ideas.txt"]
    for path in mine:
        path.write_text("mine")
    result = run_fake(tmp_path / "run", seed=1, num_episodes=2, overwrite=True)
    assert attempts_of(result) == expected_attempts(2, seed=1)
    assert num_finished(tmp_path / "run") == sum(expected_attempts(2, seed=1).values())
    assert [path.read_text() for path in mine] == ["mine", "mine"]


def test_a_foreign_dataset_is_refused_before_any_episode_is_made(tmp_path: Path) -> None:
    info = tmp_path / "run/dataset/meta/info.json"
    info.parent.mkdir(parents=True)
    info.write_text('{"codebase_version": "v3.0"}')
    with pytest.raises(ConfigError, match="dataset that this run did not make is in the way"):
        run_fake(tmp_path / "run")
    assert [path for path in (tmp_path / "run").rglob("*") if path.is_file()] == [info]
    assert run_fake(tmp_path / "run", export=False).run.is_complete
    assert info.read_text() == '{"codebase_version": "v3.0"}'


def test_damaged_recordings_are_set_aside_and_made_again(finished: Path, reference: RunResult) -> None:
    victim, other = sorted((finished / "episodes").glob("*"))[1:3]
    good, bad = victim.read_bytes(), other.read_bytes()
    victim.write_bytes(bad)
    heard = Remembers()
    result = run_fake(finished, progress=heard)
    assert result.run.digest == reference.run.digest
    assert victim.read_bytes() == good
    assert (finished / "unfinished" / victim.name).read_bytes() == bad
    assert any(victim.name in said for said in heard.said)


@pytest.mark.parametrize("content", [b"\xff\x00\xff", None])
def test_a_lost_or_damaged_run_json_is_rebuilt_from_the_recordings(
    finished: Path, reference: RunResult, content: bytes | None
) -> None:
    if content is None:
        (finished / "run.json").unlink()
    else:
        (finished / "run.json").write_bytes(content)
    heard = Remembers()
    result = run_fake(finished, progress=heard)
    assert result.made == ()
    assert result.run.digest == reference.run.digest
    if content is not None:
        assert (finished / "run.json.damaged").read_bytes() == content
        assert "damaged" in heard.said[0]


def test_a_recording_of_another_run_is_set_aside(tmp_path: Path, reference: RunResult) -> None:
    other = run_fake(tmp_path / "other", seed=1)
    out = tmp_path / "run"
    run_fake(out, num_episodes=3)
    stranger = sorted((tmp_path / "other/episodes").glob("*"))[-1]
    (out / "episodes" / stranger.name).write_bytes(stranger.read_bytes())
    result = run_fake(out)
    assert result.run.digest == reference.run.digest != other.run.digest
    assert (out / "unfinished" / stranger.name).read_bytes() == stranger.read_bytes()


def test_a_killed_worker_costs_one_attempt(tmp_path: Path, reference: RunResult) -> None:
    heard = Remembers()
    result = run_fake(tmp_path / "run", maker="die_once", progress=heard)
    assert result.run.digest == reference.run.digest
    assert heard.said == ["Episode 2 is made again: its worker was ended by SIGKILL (out of memory?)."]


def test_an_episode_that_kills_every_worker_ends_the_run_with_a_sentence(tmp_path: Path) -> None:
    with pytest.raises(GenerationError, match=r"Episode 2 failed to be made 5 times.*SIGKILL.*are complete and kept"):
        run_fake(tmp_path / "run", maker="die_always")
    assert num_finished(tmp_path / "run") > 0


def test_a_temporary_file_system_error_is_survived(tmp_path: Path, reference: RunResult) -> None:
    assert run_fake(tmp_path / "run", maker="flicker").run.digest == reference.run.digest


@pytest.mark.parametrize(
    ("maker", "error", "message"),
    [
        ("fill_the_disk", GenerationError, r"\(No space left on device\): fix that and run the same command again"),
        ("break_the_disk", GenerationError, r"failed to be made 5 times.*Input/output error: check the storage"),
        ("raise_a_bug", GenerationError, r"Episode 2 raised LocalError: the cube is a sphere \(the traceback is in"),
        ("raise_ours", GenerationError, r"Episode \d cannot be made: No OpenGL library was found."),
    ],
)
def test_the_cause_of_a_stop_is_reported_and_the_same_command_continues(
    tmp_path: Path, reference: RunResult, maker: str, error: type[DemorecError], message: str
) -> None:
    out = tmp_path / "run"
    with pytest.raises(error, match=message) as caught:
        run_fake(out, maker=maker)
    assert "complete and kept" in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1
    if maker == "raise_a_bug":
        assert "the cube is a sphere" in (out / "unfinished/error_episode_000002.txt").read_text()
    assert run_fake(out).run.digest == reference.run.digest


def test_a_vanished_folder_is_reported(tmp_path: Path) -> None:
    with pytest.raises(GenerationError, match="has vanished"):
        run_fake(tmp_path / "run", maker="lose_the_folder")
    assert not (tmp_path / "run").exists(), "it must not be started again"
    assert num_finished(tmp_path / "elsewhere") > 0


def test_two_runs_into_one_folder_exclude_each_other_until_the_owner_dies(tmp_path: Path) -> None:
    out = tmp_path / "run"
    first = driver(out, "make_for_ever", 4)
    try:
        wait_for(lambda: out.exists() and (out / "run.json").exists())
        with pytest.raises(ConfigError, match="Another run is writing here: "):
            run_fake(out)
    finally:
        first.kill()
        first.communicate()
    assert (out / ".lock").exists()
    assert attempts_of(run_fake(out, num_episodes=4)) == expected_attempts(4)


@pytest.mark.parametrize("number", [pytest.param(signal.SIGTERM, marks=pytest.mark.long), signal.SIGINT])
def test_the_first_interrupt_lets_current_episodes_end(
    tmp_path: Path, reference: RunResult, number: signal.Signals
) -> None:
    out = tmp_path / "run"
    process = driver(out, "make_slowly", 8, grace_s=PATIENCE_S)
    wait_for(lambda: num_finished(out) >= 1)
    workers = psutil.Process(process.pid).children(recursive=True)
    process.send_signal(number)
    process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 130
    run = load_run_file(out)
    assert len(run.successes) == num_finished(out) < 8
    assert_gone(workers)
    assert not list((out / "unfinished").glob("*.part")), "running attempts have ended"
    assert run_fake(out).run.digest == reference.run.digest


def test_a_signal_to_the_whole_group_is_left_to_the_driver(tmp_path: Path) -> None:
    """As `timeout` sends it. The workers get it first, and would be lost if they reacted to it."""
    out = tmp_path / "run"
    process = driver(out, "make_slowly", 8, grace_s=PATIENCE_S)
    wait_for(lambda: num_finished(out) >= 1)
    for child in [*workers_of(process), psutil.Process(process.pid)]:
        child.send_signal(signal.SIGTERM)
    told, _ = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 130
    assert "made again" not in told
    run = load_run_file(out)
    assert len(run.successes) == num_finished(out) < 8


@pytest.mark.parametrize("maker", [pytest.param("make_for_ever", marks=pytest.mark.long), "make_stubbornly"])
def test_after_the_first_interrupt_work_ends_soon(tmp_path: Path, maker: str) -> None:
    out = tmp_path / "run"
    process = driver(out, maker, 4, grace_s=0.3)
    wait_until_busy(process, out)
    workers = psutil.Process(process.pid).children(recursive=True)
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 130
    assert_gone(workers)


def test_a_killed_driver_leaves_no_orphans(tmp_path: Path) -> None:
    process = driver(tmp_path / "run", "make_for_ever", 4)
    wait_until_busy(process, tmp_path / "run")
    workers = psutil.Process(process.pid).children(recursive=True)
    process.kill()
    process.communicate()
    assert_gone(workers)
