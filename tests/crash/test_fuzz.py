"""Fuzzed bags, datasets, HDF5 files, mappings, runs, recordings and policies: a sentence or success, within limits."""

from __future__ import annotations

import pytest
from support.fuzz import problems_within_limits, results_here
from support.fuzz_data import Fuzzed

COUNT = 150
"""Cases of the quick test."""
_MODULES = (
    "demorec.check.run", "demorec.extensions.imports.suggest", "demorec.extensions.imports.import_run",
    "demorec.extensions.imports.dataset_import",
    "demorec.extensions.imports.hdf5_import", "demorec.extensions.imports.hdf5_suggest",
    "demorec.extensions.datasets.inspect",
    "demorec.datasets.lerobot.export", "demorec.extensions.hdf5.export", "demorec.extensions.report.gather",
    "demorec.extensions.policies.rollouts", "ruamel.yaml", "google.protobuf.descriptor_pool",
)  # fmt: skip


@pytest.fixture(scope="module")
def fuzzed(tmp_path_factory: pytest.TempPathFactory) -> Fuzzed:
    return Fuzzed(tmp_path_factory.mktemp("fuzzed"))


@pytest.mark.filterwarnings("ignore")
def test_a_hundred_inputs(fuzzed: Fuzzed) -> None:
    results = results_here(fuzzed, range(COUNT))
    assert min(results["done"], results["refused"]) > COUNT // 7, results


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("numbers", [range(k, k + 500) for k in range(1000, 6000, 500)])
def test_five_thousand_inputs(numbers: range, fuzzed: Fuzzed) -> None:
    found = problems_within_limits(fuzzed, numbers, _MODULES)
    assert not found, "\n".join(found)
