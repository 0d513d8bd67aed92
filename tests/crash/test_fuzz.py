"""Fuzzed bags, datasets, HDF5 files, mappings, runs, recordings and policies: a sentence or success, within limits."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from support.fuzz import Fuzzed, problems_within_limits, results_here
from support.fuzz_bags import FuzzedBags
from support.fuzz_data import FuzzedData

KINDS: dict[str, Callable[[Path], Fuzzed]] = {"bags": FuzzedBags, "data": FuzzedData}
COUNTS = {"bags": 110, "data": 50}
"""Kind -> cases of the quick test."""
_MODULES = (
    "demorec.check.run", "demorec.extensions.imports.suggest", "demorec.extensions.imports.import_run",
    "demorec.extensions.imports.dataset_import",
    "demorec.extensions.imports.hdf5_import", "demorec.extensions.imports.hdf5_suggest",
    "demorec.datasets.lerobot.inspect",
    "demorec.datasets.lerobot.export", "demorec.extensions.hdf5.export", "demorec.extensions.report.gather",
    "demorec.extensions.policies.rollouts", "ruamel.yaml", "google.protobuf.descriptor_pool",
)  # fmt: skip


@pytest.fixture(scope="module")
def all_fuzzed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Fuzzed]:
    return {name: kind(tmp_path_factory.mktemp(name)) for name, kind in KINDS.items()}


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("kind", KINDS)
def test_a_hundred_inputs(kind: str, all_fuzzed: dict[str, Fuzzed]) -> None:
    results = results_here(all_fuzzed[kind], range(COUNTS[kind]))
    assert min(results["done"], results["refused"]) > COUNTS[kind] // 7, results


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("numbers", [range(1000, 1200), *(range(k, k + 460) for k in range(1200, 3500, 460))])
def test_two_and_a_half_thousand_inputs(kind: str, numbers: range, all_fuzzed: dict[str, Fuzzed]) -> None:
    found = problems_within_limits(all_fuzzed[kind], numbers, _MODULES)
    assert not found, "\n".join(found)
