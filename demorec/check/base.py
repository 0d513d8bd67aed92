"""What a check is: one function that measures one thing, with the limits that judge it.

A check never judges by itself: it returns the worst value found and where, and the limits in its row turn the value
into pass, warn or fail. So a report can always say what was found and what is allowed, and `demorec list checks`
says it beforehand. Larger values are worse, everywhere.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial, wraps
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from demorec.check.limits import limit_table
from demorec.core.errors import DemorecError, MissingDependencyError, NotAllowedError, resource_error
from demorec.core.geometry import Array

Level = Literal["pass", "warn", "fail", "skip"]
Scope = Literal["recording", "collected", "run", "collected_run", "dataset", "motion"]
Group = Literal["file", "time", "physics", "alignment", "calibration", "pictures", "outcome", "run", "dataset"]

_BLOCKED = "it needs what is damaged"
_NEEDS_ALLOW = "not measured without --allow: "

COLOR_TOPICS = ("/camera/{camera}/h264", "/camera/{camera}/video", "/camera/{camera}/image/compressed")
"""Where a camera's coded colour pictures are, whatever the codec; for `Check.reads`."""
PICTURE_TOPICS = (*COLOR_TOPICS, "/camera/{camera}/depth", "/camera/{camera}/segmentation")
"""The same with its other pictures."""
MOTION_TOPICS = ("/joint_states", "/object/{body}/pose")
"""Where it is said how everything moves that a camera sees."""
EE_TOPICS = ("/ee_pose", "/action/ee_pose", "/command/ee_pose")


@dataclass(frozen=True, kw_only=True)
class Measurement:
    """What a check found.

    Attributes:
        value: The worst value, in the check's unit.
        frame: Where it was found; None when it belongs to no frame.
        detail: What exactly (which joint, topic, camera, file), for people.
    """

    value: float
    frame: int | None = None
    detail: str = ""


@dataclass(frozen=True, kw_only=True)
class NotMeasured:
    """That there is something to measure, but nothing can be told of it: neither good nor bad.

    Attributes:
        why: For people: "too little moves before the camera".
    """

    why: str


Found = Measurement | NotMeasured | None
"""What a check returns; None where the thing does not exist (no cameras, no depth)."""


@dataclass(frozen=True, kw_only=True)
class Check:
    """One check.

    Attributes:
        name: Its row in `demorec.core.tables.CHECKS`.
        group: What it is about.
        scope: What it looks at: a recording of a simulated or of a collected episode, a run (its folder), a dataset, or
            the motions of any of them whose robot is not one of our simulation (`demorec.check.motion`).
        measures: What the value is, in words.
        unit: Of the value and the limits; "" for counts and ratios.
        warn, fail: The value passes up to `warn`, is a warning up to `fail`, and a failure above.
        needs_pictures: Whether pictures have to be decoded.
        reads: What it looks at, of all that `demorec.check.reads` lists: topics, fields, columns.
        measure: The function.
    """

    name: str
    group: Group
    scope: Scope
    measures: str
    unit: str
    warn: float
    fail: float
    needs_pictures: bool
    reads: tuple[str, ...]
    measure: Callable[[Any], Found]

    @property
    def summary(self) -> str:
        """One line for `demorec list checks`."""
        unit = f" {self.unit}" if self.unit else ""
        warn = "" if self.warn == self.fail else f"warns above {self.warn:g}{unit}, "
        fail = "never fails" if math.isinf(self.fail) else f"fails above {self.fail:g}{unit}"
        return f"{self.scope}, {self.group}: {self.measures}; {warn}{fail}"

    def run(self, subject: object) -> Result:
        """Measure and judge; an error while reading or computing is a failure of this check, a missing package is none.

        Raises:
            ResourceError: This machine cannot measure it, which says nothing about the subject.
        """
        try:
            found = self.measure(subject)
        except MissingDependencyError as error:
            return self.skipped(str(error))
        except NotAllowedError as error:  # a model of the user's own, which says nothing about the recording
            return self.skipped(f"{_NEEDS_ALLOW}{error}")
        except Exception as error:
            if (lack := resource_error(error)) is not None:
                raise lack from error
            if isinstance(error, DemorecError):
                return self._result("fail", Measurement(value=math.nan, detail=str(error)))
            # What is broken in a way that nobody foresaw must not take the other checks' findings with it.
            logging.getLogger(__name__).debug("check %s", self.name, exc_info=True)
            odd = Measurement(value=math.nan, detail="the data are such that this check cannot be computed on them")
            return self._result("fail", odd)
        if found is None:
            return self.skipped("nothing to measure")
        if isinstance(found, NotMeasured):
            return self.skipped(f"not measured: {found.why}")
        return self._result(self.judge(found.value), found)

    def blocked(self) -> Result:
        """The result of a check that needs what another one has found to be damaged."""
        return self.skipped(_BLOCKED)

    def skipped(self, why: str) -> Result:
        """The result of a check that could not be run."""
        return self._result("skip", Measurement(value=math.nan, detail=why))

    def judge(self, value: float) -> Level:
        """The level of a value; what is no number fails."""
        if value <= self.warn:
            return "pass"
        return "warn" if value <= self.fail else "fail"

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
        )


