"""Content of a run's folder: the run's own files, which --overwrite may replace, and recordings that can be kept.

Everything else is the user's. Every recording is verified before a run builds on it.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from demorec.core.errors import ConfigError, DemorecError, RecordingError, describe_error, resource_error, without_path
from demorec.core.files import free_name, open_locked, sha256_of, sync_path
from demorec.core.own_versions import version_differences
from demorec.core.plain import plain_differences, to_plain
from demorec.core.replacing import RECORDING, ReplaceableKind, files_below, json_object
from demorec.datasets.lerobot.paths import DATASET
from demorec.datasets.lerobot.sidecar import CONFIGS_PATH
from demorec.runs.run_file import DATASET as DATASET_FOLDER
from demorec.runs.run_file import (
    EPISODES,
    FAILED,
    RUN_NAME,
    UNFINISHED,
    Attempt,
    GeneratedRun,
    recording_name,
)

PARTS = (DATASET_FOLDER, FAILED, EPISODES, RUN_NAME)
"""Entries of a run that --overwrite deletes, run.json, which the others are recognised by, last."""

_RECORDING = re.compile(r"episode_\d{6,}(\.attempt_\d+)?\.mcap")
_SCRATCH = re.compile(r".+-\d+-\d+")  # worker folder: host, process, number


def clear_scratch(folder: Path, run: GeneratedRun) -> None:
    """Remove the remains of lost workers' attempts that have been made since.

    Anything else in unfinished/, or being written, stays.
    """
    made = {recording_name(line.episode_index, line.attempt, success=False) for line in run.attempts}
    for scratch in (folder / UNFINISHED).glob("*"):
        if not _SCRATCH.fullmatch(scratch.name) or scratch.is_symlink() or not scratch.is_dir():
            continue
        for path in scratch.iterdir():
            if path.name.removesuffix(".part") in made:
                with suppress(OSError):  # it is being written, or is not a file
                    os.close(open_locked(path))
                    path.unlink()
        with suppress(OSError):  # it contains something else
            scratch.rmdir()


def foreign_recordings(
    folder: Path,
    place: str,
    *,
    known: frozenset[str] = frozenset(),
    is_ours: Callable[[Path], bool] = RECORDING.recognises,
) -> Iterator[str]:
    """Yield the files in a folder of recordings that are not ours.

    Args:
        folder: Folder of the run or the evaluation.
        place: episodes or failed.
        known: Files, relative to `folder`, that it has made, in any state.
        is_ours: Whether another file may be one that it has made.
    """
    if (folder / place).is_symlink():
        yield place
        return
    for name in files_below(folder / place):
        file = folder / place / name
        is_made = file.is_file() and (f"{place}/{name}" in known or is_ours(file))
        if not (_RECORDING.fullmatch(name) and is_made):
            yield f"{place}/{name}"


def is_dataset_of_run(dataset: Path, config_digest: str) -> bool:
    """Check whether a folder is a dataset of episodes of one run alone, without other content."""
    return (
        not dataset.is_symlink()
        and DATASET.recognises(dataset)
        and not DATASET.strangers(dataset)
        and set(json_object(dataset / CONFIGS_PATH)) == {config_digest}
    )


def check_dataset_place(folder: Path, run: GeneratedRun) -> None:
    """Raise ConfigError if a dataset that the run did not make, or a broken link, is in its dataset's place."""
    dataset = folder / DATASET_FOLDER
    if not os.path.lexists(dataset):
        return
    if not dataset.exists():
        raise ConfigError(f"The dataset is a link whose target is missing, mend or remove it: {dataset}")
    if run.export is None and not is_dataset_of_run(dataset, run.config_digest):
        raise ConfigError(f"A dataset that this run did not make is in the way; move it elsewhere: {dataset}")


def _recognises(folder: Path) -> bool:
    run = json_object(folder / RUN_NAME)
    if run:  # an imported run has one as well
        return isinstance(run.get("episodes"), list) and "config_digest" in run
    return any(_may_be_generated(file) for file in recordings_of(folder))


