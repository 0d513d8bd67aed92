"""Verdict and score of episodes, as columns for selection and sorting, and as a viewing order."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

from demorec.core.errors import ConfigError
from demorec.datasets.lerobot.folder import LeRobotFolder
from demorec.episode.roles import NamedRoles
from demorec.extensions.doctor.diagnosis import diagnose
from demorec.extensions.doctor.from_dataset import ReadOptions, evidence_of_dataset
from demorec.runs.find import find


def judged_columns(folder: LeRobotFolder, names: Collection[str]) -> list[dict[str, Any]]:
    """Judge each episode: the "verdict", the "score", or both.

    The verdict needs the images, which takes as long as `demorec check`; the score needs only the tables.
    """
    evidence = evidence_of_dataset(folder.root, ReadOptions(images="verdict" in names))
    found = {each.episode: each for each in diagnose(evidence).episodes}
    numbers = [place.episode_index for place in folder.places]
    return [{name: getattr(found.get(number), name, None) for name in names} for number in numbers]


def by_score(paths: Sequence[Path], named: NamedRoles) -> dict[str, str]:
    """Rank the episodes of datasets by verdict and score, the worst first: name of its `PlaybackSource` -> its reason.

    Raises:
        ConfigError: A path is not a dataset.
    """
    if others := [path for path in paths if find(path).kind != "dataset"]:
        raise ConfigError(f"--rank score is for LeRobot datasets, and this is not one: {others[0]}")
    options = ReadOptions(images=False, named=named)
    found = [(path, each) for path in paths for each in diagnose(evidence_of_dataset(path, options)).episodes]
    ranked = {}
    for path, each in sorted(found, key=lambda pair: pair[1].rank):
        reasons = "; ".join(each.reasons)
        line = f"{each.verdict}, {each.score:.2f}  episode {each.episode}{': ' * bool(reasons)}{reasons}"
        ranked[f"{path}: episode {each.episode}"] = line
    return ranked
