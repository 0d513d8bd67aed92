"""The limits of checks whose values vary from one good recording to the next: a table, with what it was calibrated on.

`benchmarks/check_limits.py` measures the largest values of good recordings and writes them into the table; the limits
beside them are set by hand, and a test holds them to the margin.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from demorec.core.plain import from_plain

TABLE = Path(__file__).with_name("limits.toml")


@dataclass(frozen=True, kw_only=True)
class LimitCalibration:
    """What the largest values were measured on.

    Attributes:
        seed: Of all episodes.
        date: Of the measurement, ISO 8601.
        episodes: How many.
        settings: Of what kinds they were.
        margin: A warning begins at so many times the largest value, at least.
    """

    seed: int
    date: str
    episodes: int
    settings: str
    margin: float


@dataclass(frozen=True, kw_only=True)
class Limit:
    """Of one check.

    Attributes:
        warn, fail: As of `demorec.check.base.Check`.
        largest: Of all values that good recordings gave.
    """

    warn: float
    fail: float
    largest: float


@dataclass(frozen=True, kw_only=True)
class LimitTable:
    """The whole table: check -> its limits."""

    calibration: LimitCalibration
    checks: Mapping[str, Limit]


def read_table() -> LimitTable:
    """The table that comes with demorec, as it is on disk now."""
    return from_plain(tomllib.loads(TABLE.read_text()), LimitTable)


limit_table = cache(read_table)
"""The same, read once."""
