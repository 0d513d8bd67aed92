"""What a person sees of a run: a progress bar on a terminal, a table at the end."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from tqdm import tqdm

from demorec.cli.output import say, tell
from demorec.generate.estimate import Estimate
from demorec.generate.options import RunOptions, available_cores
from demorec.generate.run import RunResult
from demorec.generate.run_file import DATASET, EPISODES, STARTING, UNFINISHED, Attempt, ExportRecord, RunFile

_WORTH_PROCESSES = 50
"""Recordings from which on several processes check faster than one."""


class TerminalProgress:
    """Progress bars on a terminal, nothing but messages without one; a context manager.

    `watch` is called with every attempt that has ended.
    """

    def __init__(self, *, watch: Callable[[Attempt], None] | None = None) -> None:
        self._watch = watch
        self._bar: tqdm | None = None  # type: ignore[type-arg]
        self._title = ""
        self._failed = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self._close()

    def verifying(self, done: int, total: int) -> None:
        """Recordings of an earlier session are being verified."""
        self._show("verifying", done, total)

    def checking(self, done: int, total: int) -> None:
        """Run, recordings and dataset are being checked."""
        self._show("checking", done, total)

    def exporting(self, done: int, total: int) -> None:
        """Recordings are being exported."""
        self._show("exporting", done, total)

    def started(self, run: RunFile, workers: int) -> None:
        """The work begins."""
        self._show("generating", len(run.successes), run.num_episodes)

    def ended(self, attempt: Attempt) -> None:
        """An attempt has come to its end."""
        if self._watch is not None:
            self._watch(attempt)
        if self._bar is None:
            return
        if attempt.success:
            self._bar.update()
        else:
            self._failed += 1
            self._bar.set_postfix_str(f"{self._failed} failed attempts")

    def says(self, message: str) -> None:
        """Something that a person should know."""
        tell(message)

    def _show(self, title: str, done: int, total: int) -> None:
        if title != self._title:
            self._close()
            self._title = title
            # disable=None: only on a terminal.
            self._bar = tqdm(desc=title, total=total, initial=done, unit="episode", disable=None, dynamic_ncols=True)
        elif self._bar is not None:
            self._bar.update(done - self._bar.n)

    def _close(self) -> None:
        if self._bar is not None:
            self._bar.close()
        self._bar, self._title = None, ""


@dataclass(frozen=True, kw_only=True)
class CheckSummary:
    """What the checks at the end have found.

    Attributes:
        subjects: How many recordings, runs and datasets were checked.
        warnings: How many checks gave a warning.
        failures: One line for each check that failed.
    """

    subjects: int
    warnings: int
    failures: tuple[str, ...]


def check_run(folder: Path, *, progress: Callable[[int, int], None]) -> CheckSummary:
    """Every check of run, recordings and dataset that needs no decoded pictures."""
    from demorec.check.report import CheckOptions, check_subjects, find_subjects

    subjects = find_subjects([folder])
    workers = available_cores() if len(subjects) > _WORTH_PROCESSES else 1
    warnings = 0
    failures: list[str] = []
    for done, report in enumerate(check_subjects(subjects, CheckOptions(pictures=False, workers=workers))):
        warnings += report.count("warn")
        failures += [f"{report.path.name}: {r.check}: {r.detail}" for r in report.results if r.level == "fail"]
        progress(done + 1, len(subjects))
    return CheckSummary(subjects=len(subjects), warnings=warnings, failures=tuple(failures))


def print_result(result: RunResult, export: ExportRecord | None, checked: CheckSummary | None) -> None:
    """The closing table."""
    run, folder = result.run, result.folder
    attempts = run.attempts
    first_tries = sum(a.success and a.attempt == 0 for a in attempts)
    tried = len({a.episode_index for a in attempts})
    frames = sum(a.num_frames for a in run.successes)
    size = sum(a.num_bytes for a in run.successes)
    rows = [
        ("episodes", f"{len(run.successes)} of {run.num_episodes} asked, {len(result.made)} attempts made now"),
        ("success", f"{first_tries} of {tried} at the first try" + _failures(run)),
        ("frames", f"{frames} ({frames / run.config.fps:.1f} s at {run.config.fps} fps)"),
        ("recordings", f"{megabytes(size)} in {folder / EPISODES}"),
    ]
    if export is not None:
        target = folder / DATASET
        dataset_bytes = sum(path.stat().st_size for path in target.rglob("*") if path.is_file())
        rows.append(("dataset", f"{megabytes(dataset_bytes)} in {target} (repo id {export.repo_id})"))
    if seconds := _seconds(attempts, export):
        rows.append(("CPU seconds", seconds))
    if result.made:
        wall = result.session.wall_seconds
        rate = sum(a.success for a in result.made) / wall * 60
        rows.append(
            ("this session", f"{wall:.1f} s with {_workers(result.session.workers)}, {rate:.1f} episodes a minute")
        )
    leftovers = sum(1 for path in (folder / UNFINISHED).rglob("*") if path.is_file())
    if leftovers:
        rows.append(
            ("set aside", f"{leftovers} files in {folder / UNFINISHED} (demorec recover reads what a crash left)")
        )
    rows.append(("run digest", run.digest))
    if export is not None:
        rows.append(("dataset digest", export.dataset_digest))
    if checked is not None:
        verdict = f"{len(checked.failures)} failed" if checked.failures else "none failed"
        rows.append(("checks", f"{verdict}, {checked.warnings} warnings; demorec check {folder} says more"))
    width = max(len(name) for name, _ in rows)
    for name, value in rows:
        say(f"{name:<{width}}  {value}")
    for failure in () if checked is None else checked.failures[:10]:
        tell(f"Check failed: {failure}")
    if run.given_up:
        shown = ", ".join(str(index) for index in run.given_up[:10]) + (", ..." if len(run.given_up) > 10 else "")
        tell(
            f"{len(run.given_up)} of {run.num_episodes} episodes failed at all {run.config.max_attempts} attempts and "
            f"were given up: {shown}. The attempts are in {folder / 'failed'}; raise --max-attempts in a new --out."
        )


def megabytes(count: float) -> str:
    """Bytes in the unit that reads best."""
    for unit, factor in (("TB", 1e12), ("GB", 1e9), ("MB", 1e6)):
        if count >= factor:
            return f"{count / factor:.1f} {unit}"
    return f"{count / 1e3:.1f} kB"


def _workers(count: int) -> str:
    return f"{count} worker" if count == 1 else f"{count} workers"


def _failures(run: RunFile) -> str:
    causes = Counter(f"{a.phase}: {a.reason}" for a in run.failures)
    if not causes:
        return ""
    return "; failed attempts: " + ", ".join(f"{count} x {cause}" for cause, count in causes.most_common(5))


def _seconds(attempts: tuple[Attempt, ...], export: ExportRecord | None) -> str:
    stages: Counter[str] = Counter()
    for attempt in attempts:
        stages.update(attempt.seconds)
    shown = [f"{stage} {stages[stage]:.1f}" for stage in sorted(stages, key=lambda stage: stage != STARTING)]
    if export is not None:
        shown.append(f"export {export.seconds:.1f}")
    return ", ".join(shown)


def print_estimate(estimate: Estimate, options: RunOptions) -> None:
    """The table of a dry run."""
    each = sum(estimate.cpu_seconds.values())
    stages = ", ".join(f"{stage} {seconds:.2f}" for stage, seconds in estimate.cpu_seconds.items())
    cores = available_cores()
    workers = _workers(estimate.workers)
    if options.executor == "local" and estimate.workers > cores:
        workers += f" on {cores} cores: at least {duration(estimate.seconds * estimate.workers / cores)}"
    rows = [
        ("success", f"{estimate.successes} of {estimate.attempts} at the first try"),
        ("CPU s/episode", f"{each:.2f} ({stages}), {estimate.num_frames} frames"),
        (
            "time",
            f"{duration(estimate.seconds)} for {estimate.num_episodes} episodes with {workers}; the export is extra",
        ),
        ("size", f"{megabytes(estimate.total_bytes)} ({megabytes(estimate.num_bytes)} an episode, and the dataset)"),
        ("memory", f"{megabytes(estimate.peak_worker_bytes)} a worker"),
        ("free disk", f"{megabytes(estimate.free_bytes)} at {options.out}"),
    ]
    for name, value in rows:
        say(f"{name:<13}  {value}")
    if estimate.total_bytes > estimate.free_bytes:
        tell("The disk is too small for this run.")
    say("Nothing was kept; leave --dry-run out to generate.")


def duration(seconds: float) -> str:
    """Seconds in the unit that reads best."""
    for unit, factor in (("days", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= 2 * factor:
            return f"{seconds / factor:.1f} {unit}"
    return f"{seconds:.0f} s"
