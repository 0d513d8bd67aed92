"""Exports that die: killed at any moment, or out of disk. The dataset before is whole afterwards, or the new one is."""

from __future__ import annotations

import multiprocessing
import shutil
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.export import content_of, count_calls, export, export_in_child, files_of, make_run

from demorec.core.tables import EXPORTERS

MODES: dict[str, dict[str, Any]] = {
    "new": {},
    "overwrite": {"overwrite": True},
    "append": {"append": True, "episodes": "2:"},
}
CASES = [
    (exporter, mode)
    for exporter in EXPORTERS.names()
    for mode, options in MODES.items()
    if all(hasattr(EXPORTERS.load(exporter).options(), option) for option in options)
]

pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning"),
]


@pytest.fixture(scope="module")
def context() -> Any:
    """Children are copies of this process, which has exported before: they start at once and load nothing."""
    return multiprocessing.get_context("fork")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_run(tmp_path_factory.mktemp("run") / "run", (6, 5, 7, 6), failures=(1,))


def exit_code(context: Any, *arguments: Any, **limits: int) -> int:
    process = context.Process(target=export_in_child, args=arguments, kwargs=limits)
    process.start()
    process.join(120)
    assert process.exitcode is not None
    return int(process.exitcode)


@pytest.mark.parametrize("kills", [5, pytest.param(20, marks=pytest.mark.long)])
@pytest.mark.parametrize(
    ("exporter", "mode"),
    [pytest.param(*case, marks=pytest.mark.long if case[1] == "new" else ()) for case in CASES],
)
def test_killed_at_any_moment(context: Any, run: Path, tmp_path: Path, exporter: str, mode: str, kills: int) -> None:
    place = tmp_path / "place"
    place.mkdir()
    out = place / "d"
    options = {"exporter": exporter, **MODES[mode]}

    def start_anew() -> None:
        """Beside what the kills before have left."""
        shutil.rmtree(out) if out.is_dir() else out.unlink(missing_ok=True)
        if mode != "new":
            export(run, out, exporter, episodes=":2")

    start_anew()
    before = content_of(out)
    export(run, out, **options)  # whatever is loaded at first use is loaded now
    after = content_of(out)
    start_anew()
    calls = count_calls(run, out, options)
    assert content_of(out) == after != before

    rng = np.random.default_rng(CASES.index((exporter, mode)))
    outcomes, left_something = [], False
    for moment in ((np.arange(kills) + rng.random(kills)) / kills * calls).astype(int).tolist():
        start_anew()
        assert exit_code(context, run, out, options, kill_at=max(1, moment)) == -signal.SIGKILL
        outcomes.append(content_of(out))
        left_something |= any(path != out for path in place.iterdir())
    assert all(outcome in (before, after) for outcome in outcomes)
    assert left_something  # some were killed in the middle of their work
    # The next export cleans up and works.
    start_anew()
    export(run, out, **options)
    assert content_of(out) == after
    assert list(place.iterdir()) == [out]


@pytest.mark.parametrize("limit", [4_000, *(pytest.param(limit, marks=pytest.mark.long) for limit in (1, 500, 15_000))])
@pytest.mark.parametrize(("exporter", "mode"), CASES)
def test_a_full_disk(context: Any, run: Path, tmp_path: Path, exporter: str, mode: str, limit: int) -> None:
    """A limit on the size of a file fails the write that crosses it, as a full disk does."""
    place = tmp_path / "place"
    place.mkdir()
    out = place / "d"
    options = {"exporter": exporter, **MODES[mode]}
    if mode != "new":
        export(run, out, exporter, episodes=":2")
    before = files_of(place)
    assert exit_code(context, run, out, options, size_limit=limit) == 3  # ExportError, nothing else
    assert files_of(place) == before
    export(run, out, **options)  # and with room again it works


def test_a_full_disk_where_processes_leave_images(context: Any, run: Path, tmp_path: Path) -> None:
    before = files_of(tmp_path)
    assert exit_code(context, run, tmp_path / "d", {"workers": 2}, size_limit=500) == 3
    assert files_of(tmp_path) == before
    assert list(tmp_path.iterdir()) == []
