"""Installed extensions: the core itself, the folders of `demorec/extensions/`, and those of other packages.

An installed package provides extensions by entry points in the group `demorec.extensions`, each "module:EXTENSION". An
extension that cannot be used is left out and reported; it does not affect the others.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from importlib.metadata import entry_points
from typing import Any

from demorec.core.extension import CommandRow, ExporterRow, Extension, ReaderRow

ENTRY_POINTS = "demorec.extensions"
"""Entry point group of other packages, and package of demorec's own extensions."""


@dataclass(frozen=True)
class Extensions:
    """Usable extensions, and problems with the others.

    Attributes:
        found: The core first, then the others by name.
        problems: One sentence for each extension left out.
    """

    found: tuple[Extension, ...]
    problems: tuple[str, ...]


@cache
def extensions() -> Extensions:
    """Find all extensions; cached for the lifetime of the process."""
    problems: list[str] = []
    declared = [_declaration("demorec", "demorec.extension:EXTENSION", problems)]
    declared += [_declaration(place, target, problems) for place, target in _targets()]
    usable: dict[str, Extension] = {}
    for extension in filter(None, declared):
        if problem := _clash(extension, usable):
            problems.append(problem)
        else:
            usable[extension.name] = extension
    while lacking := [each for each in usable.values() if not set(each.needs) <= usable.keys()]:
        for each in lacking:
            missing = ", ".join(sorted(set(each.needs) - usable.keys()))
            problems.append(f"The extension {each.name} is left out, since it needs {missing}.")
            del usable[each.name]
    return Extensions(found=tuple(usable.values()), problems=tuple(problems))


def _targets() -> Iterator[tuple[str, str]]:
    """Yield (place, "module:name") of each declaration."""
    package = importlib.import_module(ENTRY_POINTS)
    for module in sorted(pkgutil.iter_modules(package.__path__), key=lambda module: module.name):
        yield f"{ENTRY_POINTS}.{module.name}", f"{ENTRY_POINTS}.{module.name}.extension:EXTENSION"
    for point in sorted(entry_points(group=ENTRY_POINTS), key=lambda point: point.name):
        distribution = point.dist.name if point.dist is not None else point.module
        yield f"the package {distribution}", point.value


def _declaration(place: str, target: str, problems: list[str]) -> Extension | None:
    """Load a declaration; None, with a sentence among the problems, if that fails."""
    module, _, name = target.partition(":")
    try:
        found = getattr(importlib.import_module(module), name)
    except (Exception, SystemExit) as error:  # code of another package may raise anything
        words = f"{type(error).__name__}: {error}".rstrip(": ")
        problems.append(f"The extension of {place} is left out: {target} cannot be loaded ({words}).")
        return None
    if not isinstance(found, Extension):
        problems.append(f"The extension of {place} is left out: {target} is not a demorec.core.extension.Extension.")
        return None
    return found


def _clash(extension: Extension, others: Mapping[str, Extension]) -> str:
    """Describe a name conflict of an extension with another one; "" if there is none."""
    if extension.name in others:
        return f"The extension {extension.name} is left out, since another one has that name."
    for other in others.values():
        for table, rows in vars(other).items():
            own = getattr(extension, table)
            if isinstance(rows, Mapping) and (both := sorted(rows.keys() & own.keys())):
                kind = table.replace("_", " ")
                return (
                    f"The extension {extension.name} is left out, since {other.name} has {kind} with the same name: "
                    f"{', '.join(both)}."
                )
    return ""


def rows_of(table: str) -> Iterator[tuple[str, Any]]:
    """Yield (name, value) of a table, a field of `Extension`, over all extensions."""
    for extension in extensions().found:
        yield from getattr(extension, table).items()


def command_rows() -> dict[str, CommandRow]:
    """Name -> command of `demorec`."""
    return dict(rows_of("commands"))


def reader_rows() -> dict[str, ReaderRow]:
    """Kind of path -> its reader."""
    return dict(rows_of("readers"))


def exporter_rows() -> dict[str, ExporterRow]:
    """Name -> format for exporting recordings."""
    return dict(rows_of("exporters"))


@cache
def extension_packages() -> frozenset[str]:
    """Packages outside demorec whose extensions are installed, and whose files may therefore be read."""
    targets = [target for table in ("robots", "objects") for _, target in rows_of(table)]
    packages = {target.partition(":")[0].partition(".")[0] for target in targets}
    return frozenset(packages - {"demorec"})


def targets_of(table: str) -> dict[str, str]:
    """Name -> "module:name" of a table."""
    return {name: getattr(row, "target", row) for name, row in rows_of(table)}
