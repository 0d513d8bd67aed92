"""What of a folder can be kept: every recording is verified before a run builds on it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from demorec.core.errors import DemorecError, in_words, resource_error, without_path
from demorec.core.plain import to_plain
from demorec.generate.plan import differences
from demorec.runs.recordings import Inspected
from demorec.runs.run_file import (
    EPISODES,
    FAILED,
    UNFINISHED,
    Attempt,
    RunFile,
    free_name,
    recording_name,
    sha256_of,
    sync_folder,
)

Inspector = Callable[[Path], Inspected]
"""Reads all of a recording; DemorecError or OSError when it is none."""


def recordings_of(folder: Path) -> list[Path]:
    """Everything in episodes/ and failed/ that is named as a recording, whatever it is."""
    return sorted(path for place in (EPISODES, FAILED) for path in (folder / place).glob("*.mcap"))


def survey(
    folder: Path, run: RunFile, *, inspect: Inspector, progress: Callable[[int, int], None]
) -> tuple[list[Attempt], dict[str, str]]:
    """Verify every recording of a folder against run.json, or read it in full where run.json does not know it.

    What is damaged, unfinished, of another run or no file at all is moved to unfinished/; nothing is deleted.

    Returns:
        The attempts whose recordings are there and sound, and those that failed without one; and file -> why it was
        moved to unfinished/.

    Raises:
        ResourceError: This machine cannot read one of them now; nothing is moved for that.
    """
    known = {a.file: a for a in run.known if a.file}
    kept = [a for a in run.known if not a.file]
    set_aside: dict[str, str] = {}
    files = recordings_of(folder)
    for number, path in enumerate(files):
        file = path.relative_to(folder).as_posix()
        line = known.get(file)
        try:
            if line is None:
                line = _adopt(path, run, inspect)
            elif path.stat().st_size != line.num_bytes or sha256_of(path) != line.sha256:
                raise DemorecError("its bytes are not those that run.json knows")
            kept.append(line)
        except (DemorecError, OSError, MemoryError) as error:
            if (lack := resource_error(error, path)) is not None:
                raise lack from error
            set_aside[file] = without_path(error, path) if isinstance(error, DemorecError) else in_words(error)
            path.rename(free_name(folder / UNFINISHED / path.name))
            sync_folder(path.parent)
        progress(number + 1, len(files))
    return kept, set_aside


def _adopt(path: Path, run: RunFile, inspect: Inspector) -> Attempt:
    found = inspect(path)
    line = found.attempt
    place = EPISODES if line.success else FAILED
    name = recording_name(line.episode_index, line.attempt, success=line.success)
    if (path.parent.name, path.name) != (place, name):
        raise DemorecError(f"it holds episode {line.episode_index}, attempt {line.attempt}")
    if different := differences(found.config, found.versions, to_plain(run.config), run.versions):
        raise DemorecError(f"it is of another run ({'; '.join(different)})")
    return replace(line, file=f"{place}/{name}")
