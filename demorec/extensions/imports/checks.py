"""Checks of an imported run: findings about its bags, and episodes and bags that the import left out.

An import stores its findings in import.json, because the bags may be gone later.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

from demorec.check.base import Fault, NotApplicableError, check, listed
from demorec.check.run import CheckedRun
from demorec.extensions.imports.import_file import ImportFile, load_import_file

_MAX_LISTED = 5

import_check = partial(
    check,
    family="files",
    on=("external run",),
    needs="an imported run",
    why="Data is missing from the run, or has the wrong time.",
    do="look at it: demorec view {path}",
)


@import_check(measures="findings of the import about clocks and losses")
def import_findings(run: CheckedRun) -> Iterator[Fault]:
    """List the findings of the import."""
    words = [
        f"{bag.name}: {finding.kind}, {finding.stream}: {finding.text}".replace(", : ", ": ")
        for bag in _import_file(run).bags
        for finding in bag.odd
    ]
    return listed(words, "look", _MAX_LISTED)


@import_check(measures="episodes that an import dropped, skipped files")
def import_dropped(run: CheckedRun) -> Iterator[Fault]:
    """List the episodes of the imported files that are not in the run, except those that a marker discards."""
    found = _import_file(run)
    rows = [row for bag in found.bags for row in bag.episodes if row.episode_index is None and not row.discarded]
    dropped = [row.reason for row in rows] + [f"{bag.name}: {bag.reason}" for bag in found.skipped]
    return listed(dropped, "look", _MAX_LISTED)


def _import_file(run: CheckedRun) -> ImportFile:
    if (found := load_import_file(run.path)) is None:
        raise NotApplicableError("the run was not imported")
    return found
