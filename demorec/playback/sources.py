"""What a path holds: one recording, the episodes of a run, or those of an exported dataset."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from demorec.errors import ConfigError, OptionError, RecordingError
from demorec.lerobot.paths import INFO_PATH, is_dataset
from demorec.playback.episode import PlayedEpisode
from demorec.playback.from_dataset import dataset_episodes, open_dataset_episode
from demorec.playback.from_recording import open_recording

_MCAP_MAGIC = b"\x89MCAP0\r\n"


@dataclass(frozen=True, kw_only=True)
class PlaybackSource:
    """An episode that can be opened.

    Attributes:
        name: For people.
        open: A context manager that gives the episode; RecordingError when it cannot be read.
    """

    name: str
    open: Callable[[], AbstractContextManager[PlayedEpisode]]


def find_episodes(paths: Sequence[Path], *, include_failures: bool = False) -> list[PlaybackSource]:
    """Every episode below the paths, in their order; a run's failures only when asked for.

    Raises:
        ConfigError: A path is not there, or holds nothing that can be shown.
        RecordingError: A recording is unfinished, or a dataset cannot be read.
    """
    if not paths:
        raise ConfigError("No path is given: name a recording, a run or a dataset, e.g. demorec view recordings.")
    return [source for path in paths for source in _sources(path, include_failures)]


def _sources(path: Path, include_failures: bool) -> list[PlaybackSource]:
    if not path.exists():
        raise ConfigError(f"There is no such file or folder: {path}")
    if path.suffix == ".part":
        raise RecordingError(f"The recording is not finished; demorec recover makes one of what there is: {path}")
    if path.is_file():
        if path.suffix != ".mcap" and not _is_mcap(path):
            raise ConfigError(
                "Recordings (.mcap), runs, exported datasets, folders of recordings and Rerun's .rrd files can be "
                f"shown, this file is none of them: {path}"
            )
        return [_recording(path)]
    if not path.is_dir():
        raise ConfigError(f"This is neither a file nor a folder: {path}")
    if is_dataset(path):
        return [
            PlaybackSource(name=f"{path}: episode {index}", open=partial(open_dataset_episode, path, index))
            for index in dataset_episodes(path)
        ]
    files = sorted(path.glob("*.mcap")) + sorted((path / "episodes").glob("*.mcap"))
    if include_failures:
        files += sorted((path / "failed").glob("*.mcap"))
    if files:
        return [_recording(file) for file in files]
    hint = ""
    if any((path / "failed").glob("*.mcap")):
        hint = "; its failures are shown with --include-failures"
    elif below := sorted(folder.parent.name for folder in path.glob("*/episodes")):
        hint = f"; it holds runs, name one ({', '.join(below[:5])}{', ...' if below[5:] else ''})"
    raise ConfigError(f"The folder holds no recording (*.mcap), run (episodes/) or dataset ({INFO_PATH}){hint}: {path}")


def _is_mcap(path: Path) -> bool:
    with path.open("rb") as file:
        return file.read(len(_MCAP_MAGIC)) == _MCAP_MAGIC


def _recording(path: Path) -> PlaybackSource:
    return PlaybackSource(name=str(path), open=partial(open_recording, path, group=_group(path)))


def _group(path: Path) -> str:
    """The run's name, or that of the folder."""
    folder = path.resolve().parent
    return folder.parent.name if folder.name in ("episodes", "failed") else folder.name


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
