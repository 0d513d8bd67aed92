"""Values that may be None (a depth image, a wrench), where a test knows that they are there."""

from __future__ import annotations


def present[T](value: T | None) -> T:
    """The value; an AssertionError where there is none."""
    assert value is not None
    return value
