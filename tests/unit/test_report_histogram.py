"""Histograms of a report: exact counts whatever the order and the parts in which values come."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import example, given
from hypothesis import strategies as st

from demorec.report.histogram import MOST_BINS, Histogram

VALUES = st.lists(st.floats(-1e6, 1e6) | st.sampled_from([0.0, 1e-9, -1e-9, 0.25]), min_size=1, max_size=60)


def counted(*parts: list[float]) -> Histogram:
    histogram = Histogram()
    for part in parts:
        histogram.add(np.array(part))
    return histogram


@given(VALUES)
@example([47.0, -5e-324])
def test_every_value_is_in_the_bin_that_holds_it(values: list[float]) -> None:
    histogram = counted(values)
    assert len(histogram.bins) <= max(histogram.bins) - min(histogram.bins) + 1 <= MOST_BINS
    assert histogram.count == sum(histogram.bins.values()) == len(values)
    assert (histogram.minimum, histogram.maximum) == (min(values), max(values))
    assert math.isclose(histogram.mean, math.fsum(values) / len(values), rel_tol=1e-9, abs_tol=1e-9)
    for number, count in histogram.bins.items():
        low, high = number * histogram.width, (number + 1) * histogram.width
        assert count == sum(low <= value < high for value in values)


@given(VALUES, VALUES)
@example([0.0], [2.9e-205])
@example([-5e-324], [47.0])
def test_parts_count_as_the_whole_in_any_order(first: list[float], second: list[float]) -> None:
    whole = counted(first + second)
    for histogram in (counted(first, second), counted(second, first)):
        assert (histogram.exponent, histogram.bins) == (whole.exponent, whole.bins)


def test_what_is_no_number_is_counted_apart() -> None:
    histogram = counted([1.0, math.nan, math.inf], [math.nan], [-math.inf])
    assert (histogram.count, histogram.not_finite, histogram.mean) == (1, 4, 1.0)
    assert math.isnan(counted([math.nan]).mean)