def _may_be_generated(file: Path) -> bool:
    """Check whether a file is a recording without another origin, such as a render or an import."""
    from demorec.mcap import open_recording

    if not RECORDING.recognises(file):
        return False
    try:
        with open_recording(file) as recording:
            return recording.info.simulation is not None and not recording.info.origin
    except RecordingError:
        return True  # damaged ones are made again


def _strangers(folder: Path) -> list[str]:
    run = json_object(folder / RUN_NAME)
    lines = run.get("episodes")
    known = frozenset(str(line.get("file")) for line in lines or () if isinstance(line, dict))
    found = [
        name
        for place in (EPISODES, FAILED)
        for name in foreign_recordings(folder, place, known=known, is_ours=_may_be_generated)
    ]
    dataset = folder / DATASET_FOLDER
    if os.path.lexists(dataset) and not is_dataset_of_run(dataset, str(run.get("config_digest"))):
        inside = () if dataset.is_symlink() else DATASET.strangers(dataset)
        found += [f"{DATASET_FOLDER}/{name}" for name in inside] or [DATASET_FOLDER]
    return found


RUN = ReplaceableKind(name="a run of generate-dataset", is_folder=True, recognises=_recognises, strangers=_strangers)

Inspector = Callable[[Path], tuple[Attempt, Mapping[str, Any], Mapping[str, str]]]
"""Reads a whole recording, as `inspect_recording` does; DemorecError or OSError if it is invalid."""


def recordings_of(folder: Path) -> list[Path]:
    """List everything in episodes/ and failed/ with the name of a recording, of any type."""
    return sorted(path for place in (EPISODES, FAILED) for path in (folder / place).glob("*.mcap"))


def survey(
    folder: Path, run: GeneratedRun, *, inspect: Inspector, progress: Callable[[int, int], None]
) -> tuple[list[Attempt], dict[str, str]]:
    """Verify every recording of a folder against run.json, or read it in full if run.json does not list it.

    Damaged or unfinished recordings, those of other runs and other entries are moved to unfinished/; nothing is
    deleted. Returns the attempts with intact recordings, and failed ones without a recording; and file -> reason why it
    was moved. Raises ResourceError, and moves nothing, if this machine cannot read one of them now.
    """
    known = {a.file: a for a in run.attempts if a.file}
    kept = [a for a in run.attempts if not a.file]
    set_aside: dict[str, str] = {}
    files = recordings_of(folder)
    for number, path in enumerate(files):
        file = path.relative_to(folder).as_posix()
        line = known.get(file)
        try:
            if line is None:
                line = _adopt(path, run, inspect)
            elif path.stat().st_size != line.num_bytes or sha256_of(path) != line.sha256:
                raise DemorecError("its bytes differ from those in run.json")
            kept.append(line)
        except (DemorecError, OSError, MemoryError) as error:
            if (lack := resource_error(error, path)) is not None:
                raise lack from error
            set_aside[file] = without_path(error, path) if isinstance(error, DemorecError) else describe_error(error)
            path.rename(free_name(folder / UNFINISHED / path.name))
            sync_path(path.parent)
        progress(number + 1, len(files))
    return kept, set_aside


def _adopt(path: Path, run: GeneratedRun, inspect: Inspector) -> Attempt:
    line, config, versions = inspect(path)
    place = EPISODES if line.success else FAILED
    name = recording_name(line.episode_index, line.attempt, success=line.success)
    if (path.parent.name, path.name) != (place, name):
        raise DemorecError(f"it contains episode {line.episode_index}, attempt {line.attempt}")
    different = plain_differences(config, to_plain(run.config)) + version_differences(versions, run.versions)
    if different:
        raise DemorecError(f"it is of another run ({'; '.join(different)})")
    return replace(line, file=f"{place}/{name}")
