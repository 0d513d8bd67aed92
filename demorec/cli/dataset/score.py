"""`demorec dataset score`: a score for each episode, with reasons."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from demorec.cli.dataset.edit import DatasetPath, dataset_at
from demorec.cli.shared.output import counted, say, say_json, tell
from demorec.cli.shared.paths import refuse_inside
from demorec.cli.shared.progress import ProgressBar
from demorec.core.errors import ExportError, check_option

if TYPE_CHECKING:
    from demorec.check.scoring.score import EpisodeScore
    from demorec.datasets.editing.plan import Source


@dataclass(frozen=True, kw_only=True)
class Score:
    """Rate every episode from 0 to 1 against the others of its task, with reasons.

    Examples:
      demorec dataset score cups
      demorec dataset score cups --out scores.json
    """

    dataset: DatasetPath
    out: Path | None = None
    """JSON file for the scores."""
    images: bool = True
    """Look at some images of each episode."""
    workers: int | None = None
    """Processes (auto: one for each core)."""
    overwrite: bool = False
    """Replace an existing file of scores."""
    json: bool = False
    """Print JSON."""

    def run(self) -> int:
        """Score, print, and write."""
        from demorec.check.scoring.score import check_target, to_json, write_scores
        from demorec.datasets.lerobot.files import leave_pandas_out

        leave_pandas_out()
        root = dataset_at(self.dataset)
        if self.out is not None:
            refuse_inside([self.out])
            check_target(self.out, source=root, overwrite=self.overwrite)
        found = scored(root, images=self.images, workers=self.workers)
        if self.json:
            say_json(to_json(found))
        for episode in () if self.json else sorted(found, key=lambda episode: episode.score):
            reasons = [f"{reason.text} (frames {reason.first} to {reason.last})" for reason in episode.reasons]
            say(
                f"{episode.score:.2f}  episode {episode.episode_index}" + (f": {'; '.join(reasons)}" if reasons else "")
            )
        if self.out is not None:
            try:
                write_scores(self.out, found)
            except OSError as error:
                raise ExportError(f"The scores cannot be written ({error.strerror}): {self.out}") from error
            tell(f"Scores of {counted(len(found), 'episode')}: {self.out}")
        return 0


def add_scores(source: Source, names: Collection[str], file: Path | None) -> None:
    """Let a dataset have scores if `score` is among the names of columns, and no column of its own is called so."""
    if "score" not in names or any("score" in row for row in source.columns()):
        return
    if file is None:
        source.scores = {episode.episode_index: episode.score for episode in scored(source.root)}
        return
    from demorec.check.scoring.score import read_scores

    source.scores = read_scores(file, {place.episode_index: place.length for place in source.places})


def scored(root: Path, *, images: bool = True, workers: int | None = None) -> list[EpisodeScore]:
    """The scores of a dataset, with a bar; a few episodes are measured by this process alone."""
    from demorec.check.scoring.score import score_dataset
    from demorec.core.processes import available_cores

    check_option("workers", workers, 1, 1024)
    with ProgressBar("scoring") as bar:
        return score_dataset(root, images=images, workers=workers or available_cores(), progress=bar.set)
