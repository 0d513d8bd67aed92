"""What a path holds: one recording, the episodes of a run, or those of an exported dataset."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from demorec.core.errors import ConfigError, OptionError
from demorec.datasets.lerobot.folder import LeRobotFolder
from demorec.episode.roles import NO_NAMES, NamedRoles
from demorec.runs.find import EPISODE_FOLDERS, expect, expect_recordings
from demorec.view.episode import PlayedEpisode
from demorec.view.from_dataset import open_dataset_episode
from demorec.view.from_recording import open_recorded


@dataclass(frozen=True, kw_only=True)
class PlaybackSource:
    """An episode that can be opened.

    Attributes:
        name: For people.
        open: A context manager that gives the episode; RecordingError when it cannot be read.
    """

    name: str
    open: Callable[[], AbstractContextManager[PlayedEpisode]]


def find_episodes(
    paths: Sequence[Path], *, include_failures: bool = False, named: NamedRoles = NO_NAMES
) -> list[PlaybackSource]:
    """Every episode below the paths, in their order; a run's failures only when asked for, an evaluation's always.

    Args:
        paths: Recordings, runs, folders of recordings, datasets.
        include_failures: Whether failed attempts count.
        named: Features whose role the user names.

    Raises:
        ConfigError: A path is not there, or holds nothing that can be shown.
        RecordingError: A recording is unfinished, or a dataset cannot be read.
    """
    if not paths:
        raise ConfigError("No path is given: name a recording, a run or a dataset, e.g. demorec view recordings/demo.")
    return [source for path in paths for source in _sources(path, include_failures, named)]


def _sources(path: Path, include_failures: bool, named: NamedRoles) -> list[PlaybackSource]:
    found = expect(path, "recording", "dataset", *EPISODE_FOLDERS)
    if found.kind == "dataset":
        dataset = LeRobotFolder(path, named=named)
        return [
            PlaybackSource(
                name=f"{path}: episode {place.episode_index}", open=partial(open_dataset_episode, dataset, number)
            )
            for number, place in enumerate(dataset.places)
        ]
    shows_failures = include_failures or found.kind == "evaluation"  # whose failed rollouts are results like others
    files = [*found.recordings, *(found.failed if shows_failures else ())]
    if not files and found.failed:
        raise ConfigError(f"The folder holds failed attempts only, which --include-failures shows: {path}")
    expect_recordings(found, files)
    return [PlaybackSource(name=str(file), open=partial(open_recorded, file, named)) for file in files]


def select(sources: Sequence[PlaybackSource], episodes: str) -> list[PlaybackSource]:
    """Those of "7", "0:20" or "3,5,8:10", numbered from 0; all for "".

    Raises:
        ConfigError: No such numbers.
    """
    if not episodes:
        return list(sources)
    chosen: list[PlaybackSource] = []
    for word in episodes.split(","):
        first, colon, last = word.partition(":")
        try:
            low = int(first or 0)
            high = (int(last) if last else len(sources)) if colon else low + 1
        except ValueError as error:
            raise OptionError("episodes", f"is {episodes!r}, expected numbers and ranges like 7 or 0:20.") from error
        part = list(sources[low:high]) if 0 <= low < high else []
        if not part:
            raise ConfigError(f"--episodes {word}: there are {len(sources)} episodes, numbered from 0.")
        chosen += part
    return chosen
