"""Inputs of commands: their paths, the places where a command must not write because it reads them, and the flags by
which users name features' roles.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, UseAppendAction, arg

from demorec.cli.shared.output import renamed, tell
from demorec.core.errors import ConfigError, DemorecError
from demorec.core.extension import KindRow, ReaderRow, kind_rows, reader_rows
from demorec.core.processes import terminate_as_interrupt
from demorec.core.replacing import json_object, use_as_source
from demorec.datasets.lerobot.paths import DATASET as DATASET_KIND
from demorec.runs.find import EPISODE_FOLDERS, EVALUATION_NAME, exported_kind, find
from demorec.runs.foreign import import_kind, opened
from demorec.runs.run_file import DATASET, EPISODES, FAILED, RUN_NAME, UNFINISHED, load_any_run_file

if TYPE_CHECKING:
    from demorec.episode.roles import NamedRoles

_READ: dict[str, KindRow | ReaderRow] = {**kind_rows(), **reader_rows()}
WHAT_IS_READ = ", ".join(["recordings", "runs", *(row.plural for row in _READ.values()), "folders of these"])
Readable = Annotated[Positional[tuple[Path, ...]], arg(help=f"Any of: {WHAT_IS_READ}.")]
MappingFile = Annotated[
    Path | None,
    arg(
        help="Mapping file, as for demorec import, for bags and other formats that need one (auto: the output "
        "of demorec import --suggest, if it is complete)."
    ),
]
_PARTS = (EPISODES, FAILED, UNFINISHED)


def need_paths(paths: Sequence[Path], command: str) -> None:
    """Raise ConfigError if no path is given; `command` is a command that accepts all readable paths."""
    if not paths:
        raise ConfigError(
            f"No path is given: name a recording, a run or a dataset, e.g. demorec {command} recordings/demo."
        )


def tell_unfinished(paths: Iterable[Path]) -> None:
    """Print the unfinished recordings among the user's paths, which the command leaves out."""
    tell(*(f"Left out: {left}." for path in paths if (left := find(path).left)))


def tell_incomplete(paths: Iterable[Path]) -> None:
    """Print what unfinished runs lack; the command uses their finished part."""
    for path in paths:
        if json_object(path / RUN_NAME).get("complete") is False:
            with suppress(DemorecError):  # reported when the run is read
                if unfinished := load_any_run_file(path).unfinished:
                    tell(f"Note: {unfinished}: {path}")


def places_read(paths: Sequence[Path]) -> list[Path]:
    """Files and folders of recordings, runs and datasets in which an image may be part of the data.

    A run's own folder is not among them: an .rrd file next to its recordings may be replaced.
    """
    return [path / DATASET if find(path).kind in EPISODE_FOLDERS else path for path in paths]


def refuse_sources(paths: Sequence[Path], targets: Sequence[Path], *, do: str) -> None:
    """Raise ConfigError if a new recording would be inside, or replace, an input of the same command.

    Also raises if one new recording would replace another. A run counts as a whole, even if only one of its recordings
    is named. `do` is the command's verb: "render".
    """
    if len(set(targets)) != len(targets):
        raise ConfigError(f"Two recordings have the same name and would overwrite each other: {do} them apart.")
    sources = [run_of(path) or path for path in paths]
    for target in targets:
        reason = use_as_source(target.resolve(), sources)
        if reason:
            raise ConfigError(f"No new recording can be made here, since {reason}: choose another --out: {target}")
    refuse_inside(targets)


def refuse_inside(targets: Iterable[Path]) -> None:
    """Raise ConfigError if a target is inside a dataset, or inside a part of a run or an evaluation.

    Such a file would be foreign there, and would prevent the folder from being replaced later.
    """
    for target in targets:
        resolved = target.resolve()
        for place in (resolved, *resolved.parents):
            whole = place.parent
            is_part = place.name in _PARTS and any((whole / name).is_file() for name in (RUN_NAME, EVALUATION_NAME))
            is_dataset = DATASET_KIND.recognises(place) or exported_kind(place) is not None
            if is_part or (place != resolved and is_dataset):
                raise ConfigError(
                    f"A new file inside {'a run' if is_part else 'a dataset'} would prevent it from being "
                    f"replaced: choose a path outside {place}: {target}"
                )


def run_of(recording: Path) -> Path | None:
    """Run whose folder contains a recording; None if there is none."""
    folder = recording.resolve().parent
    return folder.parent if folder.name in (EPISODES, FAILED) else None


@contextmanager
def reading(
    paths: Sequence[Path], mapping: Path | None, *, imports_datasets: bool = False
) -> Iterator[tuple[Path, ...]]:
    """Yield the paths to read instead of the given ones; inside the context, all output names the user's paths.

    Imported files (`demorec.runs.foreign`) are read through a temporary run. No output names that run: its episodes are
    printed as "demo.hdf5: episode 3".

    Args:
        paths: The user's paths.
        mapping: Value of `--mapping`.
        imports_datasets: Whether the command reads datasets as recordings.

    Raises:
        DemorecError: A path cannot be read, or a mapping is impossible or given without need.
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


_Features = Annotated[tuple[str, ...], UseAppendAction, arg(metavar="FEATURE")]
_GripperNames = Annotated[tuple[str, ...], UseAppendAction, arg(metavar="NAME")]


@dataclass(frozen=True, kw_only=True)
class RoleFlags:
    """Features whose role the user names, in data that demorec did not simulate."""

    state: _Features = ()
    """Feature with the robot's state (auto: by its name); repeat the flag to join several."""
    action: _Features = ()
    """Feature with the action (auto: by its name); repeat the flag to join several."""
    gripper: _GripperNames = ()
    """Feature or state element with the gripper's position (auto: by its name)."""

    @property
    def named(self) -> NamedRoles:
        """The flags as `NamedRoles`."""
        from demorec.episode.roles import NamedRoles

        return NamedRoles(state=self.state, action=self.action, gripper=self.gripper)


NamedByFlags = Annotated[RoleFlags, arg(name="")]
