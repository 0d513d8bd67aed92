"""Datasets, HDF5 files, mappings, runs, recordings and policies, fuzzed: a sentence or success within bounds."""

from __future__ import annotations

import contextlib
import io
import shutil
from collections import Counter

import pytest
from support.fuzz import LimitedCommands, problem_of
from support.fuzz_data import FuzzedData

from demorec.cli import COMMANDS, parse_command
from demorec.errors import DemorecError

_MODULES = (
    "demorec.check.run", "demorec.ingest.dataset_import", "demorec.ingest.hdf5_import", "demorec.ingest.hdf5_suggest",
    "demorec.lerobot.inspect", "demorec.lerobot.export", "demorec.hdf5.export", "demorec.report.gather",
    "demorec.evaluate.rollouts",
)  # fmt: skip


@pytest.fixture(scope="module")
def fuzzed(tmp_path_factory: pytest.TempPathFactory) -> FuzzedData:
    return FuzzedData(tmp_path_factory.mktemp("fuzzed"))


def _clear(fuzzed: FuzzedData) -> None:
    for path in fuzzed.folder.glob("out*"):
        shutil.rmtree(path) if path.is_dir() else path.unlink()


@pytest.mark.filterwarnings("ignore")
def test_a_few_hundred_inputs(fuzzed: FuzzedData) -> None:
    """In this process, below the net for unforeseen errors: an exception of any other tree fails the test."""
    results: Counter[str] = Counter()
    for number in range(150):
        what, (name, *arguments) = fuzzed.case(number)
        said = io.StringIO()
        try:
            with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
                parse_command(COMMANDS.load(name), arguments, prog=f"demorec {name}").run()
            results["done"] += 1
        except DemorecError:
            results["refused"] += 1
        except Exception as error:
            raise AssertionError(f"case {number}, {what}: demorec {name} {' '.join(arguments)}") from error
        _clear(fuzzed)
    assert min(results["done"], results["refused"]) > 30, results


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("part", [0, *(pytest.param(part, marks=pytest.mark.long) for part in range(1, 5))])
def test_two_and_a_half_thousand_inputs(fuzzed: FuzzedData, part: int) -> None:
    found = []
    with LimitedCommands(_MODULES) as commands:
        for number in range(1000 + 500 * part, 1500 + 500 * part):
            what, arguments = fuzzed.case(number)
            told = commands.run(*arguments)
            if problem := problem_of(told):
                found.append(f"case {number}, {what}: {problem}: {told.text[-300:]}")
            _clear(fuzzed)
    assert not found, "\n".join(found)
