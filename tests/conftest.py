"""Shared by all tests: no network, one thread per process, no deadlines, compiled bytecode is kept."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator

import av.logging
import hypothesis
import pytest

# Heavy libraries read these once, at import; tests run in several processes on few cores.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("HF_HUB_OFFLINE", "1")
os.environ.setdefault("HF_DATASETS_OFFLINE", "1")
# Containers often forbid Python to write bytecode; every process that a test starts would then compile PyTorch anew.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # A shell switches Ctrl-C off for what runs in its background, and for all that this starts.
    signal.signal(signal.SIGINT, signal.default_int_handler)
from support.export import without_verification

from demorec.mcap.video import ordinary_scheduling

sys.dont_write_bytecode = False
hypothesis.settings.register_profile("untimed", deadline=None)  # machines are busy at times
hypothesis.settings.load_profile("untimed")


@pytest.hookimpl(wrapper=True)
def pytest_fixture_setup() -> Iterator[None]:
    """LeRobot's own AV1 encoding, run by root, would leave the test process with real-time priority."""
    with ordinary_scheduling():
        return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call() -> Iterator[None]:
    """As in fixtures; and LeRobot's code leaves libav writing to the terminal."""
    av.logging.set_level(None)
    with ordinary_scheduling():
        return (yield)


@pytest.fixture(autouse=True)
def no_allowed_models(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a command of another test was allowed is forgotten."""
    monkeypatch.setattr("demorec.robots.assets._modules_with_models", set())


@pytest.fixture
def without_lerobot(monkeypatch: pytest.MonkeyPatch) -> None:
    """Exports are not verified and `lerobot_opens` is left out: a process of LeRobot takes seconds to start."""
    without_verification(monkeypatch)


@pytest.fixture(scope="module")
def hf_datasets_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Copies of the tables that the package datasets makes go to a temporary folder."""
    import datasets

    before = datasets.config.HF_DATASETS_CACHE
    datasets.config.HF_DATASETS_CACHE = tmp_path_factory.mktemp("hf-datasets")
    yield
    datasets.config.HF_DATASETS_CACHE = before
