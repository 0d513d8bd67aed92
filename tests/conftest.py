"""Fixtures for all tests: no network, one thread a process, no Hypothesis deadlines, cached bytecode."""

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
# Containers often forbid Python to write bytecode; every process that a test starts would then compile PyTorch again.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # A shell makes its background processes ignore Ctrl-C, and everything started here would inherit that.
    signal.signal(signal.SIGINT, signal.default_int_handler)
from support.export import without_verification

from demorec.mcap.video import ordinary_scheduling

sys.dont_write_bytecode = False
hypothesis.settings.register_profile("untimed", deadline=None, max_examples=50)  # machines are busy at times
hypothesis.settings.load_profile("untimed")


@pytest.hookimpl(wrapper=True)
def pytest_fixture_setup() -> Iterator[None]:
    """Restore priority: LeRobot's AV1 encoding, run as root, would leave the test process with real-time priority."""
    with ordinary_scheduling():
        return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call() -> Iterator[None]:
    """Restore priority as in fixtures, and silence libav, which LeRobot leaves writing to the terminal."""
    av.logging.set_level(None)
    with ordinary_scheduling():
        return (yield)


@pytest.fixture(autouse=True)
def no_allowed_models(monkeypatch: pytest.MonkeyPatch) -> None:
    """Forget the modules that another test's command was allowed to load."""
    monkeypatch.setattr("demorec.robots.assets._modules_with_models", set())


@pytest.fixture
def without_lerobot(monkeypatch: pytest.MonkeyPatch) -> None:
    """Skip LeRobot's verification of exports and the check `lerobot_opens`: its process takes seconds to start."""
    without_verification(monkeypatch)


@pytest.fixture(scope="module")
def hf_datasets_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keep the table copies made by the package datasets in a temporary folder."""
    import datasets

    before = datasets.config.HF_DATASETS_CACHE
    datasets.config.HF_DATASETS_CACHE = tmp_path_factory.mktemp("hf-datasets")
    yield
    datasets.config.HF_DATASETS_CACHE = before
