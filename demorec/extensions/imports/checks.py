"""Checks of an imported run: findings about its bags, and episodes and bags that the import left out.

An import stores its findings in import.json, because the bags may be gone later.
"""

from __future__ import annotations

import math
from functools import partial

from demorec.check.base import Found, Measurement, check
from demorec.check.run import CheckedRun
from demorec.extensions.imports.import_file import load_import_file

_MAX_LISTED = 5

import_check = partial(check, group="import", on=("external run",), needs="an imported run", fail=math.inf)


@import_check(measures="findings of the import about clocks and losses")
def import_findings(run: CheckedRun) -> Found:
    """List the findings of the import."""
    if (found := load_import_file(run.path)) is None:
        return None
    words = [
        f"{bag.name}: {finding.kind}, {finding.stream}: {finding.text}".replace(", : ", ": ")
        for bag in found.bags
        for finding in bag.odd
    ]
    return Measurement(value=len(words), detail="; ".join(words[:_MAX_LISTED]))


@import_check(measures="episodes that an import dropped, skipped files")
def import_dropped(run: CheckedRun) -> Found:
    """List the episodes of the imported files that are not in the run, except those that a marker discards."""
    if (found := load_import_file(run.path)) is None:
        return None
    rows = [row for bag in found.bags for row in bag.episodes if row.episode_index is None and not row.discarded]
    dropped = [row.reason for row in rows] + [f"{bag.name}: {bag.reason}" for bag in found.skipped]
    return Measurement(value=len(dropped), detail="; ".join(dropped[:_MAX_LISTED]))
