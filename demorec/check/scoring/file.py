"""A file of scores, as `demorec dataset score --out` keeps it and `--scores` reads it."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from demorec.check.scoring.score import EpisodeScore
from demorec.core.errors import ConfigError, describe_error
from demorec.core.files import MAX_JSON_BYTES, read_json_limited
from demorec.core.replacing import ReplaceableKind, check_replaceable, written_whole

_KIND = "scores of demorec"


def _is_scores(path: Path) -> bool:
    try:
        found = read_json_limited(path, MAX_JSON_BYTES)
    except (OSError, ValueError):
        return False
    return isinstance(found, dict) and found.get("kind") == _KIND


SCORES = ReplaceableKind(name="a file of scores (JSON)", recognises=_is_scores)


def to_json(found: Sequence[EpisodeScore]) -> dict[str, Any]:
    """What `--json` prints and the file holds."""
    return {"kind": _KIND, "episodes": [asdict(episode) for episode in found]}


def check_target(path: Path, *, source: Path, overwrite: bool) -> None:
    """Raise ConfigError where scores cannot be kept: something else is there, or something and no `overwrite`."""
    check_replaceable(path, SCORES, overwrite=overwrite, sources=[source])
    if not path.absolute().parent.is_dir():
        raise ConfigError(f"--out: there is no folder {path.parent}.")


def write_scores(path: Path, found: Sequence[EpisodeScore]) -> None:
    """Keep scores in a file that `check_target` allows."""
    with written_whole(path, SCORES) as part:
        part.write_text(json.dumps(to_json(found), indent=1) + "\n")


def read_scores(path: Path, num_frames: Mapping[int, int]) -> dict[int, float]:
    """episode_index -> score; ConfigError for a file that cannot be read, or is of a dataset with other episodes.

    Args:
        path: The file.
        num_frames: episode_index -> frames of the dataset's episodes.
    """
    try:
        rows = read_json_limited(path, MAX_JSON_BYTES)["episodes"]
        found = {int(row["episode_index"]): (int(row["num_frames"]), float(row["score"])) for row in rows}
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise ConfigError(
            f"This is no file of demorec dataset score --out ({describe_error(error)}): {path}"
        ) from error
    if {index: frames for index, (frames, _) in found.items()} != dict(num_frames):
        raise ConfigError(f"The scores are those of a dataset with other episodes; score this one anew: {path}")
    return {index: score for index, (_, score) in found.items()}
