"""Parameters of sweeps: `make test-slow` takes a part of them, `make test-long` the rest."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def every_other_long(cases: Iterable[tuple[str, Any]]) -> list[Any]:
    """One parameter for each (name, value), named; neighbours are of a kind."""
    return [
        pytest.param(name, value, id=name, marks=[pytest.mark.slow, pytest.mark.long] if number % 2 else ())
        for number, (name, value) in enumerate(cases)
    ]


def first_of_each_kind(cases: dict[str, Any], kind: int) -> list[Any]:
    """The names of cases; long is each whose element `kind` an earlier one has, too."""
    first: dict[Any, str] = {}
    for name, case in cases.items():
        first.setdefault(case[kind], name)
    return [
        pytest.param(name, marks=() if first[case[kind]] == name else [pytest.mark.slow, pytest.mark.long])
        for name, case in cases.items()
    ]
