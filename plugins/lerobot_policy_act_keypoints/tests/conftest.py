"""Fixtures for the plug-in's tests: no network, one thread a process."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest

# Heavy libraries read these once, at import.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("HF_HUB_OFFLINE", "1")
os.environ.setdefault("HF_DATASETS_OFFLINE", "1")


@pytest.fixture(scope="session", autouse=True)
def hf_datasets_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Put the tables that the package datasets copies into a temporary folder."""
    import datasets

    before = datasets.config.HF_DATASETS_CACHE
    datasets.config.HF_DATASETS_CACHE = tmp_path_factory.mktemp("hf-datasets")
    yield
    datasets.config.HF_DATASETS_CACHE = before
