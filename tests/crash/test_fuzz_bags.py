"""Bags, their mappings and messages, fuzzed: a sentence or success within bounds, and never a traceback."""

from __future__ import annotations

import contextlib
import io
import shutil
from collections import Counter

import pytest
from support.fuzz import LimitedCommands, problem_of
from support.fuzz_bags import FuzzedBags

from demorec.cli import COMMANDS, parse_command
from demorec.errors import DemorecError

_MODULES = ("demorec.ingest.suggest", "demorec.ingest.import_run", "ruamel.yaml", "google.protobuf.descriptor_pool")


@pytest.fixture(scope="module")
def fuzzed(tmp_path_factory: pytest.TempPathFactory) -> FuzzedBags:
    return FuzzedBags(tmp_path_factory.mktemp("fuzzed"))


def _clear(fuzzed: FuzzedBags) -> None:
    shutil.rmtree(fuzzed.folder / "run", ignore_errors=True)


@pytest.mark.filterwarnings("ignore")
def test_two_hundred_bags(fuzzed: FuzzedBags) -> None:
    """In this process, below the net for unforeseen errors: an exception of any other tree fails the test."""
    results: Counter[str] = Counter()
    for number in range(220):
        what, arguments = fuzzed.case(number)
        said = io.StringIO()
        try:
            with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
                parse_command(COMMANDS.load("import"), arguments[1:], prog="demorec import").run()
            results["done"] += 1
        except DemorecError:
            results["refused"] += 1
        except Exception as error:
            raise AssertionError(f"case {number}, {what}: demorec {' '.join(arguments)}") from error
        _clear(fuzzed)
    assert min(results["done"], results["refused"]) > 50, results


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("part", [0, *(pytest.param(part, marks=pytest.mark.long) for part in range(1, 5))])
def test_two_and_a_half_thousand_bags(fuzzed: FuzzedBags, part: int) -> None:
    found = []
    with LimitedCommands(_MODULES) as commands:
        for number in range(1000 + 500 * part, 1500 + 500 * part):
            what, arguments = fuzzed.case(number)
            told = commands.run(*arguments)
            if problem := problem_of(told):
                found.append(f"case {number}, {what}: {problem}: {told.text[-300:]}")
            _clear(fuzzed)
    assert not found, "\n".join(found)
