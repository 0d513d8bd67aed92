"""Workers lost at any moment of a run: it never succeeds with fewer episodes than requested."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import pytest
from support.generate import Remembers, expected_attempts, inspect, run_fake

from demorec.core.config import EpisodePlan, GenerateConfig
from demorec.core.errors import GenerationError
from demorec.generate import executor as executing
from demorec.generate import run as running
from demorec.generate.executor import Executor, Report, attempt_episode, lost
from demorec.generate.options import RunOptions, RunResult
from demorec.generate.run import generate

NUM_EPISODES = 4
"""Eight attempts in total; with two at a time the executor is asked for its capacity about thirty times."""
MOMENTS = [*range(0, 12, 2), 44]
InFlight = Literal["lost", "stuck", "finished"]


@dataclass
class Waning(Executor):
    """Two workers in this process; from one capacity query on there are none, for a number of queries or forever."""

    folder: Path
    lost_at: int
    back_after: float = float("inf")
    in_flight: InFlight = "lost"
    asked: Iterator[int] = field(default_factory=itertools.count)
    now: int = 0
    plans: list[EpisodePlan] = field(default_factory=list)

    @property
    def workers(self) -> int:
        self.now = next(self.asked)
        return 0 if self.is_lost else 2

    @property
    def is_lost(self) -> bool:
        return self.lost_at <= self.now < self.lost_at + self.back_after

    @property
    def pending(self) -> int:
        return len(self.plans)

    def submit(self, plan: EpisodePlan) -> None:
        self.plans.append(plan)

    def wait(self, timeout_s: float) -> list[Report]:
        if self.is_lost and self.in_flight == "stuck":
            return []
        plan = self.plans.pop(0)
        if self.is_lost and self.in_flight == "lost":
            return [lost(plan, "its machine is gone")]
        return [attempt_episode("support.makers:make", plan, self.folder)]

    def close(self) -> None:
        self.plans.clear()


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(executing, "POLL_S", 1e-4)
    monkeypatch.setattr(executing, "CAPACITY_WAIT_S", 0.02)


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> str:
    run = run_fake(tmp_path_factory.mktemp("reference") / "run", num_episodes=NUM_EPISODES).run
    assert {(a.episode_index, a.attempt): a.success for a in run.attempts} == expected_attempts(NUM_EPISODES)
    return run.digest


def run_on(executor: Executor, out: Path, monkeypatch: pytest.MonkeyPatch, heard: Remembers) -> RunResult:
    monkeypatch.setattr(running, "make_executor", lambda *_: executor)
    options = RunOptions(out=out, num_episodes=NUM_EPISODES)
    return generate(GenerateConfig(cameras=()), options, progress=heard, inspect=inspect)


@pytest.mark.slow
@pytest.mark.parametrize("in_flight", ["lost", "stuck", "finished"])
def test_lost_workers_end_the_run_with_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reference: str, in_flight: InFlight
) -> None:
    lost = 0
    for moment in MOMENTS:
        out, heard, ended = tmp_path / str(moment), Remembers(), ""
        executor = Waning(out, moment, in_flight=in_flight)
        with monkeypatch.context() as patch:
            try:
                assert run_on(executor, out, patch, heard).run.digest == reference
            except GenerationError as error:
                ended = str(error)
        if ended:
            lost += 1
            done = len(list((out / "episodes").iterdir()))
            assert "has had no room for any worker" in ended
            assert f"{done} of {NUM_EPISODES} episodes are complete and kept" in ended
            assert sum("no room for any worker now" in line for line in heard.said) == 1
        assert run_fake(out, num_episodes=NUM_EPISODES).run.digest == reference
    assert 1 < lost < len(MOMENTS), "some must lose the workers, and some have ended before"


def test_returning_workers_make_the_same_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reference: str) -> None:
    monkeypatch.setattr(executing, "CAPACITY_WAIT_S", 60.0)
    lost = 0
    for moment in MOMENTS:
        executor = Waning(tmp_path / str(moment), moment, back_after=7)
        assert run_on(executor, executor.folder, monkeypatch, Remembers()).run.digest == reference
        lost += executor.now >= moment
    assert lost > 1


def test_an_executor_that_loses_a_plan_does_not_end_with_success(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Forgetful(Waning):
        def wait(self, timeout_s: float) -> list[Report]:
            if self.plans[0].episode_index == 2:
                self.plans.pop(0)
                return []
            return super().wait(timeout_s)

    with pytest.raises(GenerationError, match=r"ended before it was complete.* 3 of 4 episodes are complete and kept"):
        run_on(Forgetful(tmp_path / "run", 10_000), tmp_path / "run", monkeypatch, Remembers())
