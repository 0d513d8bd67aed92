"""`demorec explain`: input of one check, why it matters, and the fix for its findings."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from demorec.cli.shared.flags import Positional, terminal_width
from demorec.cli.shared.output import say
from demorec.core.errors import ConfigError
from demorec.core.registry import nearest_match

if TYPE_CHECKING:
    from demorec.check.base import Check


@dataclass(frozen=True, kw_only=True)
class Explain:
    """Explain a check: its input, its limits, why it matters, and the fix.

    Examples:
      demorec explain action_lag
      demorec explain frozen_images
    """

    check: Positional[str]
    """Name of the check, as demorec check prints it and demorec list checks lists it."""

    def run(self) -> int:
        """Print the page of the check."""
        from demorec.core.tables import FILE_CHECKS

        _, doctors = split_checks((self.check,))
        found = doctors[0] if doctors else FILE_CHECKS.load(self.check)
        width = min(terminal_width(), 100)
        lines = [self.check, ""]
        for paragraph in found.page.split("\n\n"):
            lines += [*textwrap.wrap(" ".join(paragraph.split()), width), ""]
        rows = [("finds", found.measures), ("needs", found.needs), ("unit", found.unit or "none")]
        rows += [("why", found.why), ("do", found.do)]
        say(*lines, *(line for name, text in rows for line in _row(name, text, width)))
        return 0


def _row(name: str, text: str, width: int) -> Iterator[str]:
    text = text.format(path="DATASET", episode="N", camera="CAMERA")
    yield from textwrap.wrap(text, width, initial_indent=f"{name:<7}", subsequent_indent=" " * 7)


def split_checks(names: Sequence[str]) -> tuple[tuple[str, ...], tuple[Check, ...]]:
    """Find the named checks: names of file integrity checks, and checks of the doctor; all of them without names.

    Raises:
        ConfigError: Unknown check.
    """
    from demorec.core.tables import FILE_CHECKS
    from demorec.extensions.doctor.checks import all_checks

    if not names:
        return (), all_checks()
    doctors = {check.name: check for check in all_checks()}
    for name in names:
        if name not in doctors and name not in FILE_CHECKS.names():
            near = nearest_match(name, [*doctors, *FILE_CHECKS.names()])
            raise ConfigError(f"Unknown check {name!r}.{near} demorec list checks prints them.")
    return tuple(n for n in names if n not in doctors), tuple(doctors[n] for n in names if n in doctors)


def check_rows() -> Iterator[tuple[str, str]]:
    """Yield (name, summary) of every check, the doctor's first."""
    from demorec.core.tables import FILE_CHECKS
    from demorec.extensions.doctor.checks import all_checks

    for check in all_checks():
        yield check.name, check.measures
    for name in FILE_CHECKS.names():
        yield name, FILE_CHECKS.load(name).measures
