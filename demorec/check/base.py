"""A check: one commonly reported fault, the data that show it, and the fix.

A check is a generator of `Fault`s with the decorator `check`. It gets a recording, a run, a dataset or a set of
episodes, and raises `NotMeasuredError` with the reason if it cannot judge. Its docstring is its page in
`demorec explain`.
"""

from __future__ import annotations

import inspect
import logging
import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, Protocol

from demorec.core.errors import DemorecError, MissingDependencyError, resource_error, without_path

Severity = Literal["look", "broken"]
"""broken: training fails or gives wrong results. look: unusual, to be examined by a person."""
Verdict = Literal["good", "look", "broken"]
RANK: Mapping[str, int] = {"good": 0, "look": 1, "broken": 2}
"""Severity rank of a verdict."""
Family = Literal["files", "time", "numbers", "alignment", "images", "set"]
FAMILIES: tuple[Family, ...] = ("files", "time", "numbers", "alignment", "images", "set")
Form = Literal["simulated", "external", "run", "external run", "dataset", "episodes"]
"""Subject of a check: a simulated recording, an external one, a run of either, a LeRobot dataset that demorec wrote, or
the episodes of any source, read by the doctor."""


class NotMeasuredError(Exception):
    """A check cannot judge its subject; the text gives the reason."""


class NotApplicableError(NotMeasuredError):
    """A check is about other kinds of data, or was not requested."""


class Checkable(Protocol):
    """Subject of checks."""

    @property
    def path(self) -> Path:
        """Its path, for advice."""


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
class Finding(Fault):
    """A fault with the name of its check and its reasons.

    Attributes:
        check: Name of the check.
        why: Why it matters.
    """

    check: str
    why: str


@dataclass(frozen=True, kw_only=True)
class CheckResult:
    """Result of a check on one subject.

    Attributes:
        check: Its name.
        findings: Its findings.
        not_measured: Reason why it could not judge, or not everything; "" if it could.
    """

    check: str
    findings: tuple[Finding, ...] = ()
    not_measured: str = ""

    @property
    def verdict(self) -> Verdict | Literal["not measured"]:
        """Severity of the worst finding."""
        if not self.findings:
            return "not measured" if self.not_measured else "good"
        return max((finding.severity for finding in self.findings), key=RANK.__getitem__)


@dataclass(frozen=True, kw_only=True)
class Check:
    """One check, and the decorator `check` that makes it from a generator of faults.

    Attributes:
        family: Its group.
        on: Forms that it can check.
        needs: Required data or roles, in a few words.
        measures: Its finding in at most 50 characters.
        unit: Unit of its values.
        why, do: Why a fault matters, and the fix; `{path}` and `{episode}` are filled in.
        needs_images: Whether images must be decoded for it alone.
        name, find: The generator's name, a noun, and the generator.
    """

    family: Family
    on: tuple[Form, ...] = ("episodes",)
    needs: str
    measures: str
    unit: str = ""
    why: str
    do: str
    needs_images: bool = False
    name: str = ""
    find: Callable[[Any], Iterator[Fault]] = field(default=lambda subject: iter(()), repr=False)

    def __call__(self, find: Callable[[Any], Iterator[Fault]]) -> Check:
        """Return the check with its generator."""
        return replace(self, name=find.__name__, find=find)

    @property
    def page(self) -> str:
        """Explanation for users."""
        return inspect.cleandoc(self.find.__doc__ or "")

    def run(self, subject: Checkable) -> CheckResult | None:
        """Return its findings; None if it does not apply.

        An error while reading is a finding of a check of files, and a reason for not measuring of any other.

        Raises:
            ResourceError: This machine cannot measure it, which implies nothing about the data.
        """
        found: list[Finding] = []
        path = shlex.quote(str(subject.path))
        reason = ""
        try:
            for fault in self.find(subject):
                found.append(self._finding(fault, path))
        except NotApplicableError:
            return None
        except (NotMeasuredError, MissingDependencyError) as error:
            reason = str(error)
        except Exception as error:
            if (lack := resource_error(error)) is not None:
                raise lack from error
            # Data that break one check in an unforeseen way must not hide the findings of the others.
            logging.getLogger(__name__).debug("check %s", self.name, exc_info=True)
            reason = str(error) if isinstance(error, DemorecError) else "it cannot be computed on these data"
            reason = without_path(reason, subject.path)
            if self.family == "files":
                found.append(self._finding(Fault(severity="broken", message=reason), path))
                reason = ""
        return CheckResult(check=self.name, findings=tuple(found), not_measured=reason)

    def _finding(self, fault: Fault, path: str) -> Finding:
        number = "" if fault.episode is None else str(fault.episode)
        do = (fault.do or self.do).replace("{path}", path).replace("{episode}", number)
        return Finding(**{**vars(fault), "do": do}, check=self.name, why=self.why)


check = Check
"""Decorator of a generator of faults, whose name becomes the check's."""


def listed(wrong: Sequence[str], severity: Severity = "broken", shown: int = 3) -> Iterator[Fault]:
    """Yield one fault with the number of wrong parts and the first ones by name; none if nothing is wrong."""
    if wrong:
        yield Fault(severity=severity, value=str(len(wrong)), message="; ".join(wrong[:shown]))
