"""`demorec dataset score`: a score for each episode, with reasons."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from demorec.cli.dataset.edit import DatasetPath, dataset_at
from demorec.cli.shared.output import counted, say, say_json, tell
from demorec.cli.shared.paths import refuse_inside
from demorec.cli.shared.roles import NamedByFlags, RoleFlags
from demorec.core.atomic import atomic_write
from demorec.core.errors import ConfigError
from demorec.core.targets import OptionalTarget

if TYPE_CHECKING:
    from demorec.datasets.lerobot.folder import LeRobotFolder
    from demorec.datasets.scoring import EpisodeScore


@dataclass(frozen=True, kw_only=True)
class Score:
    """Rate every episode from 0 to 1 against the others of its task, with reasons.

    Examples:
      demorec dataset score cups
      demorec dataset score cups --out scores.json
      demorec dataset score cups --state joint_angles --action joint_targets
    """

    dataset: DatasetPath
    out: OptionalTarget = None
    """JSON file for the scores."""
    overwrite: bool = False
    """Replace an existing file of scores."""
    json: bool = False
    """Print JSON."""
    roles: NamedByFlags = field(default_factory=RoleFlags)

    def run(self) -> int:
        """Score, print, and write."""
        from demorec.datasets.lerobot.files import leave_pandas_out
        from demorec.datasets.lerobot.folder import LeRobotFolder
        from demorec.datasets.scoring import score_dataset, to_json

        leave_pandas_out()
        folder = LeRobotFolder(dataset_at(self.dataset), named=self.roles.named)
        tell(*folder.notes, *folder.roles.notes())
        found = score_dataset(folder) if self.out is None else self._written(folder, self.out)
        if self.json:
            say_json(to_json(found))
        for episode in () if self.json else sorted(found, key=lambda episode: episode.score):
            reasons = [f"{reason.text} (frames {reason.first} to {reason.last})" for reason in episode.reasons]
            say(
                f"{episode.score:.2f}  episode {episode.episode_index}" + (f": {'; '.join(reasons)}" if reasons else "")
            )
        if self.out is not None:
            tell(f"Scores of {counted(len(found), 'episode')}: {self.out}")
        return 0

    def _written(self, folder: LeRobotFolder, out: Path) -> Sequence[EpisodeScore]:
        """Score, and write the scores to a file."""
        from demorec.datasets.scoring import SCORES, score_dataset, write_scores

        refuse_inside([out])
        if not out.absolute().parent.is_dir():
            raise ConfigError(f"--out: there is no folder {out.parent}.")
        with atomic_write(out, SCORES, overwrite=self.overwrite, sources=[folder.root]) as part:
            found = score_dataset(folder)
            write_scores(part, found)
        return found


def scored_columns(folder: LeRobotFolder, names: Collection[str], file: Path | None) -> list[dict[str, Any]]:
    """Read the columns of a dataset's episodes, with `score` if that is among the names and no column of its own."""
    from demorec.datasets.editing.episode_records import episode_columns
    from demorec.datasets.scoring import read_scores, score_dataset

    columns = episode_columns(folder)
    if "score" not in names or any("score" in row for row in columns):
        return columns
    if file is None:
        scores = {episode.episode_index: episode.score for episode in score_dataset(folder)}
    else:
        scores = read_scores(file, {place.episode_index: place.length for place in folder.places})
    return [row | {"score": scores.get(row["episode_index"])} for row in columns]
