"""What the import of a run found in its bags: the report that `demorec import` keeps in import.json, judged again.

The bags themselves need not be there any more.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

from demorec.check.base import Found, Measurement, check
from demorec.check.run import CheckedRun

if TYPE_CHECKING:
    from demorec.sources.import_file import ImportFile

_TIMES = frozenset(
    ("clock_offset", "clock_jump", "clock_drift", "unstamped", "drops", "gap", "slow", "fps", "jitter", "order")
) | {"duplicates", "late_start", "early_end", "cut_off", "repeats", "skips"}
_IMAGES = frozenset(("frozen", "same_pictures", "swapped", "size", "format", "keyframe", "frame_id"))
_MOST_LISTED = 5

import_check = partial(check, on=("external run",), needs="a run that was imported", fail=math.inf)


@import_check(
    group="time",
    measures="findings about times in the bags that were imported: clocks, losses, gaps, repeats, jitter, order",
)
def import_times(run: CheckedRun) -> Found:
    """The streams of the bags were whole, in order and on one clock."""
    return _found(run, lambda kind: kind in _TIMES)


@import_check(
    group="images",
    measures="findings about cameras in the bags that were imported: frozen, swapped, of several sizes",
)
def import_images(run: CheckedRun) -> Found:
    """Each camera showed its own images, of one size and kind."""
    return _found(run, lambda kind: kind in _IMAGES)


@import_check(
    group="physics",
    measures="findings about numbers in the bags that were imported: NaN, stuck sensors, spikes, units",
)
def import_numbers(run: CheckedRun) -> Found:
    """The numbers of the bags were such as robots have."""
    return _found(run, lambda kind: kind not in _TIMES | _IMAGES)


@import_check(
    group="run",
    measures="episodes that an import dropped, since something was missing or too old, and bags that it skipped",
)
def import_dropped(run: CheckedRun) -> Found:
    """Every episode that the bags hold is in the run, but those that a marker discards."""
    if (found := _import(run)) is None:
        return None
    rows = [row for bag in found.bags for row in bag.episodes if row.episode_index is None and not row.discarded]
    dropped = [row.reason for row in rows] + [f"{bag.name}: {bag.reason}" for bag in found.skipped]
    return Measurement(value=len(dropped), detail="; ".join(dropped[:_MOST_LISTED]))


def _import(run: CheckedRun) -> ImportFile | None:
    from demorec.sources.import_file import load_import_file

    return load_import_file(run.path)


def _found(run: CheckedRun, is_mine: Callable[[str], bool]) -> Found:
    if (found := _import(run)) is None:
        return None
    words = [
        f"{bag.name}: {finding.kind}, {finding.stream}: {finding.text}".replace(", : ", ": ")
        for bag in found.bags
        for finding in bag.odd
        if is_mine(finding.kind)
    ]
    return Measurement(value=len(words), detail="; ".join(words[:_MOST_LISTED]))
