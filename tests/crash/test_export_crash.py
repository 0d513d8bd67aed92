"""Exports that die: killed at any moment, or out of disk. The dataset before is whole afterwards, or the new one is."""

from __future__ import annotations

import multiprocessing
import shutil
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.export import count_calls, export, export_in_child, files_of, make_run

KILLS = 10  # of each of three kinds

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


@pytest.mark.parametrize(
    "mode", ["new", *(pytest.param(mode, marks=pytest.mark.slow) for mode in ("overwrite", "append"))]
)
def test_killed_at_any_moment(context: Any, run: Path, tmp_path: Path, mode: str) -> None:
    out = tmp_path / "d"
    before: dict[str, bytes] = {}
    of_mode: dict[str, dict[str, Any]] = {
        "new": {},
        "overwrite": {"overwrite": True},
        "append": {"append": True, "episodes": "2:"},
    }
    options = of_mode[mode]

    def start_anew() -> None:
        shutil.rmtree(out, ignore_errors=True)
        if mode != "new":
            export(run, out, episodes=":2")

    start_anew()
    before = files_of(out)
    export(run, out, **options)  # whatever is loaded at first use is loaded now
    after = files_of(out)
    start_anew()
    calls = count_calls(run, out, options)
    assert files_of(out) == after != before

    rng = np.random.default_rng(["new", "overwrite", "append"].index(mode))
    outcomes = []
    for moment in ((np.arange(KILLS) + rng.random(KILLS)) / KILLS * calls).astype(int).tolist():
        start_anew()
        assert exit_code(context, run, out, options, kill_at=max(1, moment)) == -signal.SIGKILL
        found = files_of(out)
        assert found in (before, after), moment
        outcomes.append((found == after, any(path.name.startswith(".d.") for path in tmp_path.iterdir())))
    assert any(left_something for _, left_something in outcomes)  # some were killed in the middle of their work
    # The next export cleans up and works.
    start_anew()
    export(run, out, **options)
    assert files_of(out) == after
    assert [path.name for path in tmp_path.iterdir()] == ["d"]


@pytest.mark.parametrize("limit", [500, 4_000, 15_000])
@pytest.mark.parametrize("mode", ["new", "append"])
def test_a_full_disk(context: Any, run: Path, tmp_path: Path, mode: str, limit: int) -> None:
    """A limit on the size of a file fails the write that crosses it, as a full disk does."""
    out = tmp_path / "d"
    options: dict[str, Any] = {}
    if mode == "append":
        export(run, out, episodes=":2")
        options = {"append": True, "episodes": "2:"}
    before = files_of(tmp_path)
    assert exit_code(context, run, out, options, size_limit=limit) == 3  # ExportError, nothing else
    assert files_of(tmp_path) == before
    export(run, out, **options)  # and with room again it works


def test_a_full_disk_where_processes_leave_images(context: Any, run: Path, tmp_path: Path) -> None:
    before = files_of(tmp_path)
    assert exit_code(context, run, tmp_path / "d", {"workers": 2}, size_limit=500) == 3
    assert files_of(tmp_path) == before
    assert list(tmp_path.iterdir()) == []


def test_hdf5_killed_at_any_moment(context: Any, run: Path, tmp_path: Path) -> None:
    place = tmp_path / "place"
    out = place / "d.hdf5"
    export(run, out, "hdf5", episodes=":2")
    before = out.read_bytes()
    options: dict[str, Any] = {"exporter": "hdf5", "overwrite": True}
    export(run, tmp_path / "other.hdf5", "hdf5")
    after = (tmp_path / "other.hdf5").read_bytes()
    (tmp_path / "other.hdf5").write_bytes(before)  # since what is there is looked at
    calls = count_calls(run, tmp_path / "other.hdf5", options)
    leftovers = 0
    rng = np.random.default_rng(3)
    for moment in ((np.arange(KILLS) + rng.random(KILLS)) / KILLS * calls).astype(int).tolist():
        out.write_bytes(before)  # beside what the kills before have left
        assert exit_code(context, run, out, options, kill_at=max(1, moment)) == -signal.SIGKILL
        assert out.read_bytes() in (before, after), moment
        leftovers += len(list(place.iterdir())) > 1
    assert leftovers  # some were killed in the middle of their work
    export(run, out, **options)
    assert out.read_bytes() == after
    assert list(place.iterdir()) == [out]


@pytest.mark.parametrize("limit", [1, 50, 4_000, 60_000])
def test_hdf5_on_a_full_disk(context: Any, run: Path, tmp_path: Path, limit: int) -> None:
    out = tmp_path / "place" / "d.hdf5"
    export(run, out, "hdf5", episodes=":2")
    before = files_of(out.parent)
    options = {"exporter": "hdf5", "overwrite": True}
    assert exit_code(context, run, out, options, size_limit=limit) == 3
    assert files_of(out.parent) == before
