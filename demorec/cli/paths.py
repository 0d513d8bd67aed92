"""What commands must not write over, since they read it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from demorec.errors import ConfigError
from demorec.runs.find import EPISODE_FOLDERS, find
from demorec.runs.run_file import DATASET


def places_read(paths: Sequence[Path]) -> list[Path]:
    """Of recordings, runs and datasets: those files and folders in which a picture may be a part of the data.

    A run's own folder is none: an .rrd file or a picture beside its recordings may be replaced.
    """
    return [path / DATASET if find(path).kind in EPISODE_FOLDERS else path for path in paths]


def refuse_sources(sources: Sequence[Path], targets: Sequence[Path]) -> None:
    """Raise ConfigError when a recording that is to be made would replace one that the same command reads."""
    read = {source.resolve() for source in sources}
    for target in targets:
        if target.resolve() in read:
            raise ConfigError(
                f"The new recording would replace one that this command reads, choose another --out: {target}"
            )
