"""A check: one function that measures one quantity, with the limits that judge it.

A check returns the worst value and its place. The limits turn the value into pass, warn or fail, so that a report shows
both the value and the limit. `demorec list checks` prints the limits. Larger values are worse.
"""

from __future__ import annotations

import inspect
import logging
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial, wraps
from typing import Any, Literal

import numpy as np

from demorec.core.errors import DemorecError, MissingDependencyError, resource_error
from demorec.core.geometry import Array

Level = Literal["pass", "warn", "fail", "skip"]
Form = Literal["simulated", "external", "run", "external run", "dataset"]
"""Subject of a check: a simulated recording, an external one, a run of either, or a LeRobot dataset."""
Group = Literal["file", "time", "images", "run", "import", "dataset"]
ADVICE: Mapping[Group, tuple[str, str]] = {
    "file": ("The recording is damaged or incomplete.", "demorec recover {path}, or record it again"),
    "time": ("Streams and frames do not match.", "record it again: the file was changed, or written wrongly"),
    "images": ("Images are missing or damaged.", "record it again, or leave it out"),
    "run": ("The run differs from its run.json.", "run the command that began it again, or restore the files"),
    "import": ("Data is missing from the run, or has the wrong time.", "look at it: demorec view {path}"),
    "dataset": ("The dataset differs from the export.", "export it again"),
}
"""Group -> why a fault matters, and what to do."""

BLOCKED = "it needs a damaged part"
NOTHING = "nothing to measure"

SCENE = "a simulated scene"


@dataclass(frozen=True, kw_only=True)
class Measurement:
    """Result of a measurement.

    Attributes:
        value: The worst value, in the check's unit.
        frame: Frame of that value; None if it belongs to no single frame.
        detail: Description for people (which joint, topic, camera or file).
    """

    value: float
    frame: int | None = None
    detail: str = ""


@dataclass(frozen=True, kw_only=True)
class NotMeasured:
    """A check that cannot judge its subject.

    Attributes:
        why: Reason for people: "too few frames", or the missing data.
    """

    why: str


Found = Measurement | NotMeasured | None
"""Result of a check; None if it does not apply (no cameras, no depth)."""


@dataclass(frozen=True, kw_only=True)
class Check:
    """One check.

    Attributes:
        name: Its row in `demorec.core.tables.FILE_CHECKS`.
        group: Kind of fault.
        on: Forms of subjects that it can check if the other requirements are met.
        needs: Required data, in a few words.
        measures: Meaning of the value, in words.
        unit: Unit of the value and the limits; "" for counts and ratios.
        warn, fail: A value up to `warn` passes, up to `fail` is a warning, and above is a failure.
        needs_images: Whether images must be decoded.
        measure: The function.
    """

    name: str
    group: Group
    on: tuple[Form, ...]
    needs: str
    measures: str
    unit: str
    warn: float
    fail: float
    needs_images: bool
    measure: Callable[[Any], Found]

    @property
    def why(self) -> str:
        """Why a fault matters."""
        return ADVICE[self.group][0]

    @property
    def do(self) -> str:
        """Remedy; `{path}` is a placeholder for the file."""
        return ADVICE[self.group][1]

    @property
    def page(self) -> str:
        """Explanation for people."""
        return f"{inspect.cleandoc(self.measure.__doc__ or '')}\n\n{self.summary}."

    @property
    def summary(self) -> str:
        """One line for `demorec list checks`."""
        unit = f" {self.unit}" if self.unit else ""
        warns = "" if self.warn == self.fail else f"warns above {self.warn:g}{unit}, "
        fails = "never fails" if math.isinf(self.fail) else f"fails above {self.fail:g}{unit}"
        return f"{self.group}, needs {self.needs}: {self.measures}; {warns}{fails}"

    def run(self, subject: object) -> Result:
        """Measure and judge; an error while reading or computing is a failure of this check, but a missing package is
        not.

        Raises:
            ResourceError: The machine lacks resources; this implies nothing about the subject.
        """
        try:
            found = self.measure(subject)
        except MissingDependencyError as error:
            return self.skipped(str(error))
        except Exception as error:
            if (lack := resource_error(error)) is not None:
                raise lack from error
            if isinstance(error, DemorecError):
                return self._result("fail", Measurement(value=math.nan, detail=str(error)))
            # An unforeseen fault must not discard the findings of other checks.
            logging.getLogger(__name__).debug("check %s", self.name, exc_info=True)
            odd = Measurement(value=math.nan, detail="this check cannot be computed on these data")
            return self._result("fail", odd)
        if found is None:
            return self.skipped(NOTHING)
        if isinstance(found, NotMeasured):
            return self.skipped(found.why)
        level: Level = "pass" if found.value <= self.warn else "warn" if found.value <= self.fail else "fail"
        return self._result(level, found)

    def skipped(self, why: str) -> Result:
        """Result of a check that could not be run."""
        return self._result("skip", Measurement(value=math.nan, detail=why))

    def _result(self, level: Level, found: Measurement) -> Result:
        return Result(
            check=self.name,
            group=self.group,
            level=level,
            value=float(found.value) if math.isfinite(found.value) else None,
            unit=self.unit,
            warn=self.warn,
            fail=self.fail,
            frame=found.frame,
            detail=found.detail,
            why=self.why,
            do=self.do,
        )


