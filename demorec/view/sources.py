"""The episodes of a path: one recording, a run, or data of a kind that an extension reads."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from demorec.core.errors import ConfigError
from demorec.core.extension import kind_function, kind_rows
from demorec.episode.roles import NO_NAMES, NamedRoles, roles_of_recording
from demorec.episode.simulated import scene_of
from demorec.mcap import Recording
from demorec.runs.find import EPISODE_FOLDERS, expect, expect_recordings
from demorec.runs.run_file import EPISODES, FAILED
from demorec.view.episode import Playback, feature_curves, simulated_curves


@dataclass(frozen=True, kw_only=True)
class PlaybackSource:
    """An episode that can be opened.

    Attributes:
        name: Readable name.
        open: Context manager that yields the episode; RecordingError if it cannot be read.
        notes: Sentences on how its data were read.
    """

    name: str
    open: Callable[[], AbstractContextManager[Playback]]
    notes: tuple[str, ...] = ()


def find_episodes(
    paths: Sequence[Path], *, include_failures: bool = False, named: NamedRoles = NO_NAMES
) -> list[PlaybackSource]:
    """List every episode below the paths, in their order; a run's failures only on request, an evaluation's always.

    Args:
        paths: Recordings, runs, folders of recordings, datasets.
        include_failures: Whether to include failed attempts.
        named: Features with a role named by the user.

    Raises:
        ConfigError: A path does not exist, or contains nothing that can be shown.
        RecordingError: A recording is unfinished, or a dataset cannot be read.
    """
    if not paths:
        raise ConfigError("Missing path: give a recording, a run or a dataset, e.g. demorec view recordings/demo.")
    return [source for path in paths for source in _sources(path, include_failures, named)]


def _sources(path: Path, include_failures: bool, named: NamedRoles) -> list[PlaybackSource]:
    found = expect(path, "recording", *kind_rows(), *EPISODE_FOLDERS)
    if (sources_of := kind_function(found.kind, "viewer")) is not None:
        sources: list[PlaybackSource] = sources_of(path, named)
        return sources
    # Failed rollouts are regular results of an evaluation.
    shows_failures = include_failures or found.kind == "evaluation"
    files = [*found.recordings, *(found.failed if shows_failures else ())]
    if not files and found.failed:
        raise ConfigError(f"The folder contains only failed attempts: add --include-failures to show them: {path}")
    expect_recordings(found, files)
    return [PlaybackSource(name=str(file), open=partial(open_recorded, file, named)) for file in files]


@contextmanager
def open_recorded(path: Path, named: NamedRoles = NO_NAMES) -> Iterator[Playback]:
    """Open the episode of a recording; its images can be read until the context exits.

    Raises:
        ConfigError: It lacks a feature that the user named, or is simulated.
        RecordingError: It cannot be read.
    """
    folder = path.resolve().parent
    with Recording(path) as recording:
        roles = roles_of_recording(recording.info, named)
        has_scene = scene_of(recording.info) is not None
        yield Playback(
            name=path.name.removesuffix(".mcap"),
            group=folder.parent.name if folder.name in (EPISODES, FAILED) else folder.name,
            identity=hashlib.sha256(os.fsencode(path.resolve())).hexdigest()[:16],
            data=recording,
            motion=recording.motion(),
            roles=roles,
            curves=simulated_curves(recording) if has_scene else feature_curves(recording, roles),
            statements=tuple((frame, "subtask", text) for frame, text in recording.subtasks),
        )
