"""`demorec check`: the checks over recordings, runs and datasets."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

from demorec.cli.shared.flags import Allow, allowed_modules
from demorec.cli.shared.output import counted, say, say_json
from demorec.cli.shared.paths import MappingFile, Readable, need_paths, reading, tell_unfinished
from demorec.cli.shared.progress import ProgressBar
from demorec.cli.shared.roles import MotorFlags, MotorsByFlags, NamedByFlags, RoleFlags
from demorec.core.errors import ConfigError, describe_error

if TYPE_CHECKING:
    from demorec.check.base import Level, Result
    from demorec.check.report import Subject, SubjectReport
    from demorec.replay.deep.check import DeepReport


_SHOWN = 12
"""Differences of one recording that are printed: the first ones tell the most."""


@dataclass(frozen=True, kw_only=True)
class CheckCommand:
    """Check recordings, runs and datasets: files, times, numbers, motion, images.

    Exit code 0: everything passed (warnings allowed); 1: a check failed. `demorec list checks` prints what is measured
    and the limits.

    Examples:
      demorec check recordings/cubes
      demorec check recordings/cubes --no-images --strict
      demorec check datasets/cubes --json
      demorec check monday.mcap --mapping robot.toml
      demorec check datasets/so101_cups --motor-units degrees
      demorec check datasets/cups --state joint_angles --action joint_targets
      demorec check datasets/cubes --lerobot
      demorec check recordings/cubes/episodes/episode_000007.mcap --deep
    """

    paths: Readable
    mapping: MappingFile = None
    images: bool = True
    """Decode all images; without it, a recording is checked at about 50 times real time."""
    only: tuple[str, ...] = ()
    """Names of the checks to run; default: all."""
    urdf: Path | None = None
    """The robot's description, for recordings and datasets that lack one: its joints are the state's elements by
    their names, or by their order."""
    motors: MotorsByFlags = field(default_factory=MotorFlags)
    roles: NamedByFlags = field(default_factory=RoleFlags)
    strict: bool = False
    """Warnings count as failures."""
    lerobot: bool = False
    """Also let the installed LeRobot open each dataset, which takes seconds; always done where another check fails."""
    deep: bool = False
    """Also make every recording, and every episode of a dataset, again from config and seed, and compare every number
    and image; takes about as long as generating them."""
    workers: int | None = None
    """Processes (auto: one for each core, or one alone where starting them would take longer than the checks)."""
    verbose: bool = False
    """List what passed, too: every recording, run and dataset, and each of their checks."""
    allow: Allow = ()
    """With --deep: a module or package of your own that may be imported for the tasks, robots and cameras that the
    files name, and beside which their models may be read."""
    json: bool = False
    """Print JSON: a list with one object for each recording, run and dataset."""

    def run(self) -> int:
        """Check and report."""
        need_paths(self.paths, "check")
        with reading(self.paths, self.mapping) as paths:
            return replace(self, paths=paths)._check()

    def _check(self) -> int:
        from demorec.check.report import CheckOptions, check_subjects, find_subjects, useful_workers
        from demorec.core.processes import available_cores

        subjects = find_subjects(self.paths)
        workers = self.workers
        if workers is None:
            workers = useful_workers(subjects, images=self.images, cores=available_cores())
        options = CheckOptions(
            images=self.images,
            only=self.only,
            workers=workers,
            lerobot=self.lerobot,
            urdf=self._description(),
            motors=self.motors.named,
            named=self.roles.named,
        )
        options.validate()
        reports = []
        with ProgressBar("checking", total=len(subjects), unit="item", at_once=workers) as bar:
            for report in check_subjects(subjects, options):
                reports.append(report)
                bar.advance()
                if not self.json and (self.verbose or report.level != "pass"):
                    say(*_lines(report, verbose=self.verbose))
        if not (self.json or self.verbose):
            say(*_passed([report for report in reports if report.level == "pass"]))
        remade = list(self._remade(subjects, workers)) if self.deep else []
        failed = [report for report in reports if report.is_bad(strict=self.strict)]
        different = [report for report in remade if report.level == "fail" or (self.strict and report.level == "warn")]
        if self.json:
            say_json([_plain(report) for report in reports] + [plain_deep(report) for report in remade])
        else:
            say(_summary(reports, len(failed)) + deep_summary(remade, different))
        tell_unfinished(self.paths)
        return 1 if failed or different else 0

    def _description(self) -> str:
        """Text of the URDF that the user names, "" for none; ConfigError for what is none."""
        if self.urdf is None:
            return ""
        from demorec.core.files import read_text_limited
        from demorec.robots.urdf import MAX_BYTES, Urdf

        try:
            text = read_text_limited(self.urdf, MAX_BYTES)
            Urdf.parse(text)
        except (OSError, ValueError) as error:
            raise ConfigError(f"--urdf is no robot's description ({describe_error(error)}): {self.urdf}") from error
        return text

    def _remade(self, subjects: Sequence[Subject], workers: int) -> Iterator[DeepReport]:
        from demorec.replay.deep.check import deep_checks, deep_dataset_checks

        allowed = allowed_modules(self.allow)
        paths = [subject.path for subject in subjects if subject.kind == "recording"]
        runs = [subject.path for subject in subjects if subject.kind == "run"]  # whose datasets hold the same episodes
        datasets = [s.path for s in subjects if s.kind == "dataset" and s.path.parent not in runs]
        found = [deep_checks(paths, workers=workers, allowed=allowed)]
        found += [deep_dataset_checks(path, allowed=allowed) for path in datasets]
        with ProgressBar("making again", total=0 if datasets else len(paths)) as bar:
            for report in chain.from_iterable(found):
                bar.advance()
                if not self.json:
                    say(*deep_lines(report, verbose=self.verbose))
                yield report


def _lines(report: SubjectReport, *, verbose: bool) -> Iterator[str]:
    words: tuple[tuple[Level, str], ...] = (
        ("pass", "passed"),
        ("warn", "with a warning"),
        ("fail", "failed"),
        ("skip", "not measured"),
    )
    blocked = sum(result.is_blocked for result in report.results)
    numbers = {level: report.count(level) - (blocked if level == "skip" else 0) for level, _ in words}
    counts = ", ".join(f"{numbers[level]} {word}" for level, word in words if numbers[level])
    counts = counts or f"none of the chosen checks is about a {report.kind}"
    yield f"{report.level:<4}  {report.kind} {report.path}: {counts}"
    yield from _once(report.notes)
    for result in report.results:
        if result.level in ("warn", "fail") or (verbose and not result.is_blocked):
            yield f"      {_result(result)}"
    if not verbose:
        yield from _once(_not_measured([report]))
    if blocked:
        yield f"      {blocked} {'check needs' if blocked == 1 else 'checks need'} what is damaged."


def _not_measured(reports: Sequence[SubjectReport]) -> Iterator[str]:
    """Each reason why checks measured nothing."""
    from demorec.check.base import NOTHING

    results = [result for report in reports for result in report.results if result.level == "skip"]
    reasons = (f"{r.check}: {r.detail}" for r in results if not r.is_blocked and r.detail != NOTHING)
    return (f"not measured  {reason}" for reason in reasons)


def _once(lines: Iterable[str]) -> Iterator[str]:
    """Each line once, the most frequent first, with how often it occurs."""
    for line, count in Counter(lines).most_common():
        yield f"      {line}{'' if count == 1 else f' ({count} times)'}"


def _passed(reports: Sequence[SubjectReport]) -> Iterator[str]:
    """One line about everything in which nothing was found."""
    if len(reports) < 2:
        yield from (line for report in reports for line in _lines(report, verbose=False))
        return
    kinds = Counter(report.kind for report in reports)
    passed, skipped = (sum(report.count(level) for report in reports) for level in ("pass", "skip"))
    unmeasured = f", {skipped} not measured" if skipped else ""
    things = ", ".join(counted(number, kind) for kind, number in kinds.items())
    yield f"pass  {things}: {passed} checks passed{unmeasured}"
    yield from _once(note for report in reports for note in report.notes)
    yield from _once(_not_measured(reports))


def _result(result: Result) -> str:
    where = "" if result.frame is None else f" at frame {result.frame}"
    unit = f" {result.unit}" if result.unit else ""
    value = "" if result.value is None else f" {result.value:.4g}{unit}{where}"
    is_bad = result.level in ("warn", "fail") and result.value is not None
    limit = f" (allowed {result.allowed:g}{unit})" if is_bad else ""
    detail = f": {result.detail}" if result.detail else ""
    return f"{result.level:<4}  {result.check}{value}{limit}{detail}"


def _summary(reports: Sequence[SubjectReport], failed: int) -> str:
    warned = sum(report.level == "warn" for report in reports)
    unmeasured = sum(report.level == "skip" for report in reports)
    text = f"{len(reports) - unmeasured} checked, {failed} failed, {warned} with warnings."
    if unmeasured:
        text += f" Of {unmeasured} nothing was measured."
    return text


def _plain(report: SubjectReport) -> dict[str, Any]:
    from demorec.core.plain import to_plain

    results = [to_plain(result) for result in report.results]
    for result in results:
        if result["value"] is not None and abs(result["value"]) == float("inf"):
            result["value"] = None  # JSON has no infinity; the level and the detail tell
    plain = {"path": str(report.path), "kind": report.kind, "level": report.level, "results": results}
    return plain | {"notes": list(report.notes)}


def deep_lines(report: DeepReport, *, verbose: bool = False) -> Iterator[str]:
    """One line about a recording, below it the versions that differ, then what differs, the first frames first."""
    yield f"{report.level:<4}  made again {report.path}: {_verdict(report)}"
    details = [f"Not provable here: {line}" for line in report.versions]
    if report.error:
        details.append(f"It cannot be made again: {report.error}")
    shown = report.differences if verbose else report.differences[:_SHOWN]
    details += [str(difference) for difference in shown]
    if len(report.differences) > len(shown):
        details.append(f"and {counted(len(report.differences) - len(shown), 'field')} more (--verbose shows all)")
    if report.replay:
        details.append(f"Replayed: {report.replay}")
    yield from (f"      {detail}" for detail in details)


def _verdict(report: DeepReport) -> str:
    if report.error:
        return "not possible"
    if not report.differences:
        aside = "; labels, phases and events are taken over in a derived recording" if report.is_derived else ""
        return f"the same to the bit in all {report.num_frames} frames{aside}"
    frames = {frame for difference in report.differences for frame in difference.frames}
    count = len(report.differences)
    amount = "1 field differs" if count == 1 else f"{count} fields differ"
    return f"{amount}, in {len(frames)} of {report.num_frames} frames"


def deep_summary(remade: Sequence[DeepReport], different: Sequence[DeepReport]) -> str:
    """The end of the last line: how many were made again, how many of them differ, how many cannot be; "" for none.

    Args:
        remade: All that were tried.
        different: Those among them that count as failed; what cannot be made again is one of them.
    """
    impossible = sum(bool(report.error) for report in remade)
    made, differ = len(remade) - impossible, sum(not report.error for report in different)
    warned = sum(report.level == "warn" for report in remade if not report.error)
    aside = f" ({warned} with a warning)" if warned else ""
    text = f" {made} made again{aside}, {differ} not as recorded." if made else ""
    return text + (f" {impossible} could not be made again." if impossible else "")


def plain_deep(report: DeepReport) -> dict[str, Any]:
    """The same as plain data for JSON, with every frame that differs."""
    from demorec.core.plain import to_plain

    plain = to_plain(report)
    return {"path": str(report.path), "kind": "deep", "level": report.level, "results": [
        {name: value for name, value in plain.items() if name != "path"}
    ]}  # fmt: skip