@dataclass(frozen=True, kw_only=True)
class Result:
    """Judgement of one subject by a check.

    Attributes:
        check, group, unit, warn, fail: See `Check`.
        level: "skip" if there was nothing to measure.
        value: The measured value; None if nothing could be measured or it is not finite.
        frame, detail: See `Measurement`.
        why, do: Why it matters, and what to do; `{path}` is a placeholder for the file.
    """

    check: str
    group: str
    level: Level
    value: float | None
    unit: str
    warn: float
    fail: float
    frame: int | None
    detail: str
    why: str
    do: str

    @property
    def allowed(self) -> float:
        """Limit to report with the value: the one that a failure or a warning exceeded."""
        return self.fail if self.level == "fail" else self.warn

    @property
    def is_blocked(self) -> bool:
        """Whether nothing was measured because a required part is damaged, which another check reports."""
        return self.level == "skip" and self.detail == BLOCKED


def check(
    *,
    group: Group,
    measures: str,
    warn: float = 0,
    fail: float | None = None,
    unit: str = "",
    on: tuple[Form, ...] = ("simulated",),
    needs: str = SCENE,
    needs_images: bool = False,
) -> Callable[[Callable[[Any], Found | Iterator[Found]]], Check]:
    """Decorate a function as a `Check` with the function's name. A generator is judged by the `worst` value that it
    yields.

    Warnings need `fail`; without any limit only zero passes.
    """

    def wrap(function: Callable[[Any], Found | Iterator[Found]]) -> Check:
        @wraps(function)
        def measure(subject: object) -> Found:
            found = function(subject)
            return worst(*found) if isinstance(found, Iterator) else found

        return Check(
            name=function.__name__,
            group=group,
            on=on,
            needs=needs,
            measures=measures,
            unit=unit,
            warn=warn,
            fail=warn if fail is None else fail,
            needs_images=needs_images,
            measure=measure,
        )

    return wrap


file_check = partial(check, group="file", on=("simulated", "external"), needs="a recording")
time_check = partial(check, group="time")
external_check = partial(check, on=("external",), needs="a timestamp for each sample")
run_check = partial(check, group="run", on=("run",), needs="a run of simulated episodes")
dataset_check = partial(check, group="dataset", on=("dataset",), needs="a LeRobot dataset")


def worst(*found: Found) -> Found:
    """Measurement with the largest value (a NaN counts as largest), including the reasons for missing measurements.

    If nothing was measured, the reason, or None if nothing applies.
    """
    known = [measurement for measurement in found if isinstance(measurement, Measurement)]
    reasons = list(dict.fromkeys(row.why for row in found if isinstance(row, NotMeasured)))
    if not known:
        return NotMeasured(why="; ".join(reasons)) if reasons else None
    largest = max(known, key=lambda m: math.inf if math.isnan(m.value) else m.value)
    if not reasons:
        return largest
    return replace(largest, detail="; ".join([largest.detail, *(f"not measured: {why}" for why in reasons)]))


def worst_frame(error: Array, detail: str) -> Measurement | None:
    """Largest of (T,) values and its frame; None if all are NaN."""
    if not np.isfinite(error).any():
        return None
    frame = int(np.nanargmax(error))
    return Measurement(value=float(error[frame]), frame=frame, detail=detail)


def counted(wrong: Sequence[str], good: str = "") -> Measurement:
    """Number of faults and the first three by name, or `good` if there are none."""
    return Measurement(value=len(wrong), detail="; ".join(wrong[:3]) or good)
