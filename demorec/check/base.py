"""What a check is: one function that measures one thing, with the limits that judge it.

A check never judges by itself: it returns the worst value found and where, and the limits in its row turn the value
into pass, warn or fail. So a report can always say what was found and what is allowed, and `demorec list checks`
says it beforehand. Larger values are worse, everywhere.
"""

from __future__ import annotations

import logging
import math
import tomllib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial, wraps
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import DemorecError, MissingDependencyError, NotAllowedError, resource_error
from demorec.core.geometry import Array

Level = Literal["pass", "warn", "fail", "skip"]
Form = Literal["simulated", "external", "run", "external run", "dataset"]
"""What is checked: a recording that demorec simulated, one that it did not, a run of either, a LeRobot dataset."""
Group = Literal["file", "time", "physics", "alignment", "calibration", "images", "outcome", "run", "dataset"]

LIMITS = Path(__file__).with_name("limits.toml")
_BLOCKED = "it needs what is damaged"
_NOT_APPLICABLE = "not applicable: it needs "
_NEEDS_ALLOW = "not measured without --allow: "

SCENE = "a simulated scene"
URDF = "a robot whose URDF is known"
ACTIONS = "actions that are targets of the state's elements"
VELOCITIES = "velocities of the state's elements"
EFFORTS = "efforts of the joints, and their robot's masses"
EE_POSES = "EE poses, and a robot whose URDF is known"
GRIPPER = "the opening of a gripper, and its action"
STATE_ALONE = "observation.state"
IMAGES = "colour images"
SIDECAR = "what demorec keeps beside its datasets"
"""What checks need, as `Check.needs` has it."""


@cache
def limit_table() -> dict[str, Any]:
    """The limits of checks whose values vary from one good recording to the next, with what they were calibrated on.

    "calibration" says on what the largest values were measured, and "margin" how many times them a warning is at least.
    "checks" has for each check "warn" and "fail", set by hand, and "largest", the largest value of good recordings,
    which `benchmarks/check_limits.py` writes.
    """
    return tomllib.loads(LIMITS.read_text())


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
    """That there is something to measure, but that it cannot be judged: neither good nor bad.

    Attributes:
        why: For people: "too little moves before the camera".
    """

    why: str


@dataclass(frozen=True, kw_only=True)
class Lacking:
    """That the subject lacks what the check needs.

    Attributes:
        need: "a URDF", in the words of `Check.needs`.
    """

    need: str


Found = Measurement | NotMeasured | Lacking | None
"""What a check returns; None where the thing does not exist (no cameras, no depth)."""


