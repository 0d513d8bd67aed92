"""Whatever is known already and whatever comes first, a run makes the same attempts."""

from __future__ import annotations

import random

from hypothesis import given, settings
from hypothesis import strategies as st

from demorec.core.config import EpisodePlan, GenerateConfig
from demorec.generate.run import Schedule
from demorec.runs.run_file import Attempt, Generation, RunFile

MAX_ATTEMPTS = 3


def line(episode: int, attempt: int, success: bool) -> Attempt:
    return Attempt(
        episode_index=episode,
        attempt=attempt,
        seed=0,
        success=success,
        file="",
        sha256="",
        digest=f"{episode} {attempt}",
        num_frames=1,
        num_bytes=1,
    )


def canonical(outcomes: list[list[bool]]) -> dict[tuple[int, int], bool]:
    """The definition: attempts follow each other until one succeeds."""
    made = {}
    for episode, of_episode in enumerate(outcomes):
        for attempt, success in enumerate(of_episode):
            made[episode, attempt] = success
            if success:
                break
    return made


OUTCOMES = st.lists(st.lists(st.booleans(), min_size=MAX_ATTEMPTS, max_size=MAX_ATTEMPTS), min_size=1, max_size=6)


@settings(max_examples=300)
@given(outcomes=OUTCOMES, seed=st.integers(0, 2**32))
def test_every_order_and_every_interruption_come_to_the_same_attempts(outcomes: list[list[bool]], seed: int) -> None:
    chance = random.Random(seed)
    everything = canonical(outcomes)
    config = GenerateConfig(max_attempts=MAX_ATTEMPTS)
    kept = {key for key in sorted(everything) if chance.random() < 0.5}
    order = chance.sample(range(len(outcomes)), len(outcomes))
    run = RunFile(generation=Generation(config=config, versions={}, num_episodes=len(outcomes))).with_attempts(
        line(*key, everything[key]) for key in kept
    )
    schedule = Schedule(run, episodes=order)
    in_flight: list[EpisodePlan] = []
    made = {key: everything[key] for key in kept}
    while True:
        while len(in_flight) < 3 and (plan := schedule.take()) is not None:
            in_flight.append(plan)
        if not in_flight:
            break
        plan = in_flight.pop(chance.randrange(len(in_flight)))
        key = (plan.episode_index, plan.attempt)
        if chance.random() < 0.1:  # its worker was lost
            schedule.give_back(plan)
            continue
        assert key not in made, "an attempt was made twice"
        made[key] = outcomes[plan.episode_index][plan.attempt]
        schedule.report(line(*key, made[key]))
    assert made == everything
    complete = run.with_attempts(line(*key, success) for key, success in made.items())
    assert complete.is_complete
    assert set(complete.given_up) == {i for i, of_episode in enumerate(outcomes) if not any(of_episode)}
