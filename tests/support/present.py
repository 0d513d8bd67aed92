"""Unwrap values that may be None (a depth image, a wrench) where a test expects them to exist."""

from __future__ import annotations


def present[T](value: T | None) -> T:
    """Return the value; raises AssertionError if it is None."""
    assert value is not None
    return value
