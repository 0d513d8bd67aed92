"""Datasets, HDF5 files, mappings, runs, recordings and policies, fuzzed: a sentence or success within bounds."""

from __future__ import annotations

import pytest
from support.fuzz import problems_within_limits, results_here
from support.fuzz_data import FuzzedData

_MODULES = (
    "demorec.check.run", "demorec.sources.dataset_import", "demorec.sources.hdf5_import",
    "demorec.sources.hdf5_suggest", "demorec.datasets.lerobot.inspect", "demorec.datasets.lerobot.export",
    "demorec.datasets.hdf5.export", "demorec.report.gather", "demorec.learn.evaluate.rollouts",
)  # fmt: skip


@pytest.fixture(scope="module")
def fuzzed(tmp_path_factory: pytest.TempPathFactory) -> FuzzedData:
    return FuzzedData(tmp_path_factory.mktemp("fuzzed"))


@pytest.mark.filterwarnings("ignore")
def test_a_hundred_inputs(fuzzed: FuzzedData) -> None:
    results = results_here(fuzzed, range(100))
    assert min(results["done"], results["refused"]) > 15, results


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("numbers", [range(1000, 1200), *(range(k, k + 460) for k in range(1200, 3500, 460))])
def test_two_and_a_half_thousand_inputs(fuzzed: FuzzedData, numbers: range) -> None:
    found = problems_within_limits(fuzzed, numbers, _MODULES)
    assert not found, "\n".join(found)
