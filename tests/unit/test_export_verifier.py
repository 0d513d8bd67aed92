"""Whatever happens to the process that verifies a dataset, the export ends, with a sentence."""

from __future__ import annotations

import signal
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest
from support.verifier import die, lack_memory, never_end, never_listen

from demorec.core.errors import ExportError, ResourceError
from demorec.datasets.lerobot import verify
from demorec.datasets.lerobot.options import ExportOptions
from demorec.datasets.lerobot.verify import Verifier


def test_an_export_that_fails_does_not_wait_for_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(verify, "_serve", never_end)
    with suppress(KeyError), Verifier() as verifier:
        process = verifier._process
        assert process.is_alive()
        raise KeyError
    assert process.exitcode == -signal.SIGTERM


def test_a_failed_export_does_not_wait_for_a_hanging_verifier(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(verify, "_GRACE_S", 0.1)
    monkeypatch.setattr(verify, "_serve", never_listen)
    with suppress(KeyError), Verifier() as verifier:
        process = verifier._process
        assert verifier._pipe.recv() == "deaf"
        raise KeyError
    assert process.exitcode == -signal.SIGKILL


@pytest.mark.parametrize(
    ("serve", "error", "words"),
    [
        (die, ExportError, r"ended unexpectedly \(exit code 3\), often for lack of memory"),
        (lack_memory, ResourceError, "too little memory"),
    ],
)
def test_its_death_and_its_lack_of_memory_are_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, serve: Callable[..., None], error: type[Exception], words: str
) -> None:
    monkeypatch.setattr(verify, "_serve", serve)
    with Verifier() as verifier, pytest.raises(error, match=words):
        verifier.verify(tmp_path, [], ExportOptions())
