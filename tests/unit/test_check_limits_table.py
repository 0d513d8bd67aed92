"""The calibrated limits: they leave the margin that the table promises, and each belongs to a check."""

from __future__ import annotations

import pytest

from demorec.check.base import limit_table
from demorec.core.tables import CHECKS

TABLE = limit_table()


@pytest.mark.parametrize("name", list(TABLE["checks"]))
def test_a_limit_is_that_of_its_check_and_above_what_good_recordings_gave(name: str) -> None:
    limit, check = TABLE["checks"][name], CHECKS.load(name)
    assert check.simulated == (limit["warn"], limit["fail"])
    assert 0 <= limit["largest"] * TABLE["calibration"]["margin"] <= limit["warn"] <= limit["fail"]


def test_the_table_says_what_it_was_calibrated_on() -> None:
    assert TABLE["calibration"]["episodes"] >= 20
    assert TABLE["calibration"]["margin"] > 1
