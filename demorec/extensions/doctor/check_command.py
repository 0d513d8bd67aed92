"""`demorec check`: file integrity, the doctor, and remaking of episodes; `demorec explain`: one check."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from demorec.check.base import RANK
from demorec.cli.shared.flags import Allow, Positional, allowed_modules, terminal_width
from demorec.cli.shared.output import ProgressBar, counted, say, say_json
from demorec.cli.shared.paths import (
    MappingFile,
    NamedByFlags,
    Readable,
    RoleFlags,
    need_paths,
    reading,
    tell_unfinished,
)
from demorec.core.errors import ConfigError, describe_error
from demorec.core.registry import nearest_match
from demorec.core.tables import FILE_CHECKS
from demorec.extensions.datasets.command import MotorFlags, MotorsByFlags
from demorec.extensions.doctor.examine import examine, lines_of

if TYPE_CHECKING:
    from demorec.check.base import Check
    from demorec.check.report import Subject, SubjectReport
    from demorec.extensions.doctor.diagnosis import Diagnosis
    from demorec.extensions.doctor.evidence import Evidence
    from demorec.extensions.remake.deep_check import DeepReport


_SHOWN = 12
"""Number of printed differences of one recording: the first ones are the most informative."""


@dataclass(frozen=True, kw_only=True)
class CheckCommand:
    """Judge datasets, runs and recordings before training: files, times, numbers, alignment, images, episodes.

    Prints the role of each column, a verdict (good, look, broken), the worst findings with fixes, and the episodes,
    worst first. With several datasets, shared episodes are found too. Exit code 1: something is broken.

    Examples:
      demorec check datasets/cups
      demorec check datasets/cups --state joint_angles --action joint_targets
      demorec check datasets/train datasets/validation
      demorec check datasets/cups --no-images --json
      demorec check datasets/so101_cups --motor-units degrees --lerobot
      demorec check monday.mcap --mapping robot.toml
      demorec check recordings/cubes --deep
    """

    paths: Readable
    mapping: MappingFile = None
    images: bool = True
    """Decode all images."""
    only: tuple[str, ...] = ()
    """Names of the checks to run (default: all)."""
    urdf: Path | None = None
    """URDF of the robot, for recordings and datasets without one: joints are matched to the state's elements by name,
    or by order."""
    motors: MotorsByFlags = field(default_factory=MotorFlags)
    roles: NamedByFlags = field(default_factory=RoleFlags)
    strict: bool = False
    """Exit with 1 for findings worth a look, too."""
    lerobot: bool = False
    """Also open each dataset with the installed LeRobot, which takes seconds."""
    deep: bool = False
    """Also remake every recording from config and seed, and compare every number and image; takes about as long as
    generating them."""
    workers: int | None = None
    """Number of processes that check the files of recordings (auto: one per core, or one if starting them would take
    longer than the checks)."""
    all: bool = False
    """Print all findings and all episodes."""
    allow: Allow = ()
    """With --deep: user module or package that may be imported for tasks, robots and cameras named in the files, and
    next to which their models may be read."""
    json: bool = False
    """Print JSON."""

    def run(self) -> int:
        """Check and report."""
        need_paths(self.paths, "check")
        with reading(self.paths, self.mapping) as paths:
            return replace(self, paths=paths)._check()

    def _check(self) -> int:
        from demorec.check.report import CheckOptions, check_subjects, find_subjects, useful_workers
        from demorec.core.processes import available_cores
        from demorec.extensions.datasets.command import leave_pandas_out

        leave_pandas_out()
        integrity, chosen = split_checks(self.only)
        subjects = find_subjects(self.paths)
        if self.deep and all(subject.kind == "dataset" for subject in subjects):
            raise ConfigError(f"--deep remakes recordings, name the run of this dataset: {self.paths[0]}")
        files = subjects if integrity or not self.only else []
        workers = self.workers
        if workers is None:
            workers = useful_workers(subjects, images=self.images, cores=available_cores())
        options = CheckOptions(images=self.images, colours=bool(integrity), only=integrity, workers=workers)
        options.validate()
        with ProgressBar("checking files", total=len(files), unit="item") as bar:
            reports = []
            for report in check_subjects(files, options):
                reports.append(report)
                bar.advance()
        diagnoses = self._diagnosed(reports, chosen)
        remade = list(self._remade(subjects, workers)) if self.deep else []
        bad = [each for each in diagnoses if RANK[each.verdict] >= RANK["look" if self.strict else "broken"]]
        different = [report for report in remade if report.level == "fail" or (self.strict and report.level == "warn")]
        if self.json:
            self._print_json(diagnoses, remade)
        elif remade:
            say(deep_summary(remade, different).strip())
        tell_unfinished(self.paths)
        return 1 if bad or different else 0

    def _diagnosed(self, reports: Sequence[SubjectReport], checks: Sequence[Check]) -> list[Diagnosis]:
        """Diagnose each path, and print it."""
        from demorec.extensions.doctor.from_dataset import ReadOptions

        options = ReadOptions(
            images=self.images,
            named=self.roles.named,
            motors=self.motors.named,
            urdf=self._description(),
            lerobot=self.lerobot,
        )
        found: list[Diagnosis] = []
        read: list[Evidence] = []
        with ProgressBar("reading", total=len(self.paths), unit="part") as bar:
            for number, path in enumerate(self.paths, start=1):
                own = [report for report in reports if report.path == path or path in report.path.parents]
                shown = replace(options, progress=partial(_advance, bar, bar.done, len(self.paths) - number))
                diagnosis, evidence = examine(path, shown, reports=own, checks=checks, earlier=tuple(read))
                if evidence is not None and len(self.paths) > 1:
                    read.append(evidence.without_images())
                found.append(diagnosis)
                if not self.json:
                    say(*lines_of(diagnosis, everything=self.all))
        return found

    def _print_json(self, diagnoses: Sequence[Diagnosis], remade: Sequence[DeepReport]) -> None:
        deep = {"deep": [plain_deep(report) for report in remade]} if self.deep else {}
        if len(diagnoses) == 1:
            say_json({**diagnoses[0].to_json(), **deep})
        else:
            say_json({"paths": [diagnosis.to_json() for diagnosis in diagnoses], **deep})

    def _description(self) -> str:
        """Read the URDF named by the user, "" for none; ConfigError if it is invalid."""
        if self.urdf is None:
            return ""
        from demorec.core.files import read_text_limited
        from demorec.robots.urdf import MAX_BYTES, Urdf

        try:
            text = read_text_limited(self.urdf, MAX_BYTES)
            Urdf.parse(text)
        except (OSError, ValueError) as error:
            raise ConfigError(f"--urdf is not a robot description ({describe_error(error)}): {self.urdf}") from error
        return text

    def _remade(self, subjects: Sequence[Subject], workers: int) -> Iterator[DeepReport]:
        from demorec.extensions.remake.deep_check import deep_checks

        paths = [subject.path for subject in subjects if subject.kind == "recording"]
        with ProgressBar("making again", total=len(paths)) as bar:
            for report in deep_checks(paths, workers=workers, allowed=allowed_modules(self.allow)):
                bar.advance()
                if not self.json:
                    say(*deep_lines(report, verbose=self.all))
                yield report


def _advance(bar: ProgressBar, before: int, paths_left: int, done: int, total: int) -> None:
    """Show the parts of one path after those of the paths before it; each path left has at least one part."""
    bar.set(before + done, before + total + paths_left)


def deep_lines(report: DeepReport, *, verbose: bool = False) -> Iterator[str]:
    """Yield one line about a recording, then the versions that differ, then the differences, first frames first."""
    yield f"{report.level:<4}  made again {report.path}: {_verdict(report)}"
    details = [f"Not provable here: {line}" for line in report.versions]
    if report.error:
        details.append(f"It cannot be made again: {report.error}")
    shown = report.differences if verbose else report.differences[:_SHOWN]
    details += [str(difference) for difference in shown]
    if len(report.differences) > len(shown):
        details.append(f"and {counted(len(report.differences) - len(shown), 'field')} more (--all shows them)")
    yield from (f"      {detail}" for detail in details)


def _verdict(report: DeepReport) -> str:
    if report.error:
        return "not possible"
    if not report.differences:
        return f"the same to the bit in all {report.num_frames} frames"
    frames = {frame for difference in report.differences for frame in difference.frames}
    count = len(report.differences)
    amount = "1 field differs" if count == 1 else f"{count} fields differ"
    return f"{amount}, in {len(frames)} of {report.num_frames} frames"


def deep_summary(remade: Sequence[DeepReport], different: Sequence[DeepReport]) -> str:
    """Summarise how many recordings were made again, differ, or cannot be made again; "" if none was tried.

    Args:
        remade: All attempted ones.
        different: Those that count as failed, including those that cannot be made again.
    """
    impossible = sum(bool(report.error) for report in remade)
    made, differ = len(remade) - impossible, sum(not report.error for report in different)
    warned = sum(report.level == "warn" for report in remade if not report.error)
    aside = f" ({warned} with a warning)" if warned else ""
    text = f" {made} made again{aside}, {differ} not as recorded." if made else ""
    return text + (f" {impossible} could not be made again." if impossible else "")


def plain_deep(report: DeepReport) -> dict[str, Any]:
    """Convert the report to plain data for JSON, with every different frame."""
    from demorec.core.plain import to_plain

    plain = to_plain(report)
    return {"path": str(report.path), "kind": "deep", "level": report.level, "results": [
        {name: value for name, value in plain.items() if name != "path"}
    ]}  # fmt: skip


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
    from demorec.extensions.doctor.checks import all_checks

    for check in all_checks():
        yield check.name, check.measures
    for name in FILE_CHECKS.names():
        yield name, FILE_CHECKS.load(name).measures
