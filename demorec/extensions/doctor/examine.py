"""Examination of a path: its sets, how each is read, and the diagnosis in words."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from demorec.check.base import Finding
from demorec.cli.shared.output import counted
from demorec.core.errors import ExportError
from demorec.runs.find import find
from demorec.runs.run_file import DATASET

if TYPE_CHECKING:
    from demorec.check.base import Check
    from demorec.check.report import SubjectReport
    from demorec.extensions.doctor.diagnosis import Diagnosis
    from demorec.extensions.doctor.evidence import Evidence
    from demorec.extensions.doctor.from_dataset import ReadOptions

MAX_FINDINGS = 10
"""Maximum number of printed findings, worst first."""
MAX_EPISODES = 20
_MAX_NUMBERS = 12
"""Maximum number of episodes listed by number in one finding."""
_WIDTH = 110


def examine(
    path: Path,
    options: ReadOptions,
    *,
    reports: Sequence[SubjectReport] = (),
    checks: Sequence[Check] | None = None,
    earlier: Sequence[Evidence] = (),
) -> tuple[Diagnosis, Evidence | None]:
    """Diagnose a dataset, a run, or recordings; also returns the evidence, None if nothing can be opened.

    Args:
        path: Path given by the user.
        options: Options for reading.
        reports: Integrity of its files, which becomes findings.
        checks: Checks to run; all by default.
        earlier: Sets named before it.
    """
    from demorec.extensions.doctor.checks import all_checks
    from demorec.extensions.doctor.diagnosis import Diagnosis, diagnose

    chosen = all_checks() if checks is None else checks
    extra = list(_of_files(reports))
    try:
        evidence = _evidence(path, options)
    except ExportError as error:
        unopened = _unopened(error, path)
        others = [finding for finding in extra if unopened.message not in finding.message]
        return Diagnosis(path=path, taken={}, findings=(unopened, *others), episodes=(), not_measured={}), None
    evidence.earlier = earlier
    diagnosis = diagnose(evidence, chosen, extra)
    if find(path).kind == "run" and evidence.folder is None:
        diagnosis = _with_dataset(diagnosis, path, options, chosen)
    results = [result for report in reports for result in report.results]
    not_measured = {
        **diagnosis.not_measured,
        **{each.check: each.not_measured for each in results if each.not_measured},
    }
    passed = {each.check for each in results if each.verdict == "good"}
    return replace(diagnosis, not_measured=not_measured, num_checks=diagnosis.num_checks + len(passed)), evidence


def _evidence(path: Path, options: ReadOptions) -> Evidence:
    from demorec.extensions.doctor.from_dataset import evidence_of_dataset
    from demorec.extensions.doctor.from_recordings import evidence_of_recordings

    found = find(path)
    if found.kind == "dataset":
        return evidence_of_dataset(path, options)
    rollouts = found.failed if found.kind == "evaluation" else ()  # failed rollouts are results, not rejects
    return evidence_of_recordings(path, (*found.recordings, *rollouts), options)


def _with_dataset(diagnosis: Diagnosis, run: Path, options: ReadOptions, chosen: Sequence[Check]) -> Diagnosis:
    """Add the findings about the files of a run's own dataset; its numbers and images are those of the recordings."""
    from demorec.extensions.doctor.diagnosis import diagnose
    from demorec.extensions.doctor.from_dataset import evidence_of_dataset, no_progress

    path = run / DATASET
    if find(path).kind != "dataset":
        return diagnosis
    try:
        evidence = evidence_of_dataset(path, replace(options, images=False, progress=no_progress))
    except ExportError as error:
        return replace(diagnosis, findings=(_unopened(error, path), *diagnosis.findings))
    if options.images:
        evidence.images_missing = "the images are those of the recordings"
    about_files = [check for check in chosen if check.family == "files"]
    files = diagnose(evidence, about_files)
    names = {check.name for check in about_files}
    unmade = {name: why for name, why in diagnosis.not_measured.items() if name not in names}
    found = (replace(each, episode=None, message=f"{DATASET}: {_of(each)}{each.message}") for each in files.findings)
    return replace(diagnosis, findings=(*found, *diagnosis.findings), not_measured={**unmade, **files.not_measured})


def _of(finding: Finding) -> str:
    return "" if finding.episode is None else f"episode {finding.episode}: "


def _unopened(error: Exception, path: Path) -> Finding:
    return Finding(
        check="unreadable_episodes",
        severity="broken",
        message=str(error).removesuffix(f": {path}"),
        why="Nothing of it can be read.",
        do="complete the recording or the download, or restore the file",
    )


def _of_files(reports: Iterable[SubjectReport]) -> Iterator[Finding]:
    """Yield the findings of the file checks; those of a recording belong to its episode."""
    recordings = [report.path for report in reports if report.kind == "recording"]
    for report in reports:
        number = recordings.index(report.path) if report.kind == "recording" else None
        for finding in report.findings:
            yield replace(finding, episode=number, message=f"{report.path.name}: {finding.message}")


