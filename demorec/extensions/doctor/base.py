"""A check of the doctor: one commonly reported fault, the evidence that shows it, and the fix.

A check is a generator of `Fault`s with the decorator `check`. It reads an `Evidence`, requests the roles that it needs,
and raises `NotMeasuredError` with the reason if it cannot judge. Its docstring is its page in `demorec explain`.
"""

from __future__ import annotations

import inspect
import logging
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from demorec.core.errors import DemorecError, ExportError, resource_error
from demorec.extensions.doctor.errors import NotApplicableError, NotMeasuredError

if TYPE_CHECKING:
    from demorec.extensions.doctor.evidence import Evidence

Severity = Literal["look", "broken"]
"""broken: training fails or gives wrong results. look: unusual, to be examined by a person."""
Verdict = Literal["good", "look", "broken"]
Family = Literal["files", "time", "numbers", "alignment", "images", "set"]
RANK: Mapping[str, int] = {"good": 0, "look": 1, "broken": 2}
"""Severity rank of a verdict."""


@dataclass(frozen=True, kw_only=True)
class Fault:
    """One finding of a check in one place.

    Attributes:
        severity: Severity of the fault.
        episode: Number of the episode; None for the whole set.
        frames: First and last frame; None for the whole episode.
        value: Measured value, with its unit.
        message: One sentence that describes the fault.
        do: The fix, if it differs from the check's own advice.
    """

    severity: Severity
    episode: int | None = None
    frames: tuple[int, int] | None = None
    value: str = ""
    message: str
    do: str = ""


@dataclass(frozen=True, kw_only=True)
class DiagnosedFault(Fault):
    """A fault with the name of its check and its reasons.

    Attributes:
        check: Name of the check.
        why: Why it matters.
    """

    check: str
    why: str


@dataclass(frozen=True, kw_only=True)
class FaultCheck:
    """One check.

    Attributes:
        name, family: A noun, and its group.
        needs: Required roles, in a few words.
        measures: Its finding in at most 50 characters.
        unit: Unit of its values.
        why, do: Why a fault matters, and the fix; `{path}` and `{episode}` are filled in.
        find: The generator.
    """

    name: str
    family: Family
    needs: str
    measures: str
    unit: str
    why: str
    do: str
    find: Callable[[Evidence], Iterator[Fault]]

    @property
    def page(self) -> str:
        """Explanation for users."""
        return inspect.cleandoc(self.find.__doc__ or "")

    def run(self, evidence: Evidence) -> tuple[list[DiagnosedFault], str | None]:
        """Return its findings, and the reason why it could not run: "" if it could, None if it does not apply.

        Raises:
            ResourceError: This machine cannot measure it, which implies nothing about the data.
        """
        found: list[DiagnosedFault] = []
        try:
            found += (self._finding(fault, evidence) for fault in self.find(evidence))
        except NotApplicableError:
            return found, None
        except NotMeasuredError as error:
            return found, str(error)
        except Exception as error:
            if (lack := resource_error(error)) is not None:
                raise lack from error
            if isinstance(error, ExportError) and self.family == "files":  # an unreadable file is a fault
                return [*found, self._finding(Fault(severity="broken", message=str(error)), evidence)], ""
            if isinstance(error, DemorecError):
                return found, str(error)
            # Data that break one check in an unforeseen way must not hide the findings of the others.
            logging.getLogger(__name__).debug("check %s", self.name, exc_info=True)
            return found, f"the data are such that it cannot be computed ({type(error).__name__})"
        return found, ""

    def _finding(self, fault: Fault, evidence: Evidence) -> DiagnosedFault:
        number = "" if fault.episode is None else str(fault.episode)
        do = (fault.do or self.do).format(path=evidence.quoted_path, episode=number)
        if evidence.folder is None and "demorec dataset" in do:
            name = evidence.names.get(-1 if fault.episode is None else fault.episode, "the recordings")
            do = f"look at it: demorec view {evidence.quoted_path}; then leave {name} out, or record it again"
        return DiagnosedFault(**{**vars(fault), "do": do}, check=self.name, why=self.why)


def check(
    *, family: Family, needs: str, measures: str, unit: str = "", why: str, do: str
) -> Callable[[Callable[[Evidence], Iterator[Fault]]], FaultCheck]:
    """Make a `FaultCheck` from a generator; the function's name becomes the check's."""

    def wrap(function: Callable[[Evidence], Iterator[Fault]]) -> FaultCheck:
        return FaultCheck(
            name=function.__name__,
            family=family,
            needs=needs,
            measures=measures,
            unit=unit,
            why=why,
            do=do,
            find=function,
        )

    return wrap


DROP = "demorec dataset drop {path} --episodes {episode} --out NEW"
"""Advice for one bad episode."""
