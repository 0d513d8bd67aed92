"""Edits of datasets that die: killed at any moment, or out of disk. The source stays, the result is whole or absent."""

from __future__ import annotations

import multiprocessing
import shutil
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.export import calls_counted, export, files_of, in_child, make_run

from demorec.datasets.editing.operations import reorder, trim
from demorec.datasets.editing.plan import Source
from demorec.datasets.editing.write import write_plan

KILLS = 30

pytestmark = pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("source")
    run = make_run(folder / "run", (6, 5, 7, 6), failures=(1,))
    export(run, folder / "d", progress=True)
    return folder / "d"


def edit(source: Path, out: Path, order: tuple[int, ...] = (2, 0, 3, 1)) -> None:
    write_plan(reorder(Source(source), order=order), out, overwrite=True)


def exit_code(source: Path, out: Path, **limits: int) -> int:
    context: Any = multiprocessing.get_context("fork")
    process = context.Process(target=in_child, args=(lambda: edit(source, out),), kwargs=limits)
    process.start()
    process.join(120)
    assert process.exitcode is not None
    return int(process.exitcode)


def killed(source: Path, out: Path, kills: int) -> None:
    was = files_of(source)

    def start_anew() -> None:
        shutil.rmtree(out, ignore_errors=True)
        write_plan(trim(Source(source), 1, 0), out)

    start_anew()
    before = files_of(out)
    edit(source, out)  # whatever is loaded at first use is loaded now
    after = files_of(out)
    start_anew()
    with calls_counted() as calls:
        edit(source, out)
    assert files_of(out) == after != before
    rng = np.random.default_rng(5)
    leftovers = 0
    for moment in ((np.arange(kills) + rng.random(kills)) / kills * calls[0]).astype(int).tolist():
        start_anew()
        assert exit_code(source, out, kill_at=max(1, moment)) == -signal.SIGKILL
        assert files_of(out) in (before, after), moment
        leftovers += len(list(out.parent.iterdir())) > 1
    assert leftovers  # some were killed in the middle of their work
    start_anew()
    edit(source, out)  # the next edit cleans up and works
    assert files_of(out) == after
    assert [path.name for path in out.parent.iterdir()] == ["d"]
    assert files_of(source) == was


def test_killed_at_a_few_moments(source: Path, tmp_path: Path) -> None:
    killed(source, tmp_path / "d", 3)


@pytest.mark.slow
@pytest.mark.long
def test_killed_at_any_moment(source: Path, tmp_path: Path) -> None:
    killed(source, tmp_path / "d", KILLS)


@pytest.mark.parametrize("limit", [200, 500, 2_000, 4_000, 8_000])
def test_a_full_disk(source: Path, tmp_path: Path, limit: int) -> None:
    """A limit on the size of a file fails the write that crosses it, as a full disk does."""
    out, was = tmp_path / "d", files_of(source)
    write_plan(trim(Source(source), 1, 0), out)
    before = files_of(tmp_path)
    assert exit_code(source, out, size_limit=limit) == 3
    assert files_of(tmp_path) == before
    assert files_of(source) == was
    edit(source, out)  # and with room again it works
