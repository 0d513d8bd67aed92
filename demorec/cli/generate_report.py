"""Output at the end of a run: a table of the results, and the next commands."""

from __future__ import annotations

import shlex
import shutil
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from demorec.cli.shared.output import aligned, counted, say, size_in_words, tell
from demorec.core.processes import available_cores
from demorec.core.replacing import shown
from demorec.generate.options import RunResult
from demorec.runs.run_file import DATASET, EPISODES, UNFINISHED, ExportRecord, GeneratedRun

if TYPE_CHECKING:
    from demorec.generate.reproduce import Original


def check_run(result: RunResult, *, deep_every: int = 0, progress: Callable[[int, int], None]) -> tuple[str, list[str]]:
    """Run every check of the run, its recordings and its dataset that needs no decoded images; make the first episode
    and one in `deep_every` again and compare.

    Returns the entry for the closing table, and one line for each failed check.
    """
    from demorec.check.report import CheckOptions, check_subjects, find_subjects, prove, useful_workers

    subjects = find_subjects([result.folder])
    sample = [a.file for a in result.run.successes[::deep_every]] if deep_every else []
    total = len(subjects) + len(sample)
    workers = useful_workers(subjects, images=False, cores=available_cores())
    options = CheckOptions(images=False, workers=workers)
    warned: Counter[str] = Counter()
    failures: list[str] = []
    for done, report in enumerate(check_subjects(subjects, options)):
        progress(done + 1, total)
        warned.update(found.check for found in report.findings if found.severity == "look")
        broken = [found for found in report.findings if found.severity == "broken"]
        failures += [f"{report.path.name}: {found.check}: {found.message}" for found in broken]
    paths = [result.folder / file for file in sample]
    proofs = []
    for proof in prove(paths, result.run.config.modules):
        proofs.append(proof)
        progress(len(subjects) + len(proofs), total)
        warned.update(["made again"] if proof.level == "warn" else [])
        failures += [f"{proof.path.name}: {proof.problem}"] if proof.problem else []
    found = [f"{len(failures)} failed" if failures else "none failed", f", {counted(warned.total(), 'warning')}"]
    if warned:
        found.append(f" ({', '.join(sorted(warned))})")
    if proofs:
        found.append(f"; {counted(len(proofs), 'episode')} generated again and compared")
    return "".join(found), failures


def print_result(result: RunResult, export: ExportRecord | None, checked: tuple[str, Sequence[str]] | None) -> None:
    """Print the closing table, with the result of `check_run`."""
    run, folder = result.run, result.folder
    attempts = run.attempts
    first_tries = sum(bool(a.success) and a.attempt == 0 for a in attempts)
    tried = len({a.episode_index for a in attempts})
    frames = sum(a.num_frames for a in run.successes)
    size = sum(a.num_bytes for a in run.successes)
    rows = [
        (
            "episodes",
            f"{len(run.successes)} of {run.num_episodes} asked, {counted(len(result.made), 'attempt')} made now",
        ),
        ("success", f"{first_tries} of {tried} at the first try" + _failures(run)),
        ("frames", f"{frames} ({frames / run.config.fps:.1f} s at {run.config.fps} fps)"),
        ("recordings", f"{size_in_words(size)} in {folder / EPISODES}"),
    ]
    if export is not None:
        target = folder / DATASET
        dataset_bytes = sum(path.stat().st_size for path in target.rglob("*") if path.is_file())
        rows.append(("dataset", f"{size_in_words(dataset_bytes)} in {target} (repo id {export.repo_id})"))
    if result.made:
        rate = sum(bool(a.success) for a in result.made) / result.seconds * 60
        made = f"{result.seconds:.1f} s for making episodes, {rate:.1f} a minute"
        rows.append(("wall time", f"{made}; export and checks are extra"))
    if aside := sorted(path.name for path in (folder / UNFINISHED).glob("*")):
        rows.append(("set aside", f"{shown(aside)} in {folder / UNFINISHED}"))
    rows.append(("run digest", run.digest))
    if export is not None:
        rows.append(("dataset digest", export.dataset_digest))
    if checked is not None:
        rows.append(("checks", checked[0]))
    say(*aligned(rows))
    if run.successes:
        say("", "Next:", *(f"  {command}" for command in next_commands(result)))
    for failure in () if checked is None else checked[1][:10]:
        tell(f"Check failed: {failure}")
    if run.given_up:
        tell(
            f"{len(run.given_up)} of {run.num_episodes} episodes failed at all {run.config.max_attempts} attempts and "
            f"were given up: {shown(run.given_up, 10)}. The attempts are in {folder / 'failed'}; raise --max-attempts "
            "in a new --out."
        )


def print_comparison(original: Original, result: RunResult) -> bool:
    """Print whether a run equals the original, or the differences; return whether it does."""
    from demorec.generate.reproduce import compare

    same = compare(original, result)
    different = [f"{episode} (attempt {attempt})" for (episode, attempt), is_same in same.items() if not is_same]
    before = len(same) - len(result.made)
    if before > 0:
        tell(
            f"Note: {counted(before, 'episode')} of {result.folder} existed before and were not generated again: use "
            "a new --out to compare them too."
        )
    tell(*original.faults[:10])
    if not different:
        say(f"The same as {original.source}: {counted(len(same), 'episode')}, bit for bit.")
        return True
    differ = f"{len(different)} of {counted(len(same), 'episode')} differ: {shown(different, 10)}"
    say(f"Not the same as {original.source}: {differ}.")
    return False


def next_commands(result: RunResult) -> list[str]:
    """Next commands for the user, quoted for the shell."""
    allow = [word for module in result.run.config.modules for word in ("--allow", module)]
    program = "demorec" if shutil.which("demorec") else str(Path(sys.executable).with_name("demorec"))
    return [shlex.join([program, name, str(result.folder), *allow]) for name in ("view", "check")]


def _failures(run: GeneratedRun) -> str:
    causes = Counter(f"{a.phase}: {a.reason}" for a in run.failures)
    if not causes:
        return ""
    return "; failed attempts: " + ", ".join(f"{count} x {cause}" for cause, count in causes.most_common(5))
