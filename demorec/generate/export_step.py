"""From a finished run to its dataset: made once for a content, made anew when the run has grown."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from demorec.errors import ExportError
from demorec.export import ExportOptions, ExportReport, export_lerobot
from demorec.generate.lock import run_lock
from demorec.generate.run_file import DATASET, ExportRecord, load_run_file, save_run_file


def export_run(
    folder: Path, *, repo_id: str, progress: Callable[[int, int], None] = lambda done, total: None
) -> tuple[ExportRecord, ExportReport | None]:
    """Export the successful episodes of a run to its dataset/, unless that is there already.

    Episodes beyond what was asked for last are left out. A dataset that this run made from other content is replaced;
    one that it did not make is left alone.

    Returns:
        What run.json says about the dataset now, and the export's own report if it was made just now.

    Raises:
        ExportError: Somebody else's dataset is in the way, or the export failed.
    """
    target = folder / DATASET
    with run_lock(folder):
        run = load_run_file(folder)
        present = run.export
        if (
            present is not None
            and present.dataset_digest
            and (present.run_digest, present.repo_id) == (run.digest, repo_id)
            and target.is_dir()
        ):
            return present, None
        if target.exists() and present is None:
            raise ExportError(f"A dataset that this run did not make is in the way: move it elsewhere: {target}")
        record = ExportRecord(run_digest=run.digest, repo_id=repo_id)
        # Written down before: after a crash in between, what is there is known to be ours.
        save_run_file(replace(run, export=record), folder)
        start = time.process_time()
        wanted = f":{run.num_episodes}" if run.beyond else ""
        report = export_lerobot(
            [folder],
            target,
            ExportOptions(repo_id=repo_id, episodes=wanted, overwrite=target.exists()),
            progress=progress,
        )
        record = replace(record, dataset_digest=report.digest, seconds=round(time.process_time() - start, 3))
        save_run_file(replace(run, export=record), folder)
        return record, report
