"""Intervals and tests against SciPy's."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binomtest

from demorec.extensions.policies.statistics import Rate, compare, sign_test


@given(st.integers(1, 2000).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))))
def test_the_interval_is_wilsons(counts: tuple[int, int]) -> None:
    k, n = counts
    expected = binomtest(k, n).proportion_ci(0.95, method="wilson")
    assert Rate(successes=k, trials=n).interval == pytest.approx((expected.low, expected.high), abs=1e-9)


@given(st.integers(0, 60), st.integers(0, 60))
def test_mcnemars_exact_test(k: int, m: int) -> None:
    expected = binomtest(k, k + m).pvalue if k + m else 1.0
    assert sign_test(k, m) == pytest.approx(expected, abs=1e-9)


def test_newcombes_interval_of_a_difference() -> None:
    """The worked example of Newcombe (1998), table II: 56/70 - 48/80, method 10: 0.0524 to 0.3339."""
    first = {i: i < 48 for i in range(80)}
    second = {i: i < 56 for i in range(70)}
    comparison = compare(first, second)
    assert comparison.difference == pytest.approx(0.2)
    assert comparison.interval == pytest.approx((0.0524, 0.3339), abs=5e-5)
