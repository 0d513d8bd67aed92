"""The doctor's verdict and score as columns of a dataset's episodes, to choose and sort them by."""

from __future__ import annotations

from collections.abc import Collection
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from demorec.datasets.lerobot.folder import LeRobotFolder

_JUDGED = ("verdict", "score")


def judged_columns(folder: LeRobotFolder, names: Collection[str]) -> list[dict[str, Any]]:
    """Read the columns of a dataset's episodes, with verdict and score if they are asked for and not columns already.

    The verdict needs the images, which takes as long as `demorec check`; the score is from the tables alone.
    """
    from demorec.datasets.lerobot.episode_records import episode_columns
    from demorec.extensions.doctor.diagnosis import diagnose
    from demorec.extensions.doctor.from_dataset import ReadOptions, evidence_of_dataset

    columns = episode_columns(folder)
    wanted = [name for name in _JUDGED if name in names and not any(name in row for row in columns)]
    if not wanted:
        return columns
    evidence = evidence_of_dataset(folder.root, ReadOptions(images="verdict" in wanted))
    found = {each.episode: each for each in diagnose(evidence).episodes}
    return [row | {name: getattr(found.get(row["episode_index"]), name, None) for name in wanted} for row in columns]