def lines_of(diagnosis: Diagnosis, *, everything: bool = False) -> Iterator[str]:
    """Yield the diagnosis in words: roles, verdict, the worst findings with fixes, and the episodes, worst first."""
    yield f"{diagnosis.path}: {_taken(diagnosis)}"
    yield _verdict(diagnosis)
    if diagnosis.not_measured:
        yield "not measured: " + "; ".join(
            f"{', '.join(names)} ({reason})" for reason, names in _by_reason(diagnosis.not_measured).items()
        )
    folded = list(_folded(diagnosis.findings))
    for same in folded if everything else folded[:MAX_FINDINGS]:
        yield from _finding(same)
    if len(folded) > MAX_FINDINGS and not everything:
        yield f"and {counted(len(folded) - MAX_FINDINGS, 'more finding')} (--all prints them)"
    yield from _episodes(diagnosis, everything=everything)
    commands = {finding.do for finding in diagnosis.findings if "--out NEW" in finding.do}
    if len(commands) > 1:
        repair = ", dataset repair first" if any("dataset repair" in each for each in commands) else ""
        yield f"Run one command at a time{repair}, and check NEW: dropping renumbers the episodes."


def _taken(diagnosis: Diagnosis) -> str:
    """Describe the role of each column."""
    roles: dict[str, list[str]] = {}
    for column, role in diagnosis.taken.items():
        roles.setdefault(role or "no role", []).append(column)
    parts = [f"{role} {', '.join(columns)}" for role, columns in roles.items() if role != "no role"]
    parts += [f"no {role}: --{role} COLUMN names it" for role in ("state", "action") if role not in roles]
    if "no role" in roles:
        parts.append(f"no role, so not looked at: {', '.join(roles['no role'])}")
    return "; ".join(parts)


def _verdict(diagnosis: Diagnosis) -> str:
    count = len(diagnosis.episodes)
    amount = f"{counted(count, 'episode')}, {counted(diagnosis.num_frames, 'frame')}"
    amount += f", {counted(len(diagnosis.cameras), 'camera')}" if diagnosis.cameras else ""
    if diagnosis.verdict == "good":
        return f"good: {amount}; {counted(diagnosis.num_checks, 'check')} found nothing"
    bad = {word: sum(each.verdict == word for each in diagnosis.episodes) for word in ("broken", "look", "good")}
    words = [f"{number} {word}" for word, number in bad.items() if number]
    whole = {finding.severity for finding in diagnosis.findings if finding.episode is None}
    if diagnosis.verdict in whole:
        return f"{diagnosis.verdict} as a whole: {amount}; of the episodes alone {', '.join(words) or 'none'}"
    return f"{diagnosis.verdict}: {amount}; {', '.join(words)}"


def _by_reason(not_measured: Mapping[str, str]) -> dict[str, list[str]]:
    found: dict[str, list[str]] = {}
    for name, reason in not_measured.items():
        found.setdefault(reason, []).append(name)
    return found


def _folded(findings: Sequence[Finding]) -> Iterator[list[Finding]]:
    """Group findings of one check and severity, in order; those of the whole set stay separate."""
    groups: dict[tuple[str, str, str], list[Finding]] = {}
    for finding in findings:
        own = finding.message if finding.episode is None else ""
        groups.setdefault((finding.check, finding.severity, own), []).append(finding)
    yield from groups.values()


def _finding(same: Sequence[Finding]) -> Iterator[str]:
    worst = same[0]
    numbers = list(dict.fromkeys(each.episode for each in same if each.episode is not None))
    where = ""
    do = worst.do
    if numbers:
        where = f"episode {numbers[0]}: "
        if len(numbers) > 1:
            where = f"{len(numbers)} episodes ({_listed(numbers)}), for example {numbers[0]}: "
            do = do.replace(f"--episodes {numbers[0]} ", f"--episodes {','.join(map(str, numbers))} ")
    yield f"  {worst.severity:<6}  {worst.check}  {where}{worst.message}"
    yield from textwrap.wrap(worst.why, _WIDTH, initial_indent=" " * 10, subsequent_indent=" " * 10)
    yield f"{' ' * 10}-> {do}"


def _episodes(diagnosis: Diagnosis, *, everything: bool) -> Iterator[str]:
    """Format the episodes, worst first; those with the same score and reasons share a line."""
    groups: dict[tuple[str, str, tuple[str, ...]], list[int]] = {}
    for each in diagnosis.episodes:
        if everything or each.verdict != "good":
            groups.setdefault((each.verdict, f"{each.score:.2f}", each.reasons), []).append(each.episode)
    for (verdict, score, reasons), numbers in list(groups.items())[: None if everything else MAX_EPISODES]:
        shown = _listed(numbers, len(numbers) if everything else _MAX_NUMBERS)
        which = f"episode {numbers[0]}" if len(numbers) == 1 else f"{len(numbers)} episodes ({shown})"
        reason = f": {reasons[0]}" if reasons else ""
        more = f" (and {len(reasons) - 1} more)" if len(reasons) > 1 else ""
        yield f"  {verdict:<6}  {which}, score {score}{reason}{more}"
    hidden = sum(map(len, list(groups.values())[MAX_EPISODES:]))
    if hidden and not everything:
        yield f"  and {hidden} more episodes (--all prints them)"


def _listed(numbers: Sequence[int], shown: int = _MAX_NUMBERS) -> str:
    return ", ".join(map(str, numbers[:shown])) + (", ..." if len(numbers) > shown else "")
