"""Export of a finished run to its dataset: once per content, again when the run has grown."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from demorec.core.errors import DemorecError, resource_error
from demorec.core.extension import kind_function
from demorec.core.files import free_name, run_lock, sync_path
from demorec.core.replacing import obstacle
from demorec.datasets.lerobot.card import has_own_card
from demorec.datasets.lerobot.export import export_lerobot
from demorec.datasets.lerobot.files import check_tables
from demorec.datasets.lerobot.options import ExportOptions
from demorec.datasets.lerobot.paths import CARD_PATH
from demorec.datasets.lerobot.paths import DATASET as DATASET_KIND
from demorec.datasets.options import ExportReport
from demorec.generate.contents import check_dataset_place, is_dataset_of_run
from demorec.runs.run_file import DATASET, UNFINISHED, ExportRecord, GeneratedRun, load_run_file, save_run_file


def export_run(
    folder: Path,
    *,
    repo_id: str,
    progress: Callable[[int, int], None] = lambda done, total: None,
    says: Callable[[str], None] = lambda message: None,
) -> tuple[ExportRecord, ExportReport | None]:
    """Export the successful episodes of a run to its dataset/, unless it exists already.

    A dataset that this run made from other content is replaced; one that it did not make is left alone. One that it
    made but that is damaged, was changed, or contains other files, is moved to unfinished/ and made again. So is an
    edited card.

    Returns the dataset's record in run.json, and the export's report if it was made now.

    Raises:
        ConfigError: A foreign dataset, or a broken link, is in the way.
        ExportError: The export failed.
    """
    target = folder / DATASET
    with run_lock(folder):
        run = load_run_file(folder)
        present = run.export
        check_dataset_place(folder, run)
        if target.exists():
            if present and not _is_as_made(target, present, run):
                aside = _move_aside(target, folder)
                says(f"{DATASET}/ was damaged or changed after the run made it; it was moved to {aside}.")
            elif present and (present.run_digest, present.repo_id) == (run.digest, repo_id) and present.dataset_digest:
                return present, None
            _keep_what_is_not_ours(target, folder, says)
        elif present is not None and present.dataset_digest:
            says(f"{DATASET}/ is missing; it is made again.")
        record = ExportRecord(run_digest=run.digest, repo_id=repo_id)
        # Saved first: after a crash in between, the dataset is known to be ours.
        save_run_file(replace(run, export=record), folder)
        start = time.process_time()
        report = export_lerobot(
            [folder],
            target,
            ExportOptions(repo_id=repo_id, overwrite=target.exists()),
            progress=progress,
        )
        record = replace(record, dataset_digest=report.digest, seconds=round(time.process_time() - start, 3))
        save_run_file(replace(run, export=record), folder)
        return record, report


def _is_as_made(dataset: Path, record: ExportRecord, run: GeneratedRun) -> bool:
    """Check that a dataset is complete and matches the run's record, by reading all its files if an extension can."""
    digest_of = kind_function("dataset", "digester")
    # Without a recorded digest, the export was killed, before or after the dataset took its place.
    if not record.dataset_digest or digest_of is None:
        return is_dataset_of_run(dataset, run.config_digest)
    try:
        check_tables(dataset)
        return bool(digest_of(dataset) == record.dataset_digest)
    except (DemorecError, OSError, ValueError) as error:
        if (lack := resource_error(error)) is not None:
            raise lack from error
        return False


def _keep_what_is_not_ours(dataset: Path, folder: Path, says: Callable[[str], None]) -> None:
    """Move files to unfinished/ that would be lost when the run's dataset is replaced."""
    reason = obstacle(dataset, DATASET_KIND)
    if not reason and dataset.exists() and kind_function("dataset", "digester") is None:
        reason = "no installed extension can tell whether it was changed"
    if reason:
        aside = _move_aside(dataset, folder)
        says(f"{DATASET}/ was moved to {aside} and is made again, since {reason}.")
    elif has_own_card(dataset):
        aside = _move_aside(dataset / CARD_PATH, folder)
        says(f"{DATASET}/{CARD_PATH} was edited; it was moved to {aside}, and a new one is made.")


def _move_aside(path: Path, folder: Path) -> str:
    aside = free_name(folder / UNFINISHED / path.name)
    aside.parent.mkdir(exist_ok=True)
    shutil.move(path, aside)  # a dataset/ that is a link may lead to another disk
    sync_path(folder)
    return aside.relative_to(folder).as_posix()
