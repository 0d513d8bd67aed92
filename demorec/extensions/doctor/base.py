"""A check of the doctor: one fault that people report, the evidence that shows it, and what to do about it.

A check is a generator of `Fault`s with the decorator `check`. It reads an `Evidence`, asks for the roles that it needs,
and raises `NotMeasuredError` with the reason where it cannot judge. Its docstring is its page in `demorec explain`.
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
"""broken: training on it goes wrong or is impossible. look: unusual, a person should look at it."""
Verdict = Literal["good", "look", "broken"]
Family = Literal["files", "time", "numbers", "alignment", "images", "set"]
RANK: Mapping[str, int] = {"good": 0, "look": 1, "broken": 2}
"""How bad a verdict is."""


@dataclass(frozen=True, kw_only=True)
class Fault:
    """What a check found in one place.

    Attributes:
        severity: How bad it is.
        episode: Number of the episode; None for the whole set.
        frames: First and last frame; None for the whole episode.
        value: What was measured, with its unit.
        message: One sentence: what is wrong.
        do: What to do, where that differs from the check's own advice.
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
        needs: What it needs by role, in few words.
        measures: What it finds, in at most 50 characters.
        unit: Of its values.
        why, do: Why a fault matters, and what to do; `{path}` and `{episode}` are filled in.
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
        """Its explanation, for people."""
        return inspect.cleandoc(self.find.__doc__ or "")

    def run(self, evidence: Evidence) -> tuple[list[DiagnosedFault], str | None]:
        """Return what it finds, and why it could not be made: "" if it could, None if it does not apply.

        Raises:
            ResourceError: This machine cannot measure it, which says nothing about the data.
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
            if isinstance(error, ExportError) and self.family == "files":  # a file that cannot be read is a fault
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
    """Make a `FaultCheck` of a generator; its name is the function's."""

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
