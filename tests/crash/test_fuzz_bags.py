"""Bags, their mappings and messages, fuzzed: a sentence or success within bounds, and never a traceback."""

from __future__ import annotations

import pytest
from support.fuzz import problems_within_limits, results_here
from support.fuzz_bags import FuzzedBags

_MODULES = ("demorec.sources.suggest", "demorec.sources.import_run", "ruamel.yaml", "google.protobuf.descriptor_pool")


@pytest.fixture(scope="module")
def fuzzed(tmp_path_factory: pytest.TempPathFactory) -> FuzzedBags:
    return FuzzedBags(tmp_path_factory.mktemp("fuzzed"))


@pytest.mark.filterwarnings("ignore")
def test_two_hundred_bags(fuzzed: FuzzedBags) -> None:
    results = results_here(fuzzed, range(220))
    assert min(results["done"], results["refused"]) > 50, results


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.timeout(3600)
@pytest.mark.parametrize(
    "numbers",
    [range(1000, 1200), *(range(k, k + 460) for k in range(1200, 3500, 460))],
)
def test_two_and_a_half_thousand_bags(fuzzed: FuzzedBags, numbers: range) -> None:
    found = problems_within_limits(fuzzed, numbers, _MODULES)
    assert not found, "\n".join(found)