@dataclass(frozen=True, kw_only=True)
class Check:
    """One check.

    Attributes:
        name: Its row in `demorec.core.tables.CHECKS`.
        group: What it is about.
        on: What it can look at, whatever else it needs.
        needs: What it needs, in few words.
        measures: What the value is, in words.
        unit: Of the value and the limits; "" for counts and ratios.
        warn, fail: The value passes up to `warn`, is a warning up to `fail`, and a failure above.
        simulated: (warn, fail) of recordings that demorec simulated, where these are exact and others are not.
        needs_images: Whether images have to be decoded.
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
    simulated: tuple[float, float]
    needs_images: bool
    measure: Callable[[Any], Found]

    @property
    def summary(self) -> str:
        """One line for `demorec list checks`."""
        general, simulated = self._words(self.warn, self.fail), self._words(*self.simulated)
        limits = (
            general if general == simulated or "simulated" not in self.on else f"{general} (simulated: {simulated})"
        )
        return f"{self.group}, needs {self.needs}: {self.measures}; {limits}"

    def _words(self, warn: float, fail: float) -> str:
        unit = f" {self.unit}" if self.unit else ""
        warns = "" if warn == fail else f"warns above {warn:g}{unit}, "
        return warns + ("never fails" if math.isinf(fail) else f"fails above {fail:g}{unit}")

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
                return self._result("fail", Measurement(value=math.nan, detail=str(error)), subject)
            # What is broken in a way that nobody foresaw must not take the other checks' findings with it.
            logging.getLogger(__name__).debug("check %s", self.name, exc_info=True)
            odd = Measurement(value=math.nan, detail="the data are such that this check cannot be computed on them")
            return self._result("fail", odd, subject)
        if found is None:
            return self.skipped("nothing to measure")
        if isinstance(found, Lacking):
            return self.not_applicable(found.need)
        if isinstance(found, NotMeasured):
            return self.skipped(f"not measured: {found.why}")
        warn, fail = self._limits(subject)
        level: Level = "pass" if found.value <= warn else "warn" if found.value <= fail else "fail"
        return self._result(level, found, subject)

    def _limits(self, subject: object) -> tuple[float, float]:
        return self.simulated if getattr(subject, "form", "") == "simulated" else (self.warn, self.fail)

    def not_applicable(self, need: str = "") -> Result:
        """The result of a check that the subject lacks something for: by default all that it `needs`."""
        return self.skipped(f"{_NOT_APPLICABLE}{need or self.needs}")

    def blocked(self) -> Result:
        """The result of a check that needs what another one has found to be damaged."""
        return self.skipped(_BLOCKED)

    def skipped(self, why: str) -> Result:
        """The result of a check that could not be run."""
        return self._result("skip", Measurement(value=math.nan, detail=why))

    def _result(self, level: Level, found: Measurement, subject: object = None) -> Result:
        warn, fail = self._limits(subject)
        return Result(
            check=self.name,
            group=self.group,
            level=level,
            value=float(found.value) if math.isfinite(found.value) else None,
            unit=self.unit,
            warn=warn,
            fail=fail,
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
        """The limit that the value is reported with: the one that a failure or a warning broke."""
        return self.fail if self.level == "fail" else self.warn

    @property
    def is_blocked(self) -> bool:
        """Whether nothing was measured since what it needs is damaged, which another check tells."""
        return self.level == "skip" and self.detail == _BLOCKED

    @property
    def lacks(self) -> str:
        """What the subject lacks for it, "" where it could be measured."""
        is_lacking = self.level == "skip" and self.detail.startswith(_NOT_APPLICABLE)
        return self.detail.removeprefix(_NOT_APPLICABLE) if is_lacking else ""

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
    simulated: tuple[float, float] | None = None,
    unit: str = "",
    on: tuple[Form, ...] = ("simulated",),
    needs: str = SCENE,
    needs_images: bool = False,
) -> Callable[[Callable[[Any], Found | Iterator[Found]]], Check]:
    """Make a `Check` of a function; its name is the function's. Of a generator the `worst` that it yields is judged.

    Recordings that demorec simulated have the limits of `limits.toml`, where the check stands in there, or
    those of `simulated`. Without `fail` there are no warnings, and without any limit nothing above zero passes.
    """

    def wrap(function: Callable[[Any], Found | Iterator[Found]]) -> Check:
        @wraps(function)
        def measure(subject: object) -> Found:
            found = function(subject)
            return worst(*found) if isinstance(found, Iterator) else found

        name = function.__name__
        table, general = limit_table()["checks"].get(name), (warn, warn if fail is None else fail)
        exact = (table["warn"], table["fail"]) if table else simulated or general
        limits = exact if on == ("simulated",) else general
        return Check(
            name=name,
            group=group,
            on=on,
            needs=needs,
            measures=measures,
            unit=unit,
            warn=limits[0],
            fail=limits[1],
            simulated=exact,
            needs_images=needs_images,
            measure=measure,
        )

    return wrap


file_check = partial(check, group="file")
time_check = partial(check, group="time")
physics_check = partial(check, group="physics")
alignment_check = partial(check, group="alignment")
calibration_check = partial(check, group="calibration")
image_check = partial(check, group="images", needs_images=True)
outcome_check = partial(check, group="outcome")
external_check = partial(check, on=("external",), needs="stamps of its own for each sample")
run_check = partial(check, group="run", on=("run",), needs="a run of simulated episodes")
dataset_check = partial(check, group="dataset", on=("dataset",), needs="a LeRobot dataset")
sidecar_check = partial(check, group="dataset", on=("dataset",), needs=SIDECAR)


def worst(*found: Found) -> Found:
    """The measurement of the largest value (a NaN counts as largest), which names what was not measured beside it.

    Where nothing was measured: why not, or None when there is nothing.
    """
    known = [measurement for measurement in found if isinstance(measurement, Measurement)]
    reasons = list(dict.fromkeys(row.why for row in found if isinstance(row, NotMeasured)))
    if not known and not reasons:
        return next((row for row in found if isinstance(row, Lacking)), None)
    if not known:
        return NotMeasured(why="; ".join(reasons))
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


def counted(wrong: Sequence[str], good: str = "") -> Measurement:
    """How many things are wrong, the first three of them by name; or what is told where none is."""
    return Measurement(value=len(wrong), detail="; ".join(wrong[:3]) or good)
