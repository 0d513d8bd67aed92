"""How a run is carried out: impossible values are refused in one sentence."""

from __future__ import annotations

import os
from typing import Any

import pytest

from demorec.core.errors import ConfigError
from demorec.core.processes import available_cores
from demorec.generate.options import RunOptions


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"num_episodes": 0}, "num_episodes is 0, allowed are 1 to"),
        ({"workers": 0}, "workers is 0"),
        ({"recycle_after": 0}, "recycle_after is 0"),
        ({"cpus_per_worker": 0.0}, "cpus_per_worker is 0"),
        ({"gpus_per_worker": -1.0}, "gpus_per_worker is -1"),
        ({"address": "auto"}, "--address is for Ray: add --executor ray"),
        ({"gpus_per_worker": 1.0}, "--gpus-per-worker is for Ray"),
        ({"repo_id": "cubes"}, "must be OWNER/NAME"),
        ({"repo_id": "me/my cubes"}, "must be OWNER/NAME"),
        ({"repo_id": "me/cubes", "export": False}, "--no-export leaves it out"),
    ],
)
def test_impossible_values_are_refused(values: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError) as error:
        RunOptions(**values).validate()
    assert message in str(error.value)


def test_possible_values_are_not() -> None:
    RunOptions(num_episodes=1, workers=3, repo_id="me/cubes").validate()
    RunOptions(executor="ray", address="auto", gpus_per_worker=0.5, cpus_per_worker=2).validate()


def test_cores_are_those_that_this_process_may_use() -> None:
    before = os.sched_getaffinity(0)
    try:
        os.sched_setaffinity(0, {min(before)})
        assert available_cores() == 1
    finally:
        os.sched_setaffinity(0, before)
    assert 1 <= available_cores() <= len(before)
