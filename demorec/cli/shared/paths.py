"""What commands read, recordings or not; and where they must not write, since they read it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from demorec.cli.shared.output import renamed, tell
from demorec.core.errors import ConfigError, DemorecError
from demorec.core.extensions import reader_rows
from demorec.core.processes import terminate_as_interrupt
from demorec.core.replacing import json_object, use_as_source
from demorec.datasets.lerobot.paths import DATASET as DATASET_KIND
from demorec.runs.find import EPISODE_FOLDERS, EVALUATION_NAME, find
from demorec.runs.foreign import import_kind, opened
from demorec.runs.run_file import DATASET, EPISODES, FAILED, RUN_NAME, UNFINISHED, load_any_run_file

_FOREIGN = [row.plural for kind, row in reader_rows().items() if kind != "dataset"]
WHAT_IS_READ = ", ".join(["recordings", "runs", "LeRobot datasets", *_FOREIGN, "folders of these"])
Readable = Annotated[Positional[tuple[Path, ...]], arg(help=f"Any of: {WHAT_IS_READ}.")]
MappingFile = Annotated[
    Path | None,
    arg(
        help="Mapping file, as demorec import takes it, for bags and other formats that need one (auto: the one that "
        "demorec import --suggest writes, if it leaves nothing to decide)."
    ),
]
_PARTS = (EPISODES, FAILED, UNFINISHED)


def need_paths(paths: Sequence[Path], command: str) -> None:
    """Raise ConfigError when no path is given; `command` names one that takes all that can be shown."""
    if not paths:
        raise ConfigError(
            f"No path is given: name a recording, a run or a dataset, e.g. demorec {command} recordings/demo."
        )


def tell_unfinished(paths: Iterable[Path]) -> None:
    """Name what is unfinished in what the user has named, which the command leaves out."""
    tell(*(f"Left out: {left}." for path in paths if (left := find(path).left)))


def tell_incomplete(paths: Iterable[Path]) -> None:
    """Name what unfinished runs lack, of which the command takes what is there."""
    for path in paths:
        if json_object(path / RUN_NAME).get("complete") is False:
            with suppress(DemorecError):  # reported where the run is read
                tell(f"Note: {load_any_run_file(path).unfinished}: {path}")


def places_read(paths: Sequence[Path]) -> list[Path]:
    """Of recordings, runs and datasets: those files and folders in which an image may be a part of the data.

    A run's own folder is none: an .rrd file or an image beside its recordings may be replaced.
    """
    return [path / DATASET if find(path).kind in EPISODE_FOLDERS else path for path in paths]


def refuse_sources(paths: Sequence[Path], targets: Sequence[Path], *, do: str) -> None:
    """Raise ConfigError when a recording that is to be made would lie in, or replace, what the same command reads.

    So it is when one would replace another.

    Args:
        paths: As the user named them: recordings, runs, folders of recordings, datasets. A run counts as a whole,
            also where only one of its recordings is named.
        targets: Of the new recordings.
        do: What is done with each: "render".
    """
    if len(set(targets)) != len(targets):
        raise ConfigError(f"Two recordings have the same name and would get into each other's way: {do} them apart.")
    sources = [run_of(path) or path for path in paths]
    for target in targets:
        reason = use_as_source(target.resolve(), sources)
        if reason:
            raise ConfigError(f"No new recording can be made here, since {reason}: choose another --out: {target}")
    refuse_inside(targets)


def refuse_inside(targets: Iterable[Path]) -> None:
    """Raise ConfigError when something new would lie inside of a dataset, or in a part of a run or an evaluation.

    Whatever a person puts there is foreign to it, and would keep it from being replaced ever after.
    """
    for target in targets:
        resolved = target.resolve()
        for place in (resolved, *resolved.parents):
            whole = place.parent
            is_part = place.name in _PARTS and any((whole / name).is_file() for name in (RUN_NAME, EVALUATION_NAME))
            if is_part or (place != resolved and DATASET_KIND.recognises(place)):
                raise ConfigError(
                    f"Nothing else is written into {'a run' if is_part else 'a dataset'}, since it could not be "
                    f"replaced then: choose a place outside of {place}: {target}"
                )


def run_of(recording: Path) -> Path | None:
    """The run that a recording belongs to by its place; None for one elsewhere."""
    folder = recording.resolve().parent
    return folder.parent if folder.name in (EPISODES, FAILED) else None


@contextmanager
def reading(
    paths: Sequence[Path], mapping: Path | None, *, imports_datasets: bool = False
) -> Iterator[tuple[Path, ...]]:
    """What to read in the place of each path; until the context is left, all output names the user's paths.

    Imported files (`demorec.runs.foreign`) are read through a temporary run. No output names that run:
    its episodes are called "demo.hdf5: episode 3".

    Args:
        paths: As the user named them.
        mapping: Of `--mapping`.
        imports_datasets: Whether the command takes datasets as recordings.

    Raises:
        ConfigError: A mapping is missing, given for what needs none, or impossible; or the disk is too small.
        DemorecError: A path cannot be read.
    """
    if mapping is None and not any(import_kind(path, imports_datasets) for path in paths):
        yield tuple(paths)
        return
    with terminate_as_interrupt(), opened(paths, mapping, imports_datasets=imports_datasets, tell=tell) as found:
        names = {str(run): str(path) for path, run in zip(paths, found, strict=True) if run != path}
        with renamed(names) as in_users_words:
            try:
                yield tuple(found)
            except DemorecError as error:
                error.args = tuple(in_users_words(part) for part in error.args)
                raise
