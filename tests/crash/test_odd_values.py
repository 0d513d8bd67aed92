"""Well-formed but odd input to every command: one sentence or success, never a traceback, never a hang.

`support.odd` makes the cases, each from its number. The commands are run below the command line's own net for
unforeseen errors, so that nothing hides in it.
"""

from __future__ import annotations

import contextlib
import io
from collections import Counter

import pytest
from support.odd import Odd

from demorec.cli import COMMANDS, parse_command
from demorec.core.errors import DemorecError
from demorec.core.text import printable


@pytest.fixture(scope="module")
def odd(tmp_path_factory: pytest.TempPathFactory) -> Odd:
    return Odd(tmp_path_factory.mktemp("odd"))


def answer(arguments: list[str]) -> int | str:
    """The exit code of a command, or its refusal; whatever else leaves it is a defect."""
    name, *rest = arguments
    said = io.StringIO()
    try:
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            code: int | str = parse_command(COMMANDS.load(name), rest, prog=f"demorec {name}").run()
    except DemorecError as error:
        code = str(error)
        assert code, "a refusal without words"
        assert len(printable(code)) < 4000, code
    lines = said.getvalue().split("\n")
    assert all(printable(line) == line for line in lines), lines
    return code


def run_cases(odd: Odd, numbers: range) -> Counter[str]:
    results: Counter[str] = Counter()
    for number in numbers:
        what, arguments = odd.case(number)
        try:
            code = answer(arguments)
        except Exception as error:
            raise AssertionError(f"case {number}, {what}: demorec {' '.join(arguments)}") from error
        results["refused" if isinstance(code, str) else f"exit code {code}"] += 1
    return results


@pytest.mark.filterwarnings("ignore")
def test_forty_odd_files(odd: Odd) -> None:
    results = run_cases(odd, range(40))
    assert results["refused"] > 8, results
    assert results["exit code 0"] > 4, results


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("part", range(4))
def test_five_thousand_odd_files(odd: Odd, part: int, capsys: pytest.CaptureFixture[str]) -> None:
    results = run_cases(odd, range(1000 + 1250 * part, 1000 + 1250 * (part + 1)))
    with capsys.disabled():
        print("\nodd values: " + ", ".join(f"{count} {what}" for what, count in sorted(results.items())))
    assert sum(results.values()) == 1250