@dataclass(frozen=True, kw_only=True)
class Result:
    """A check's judgement of one subject.

    Attributes:
        check, group, unit, warn, fail: As in `Check`.
        level: "skip" where there was nothing to measure.
        value: What was found; None when nothing could be measured, or it is beyond all numbers.
        frame, detail: As in `Measurement`.
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

    @property
    def allowed(self) -> float:
        """The limit that the value is told with: the one that a failure or a warning broke."""
        return self.fail if self.level == "fail" else self.warn

    @property
    def is_blocked(self) -> bool:
        """Whether nothing was measured since what it needs is damaged, which another check tells."""
        return self.level == "skip" and self.detail == _BLOCKED

    @property
    def needs_allow(self) -> bool:
        """Whether nothing was measured since the user has not allowed a module that it needs a file of."""
        return self.level == "skip" and self.detail.startswith(_NEEDS_ALLOW)


def check(
    *,
    group: Group,
    measures: str,
    warn: float = 0,
    fail: float | None = None,
    unit: str = "",
    scope: Scope = "recording",
    needs_pictures: bool = False,
    reads: tuple[str, ...] = (),
) -> Callable[[Callable[[Any], Found | Iterator[Found]]], Check]:
    """Make a `Check` of a function; its name is the function's. Of a generator the `worst` that it yields is judged.

    A check that stands in `demorec.check.limits` has the limits of there, whatever it is given here. Without `fail`
    there are no warnings, and without any limit nothing above zero passes.
    """

    def wrap(function: Callable[[Any], Found | Iterator[Found]]) -> Check:
        @wraps(function)
        def measure(subject: object) -> Found:
            found = function(subject)
            return worst(*found) if isinstance(found, Iterator) else found

        name = function.__name__
        limits = limit_table().checks.get(name)
        return Check(
            name=name,
            group=group,
            scope=scope,
            measures=measures,
            unit=unit,
            warn=limits.warn if limits else warn,
            fail=limits.fail if limits else warn if fail is None else fail,
            needs_pictures=needs_pictures,
            reads=reads,
            measure=measure,
        )

    return wrap


file_check = partial(check, group="file")
time_check = partial(check, group="time")
physics_check = partial(check, group="physics")
alignment_check = partial(check, group="alignment")
calibration_check = partial(check, group="calibration")
picture_check = partial(check, group="pictures", needs_pictures=True)
outcome_check = partial(check, group="outcome")
external_check = partial(check, scope="collected")
run_check = partial(check, group="run", scope="run")
dataset_check = partial(check, group="dataset", scope="dataset")


def worst(*found: Found) -> Found:
    """The measurement of the largest value (a NaN counts as largest), which names what was not measured beside it.

    Where nothing was measured: why not, or None when there is nothing.
    """
    known = [measurement for measurement in found if isinstance(measurement, Measurement)]
    reasons = [row.why for row in found if isinstance(row, NotMeasured)]
    if not known:
        return NotMeasured(why="; ".join(reasons)) if reasons else None
    largest = max(known, key=lambda m: math.inf if math.isnan(m.value) else m.value)
    if not reasons:
        return largest
    return replace(largest, detail="; ".join([largest.detail, *(f"not measured: {why}" for why in reasons)]))


def worst_frame(
    off: Array, detail: str = "", *, first: int = 0, frames: NDArray[np.intp] | None = None
) -> Measurement | None:
    """The largest of (T,) values and its frame, those from `first` on or `frames`; None when there are no values."""
    if not len(off):
        return None
    row = int(np.argmax(off))
    return Measurement(value=float(off[row]), frame=row + first if frames is None else int(frames[row]), detail=detail)


def worst_entry(table: Array, names: Sequence[str], *, first: int = 0) -> Measurement | None:
    """The same of (T, n) values, with the name of the column."""
    if not table.size:
        return None
    row, column = divmod(int(np.argmax(table)), table.shape[1])
    return Measurement(value=float(table[row, column]), frame=row + first, detail=names[column])
