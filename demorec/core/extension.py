"""Extensions: how one declares the names that it adds, and which are installed.

A declaration imports nothing heavy. Its values are "module:name" texts that are loaded on use, so that `demorec --help`
takes no longer with twenty extensions than with none.

Installed are the core itself, the folders of `demorec/extensions/`, and those that other packages provide by entry
points in the group `demorec.extensions`, each "module:EXTENSION". An extension that cannot be used is left out and
reported; it does not affect the others.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Literal, get_args

Group = Literal["make", "look", "judge", "edit", "learn", "repair"]
GROUPS: tuple[Group, ...] = get_args(Group)
"""Groups of commands, in the order of `demorec --help`."""
Rows = Mapping[str, str]
"""Name -> "module:name"."""


@dataclass(frozen=True, kw_only=True)
class CommandRow:
    """A command of `demorec`.

    Attributes:
        target: "module:Class" of a dataclass whose fields are the flags (`demorec.cli.Command`).
        group: Heading in `demorec --help`.
        limits: Limits of its process (`demorec.core.limited`): for reading files of unknown origin, for simulating or
        rendering such files, or none.
        drawing_flags: Flags with which it simulates or renders.
    """

    target: str
    group: Group
    limits: Literal["none", "reading", "drawing"] = "none"
    drawing_flags: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class ReaderRow:
    """A kind of foreign files or folders that can be imported.

    Attributes:
        name: Noun for one in a sentence: "an HDF5 file".
        plural: Plural noun: "HDF5 files".
        advice: Action for the user if a recording was expected: "convert it to a run (demorec import)".
        word: Word after `demorec import` for this kind; "" if none is needed.
        suffixes: File suffixes, for a kind that the core does not know; a folder stands for its files with them.
        example: Example of the arguments after `demorec import` and the word.
        importer: "module:function" of (paths, mapping, out, *, video=None), which creates or continues the run `out`;
        for a format without `suggester` also of motors, named, episodes and skip_bad, as in `dataset_import`.
        suggester: "module:function" of (path, tell) that returns the lines of a mapping; it calls `tell` with each open
        decision. "" for a format that needs no mapping.
        describer: "module:function" of a path: yields (plain data, lines) for `demorec info`, without a mapping; "" if
        `info` reads it through an import.
        dropped: "module:function" of an imported run: the data left out, as rows of "bag", "what" and "reason".
    """

    name: str
    plural: str
    advice: str = ""
    word: str = ""
    suffixes: tuple[str, ...] = ()
    example: str
    importer: str
    suggester: str = ""
    describer: str = ""
    dropped: str = ""

    def files(self, paths: Sequence[Path]) -> list[Path]:
        """Replace folders by their files with one of the `suffixes`, if there are any, in the order of their names."""
        found: list[Path] = []
        for path in paths:
            if self.suffixes and path.is_dir():
                found += sorted(file for file in path.iterdir() if file.name.endswith(self.suffixes))
            else:
                found.append(path)
        return found

    @property
    def command(self) -> str:
        """Its import command, without paths."""
        return f"demorec import {self.word}".rstrip()


@dataclass(frozen=True, kw_only=True)
class KindRow:
    """A kind of files or folders that commands read as they are, without an import.

    Attributes:
        plural: Plural noun: "LeRobot datasets".
        viewer: "module:function" of (path, named roles): its episodes as `demorec.view.sources.PlaybackSource`s.
        describer: "module:function" of (path, named roles): (plain data, lines) for `demorec info`.
        digester: "module:function" of a path: its content digest, as in `ExportReport`.
        appender: "module:function" of a path: its state before the first episode that an export appends to it.
    """

    plural: str
    viewer: str
    describer: str
    digester: str = ""
    appender: str = ""


@dataclass(frozen=True, kw_only=True)
class ExporterRow:
    """A format for exporting recordings.

    Attributes:
        target: "module:name" of a `demorec.datasets.options.Exporter`.
        name: Noun for a result, "a folder of tables", for a kind that neither the core nor a reader knows.
        suffixes: File suffixes of such a kind.
        mark: File in a folder of such a kind.
    """

    target: str
    name: str = ""
    suffixes: tuple[str, ...] = ()
    mark: str = ""


@dataclass(frozen=True, kw_only=True)
class ExtraFilesRow:
    """Files that `demorec export lerobot` adds to a dataset of simulated episodes on request.

    Attributes:
        target: "module:Class" of (folder of the dataset, fps). Its static method `read` of an `ExportEpisode` may run
        in another process; `add` takes the results in the order of the episodes, before `finish`.
        help: Help of the flag.
    """

    target: str
    help: str


@dataclass(frozen=True, kw_only=True)
class Extension:
    """Everything an extension adds.

    Attributes:
        name: Name of its folder or package.
        summary: Its purpose in one line.
        needs: Names of the extensions that it imports.
        commands: Name -> command.
        readers: Kind of path -> reader. "dataset", "hdf5" and "rosbag" are kinds that the core knows.
        kinds: Kind of path -> functions that read it without an import.
        tasks, robots, cameras, objects, renderers: Name -> subclass of `Task`, `RobotSpec`, `CameraPreset`, `Shelf`,
        class with the methods of `Renderer`.
        executors: Name for `--executor` of `generate-dataset` -> context manager of `RunOptions` that connects to other
            machines and returns a function (maker, folder) that makes a `demorec.generate.executor.Executor`.
        exporters: Name -> format for exporting recordings.
        statements: Kind for `demorec export lerobot --language` -> function (recording, kinds) that returns the
            `Statement`s of these kinds about a simulated episode.
        extra_files: Flag of `demorec export lerobot`, with underscores -> files that it adds to the dataset.
        file_checks: Name -> `demorec.check.base.Check` of the integrity of recordings, runs and their datasets.
        checks: Name -> check of any dataset, for the extension that judges datasets.
        operations: Name -> command of `demorec dataset`, for the extension that edits datasets.
        columns: Column of a dataset's episodes for `--where` and `--by` -> function (folder, names) that returns a
        mapping with these names for each episode.
        rankings: Name for `demorec view --rank` -> function (paths, named roles) that returns the episodes, worst
            first: name -> the reason for its place.
        lists: Name for `demorec list` -> function that returns (name, summary) of each row.
        proofs: Name -> function (recordings, allowed modules) that yields a `Proof` for each recording.
    """

    name: str
    summary: str
    needs: tuple[str, ...] = ()
    commands: Mapping[str, CommandRow] = field(default_factory=dict)
    readers: Mapping[str, ReaderRow] = field(default_factory=dict)
    kinds: Mapping[str, KindRow] = field(default_factory=dict)
    tasks: Rows = field(default_factory=dict)
    robots: Rows = field(default_factory=dict)
    cameras: Rows = field(default_factory=dict)
    objects: Rows = field(default_factory=dict)
    renderers: Rows = field(default_factory=dict)
    executors: Rows = field(default_factory=dict)
    exporters: Mapping[str, ExporterRow] = field(default_factory=dict)
    statements: Rows = field(default_factory=dict)
    extra_files: Mapping[str, ExtraFilesRow] = field(default_factory=dict)
    file_checks: Rows = field(default_factory=dict)
    checks: Rows = field(default_factory=dict)
    operations: Rows = field(default_factory=dict)
    columns: Rows = field(default_factory=dict)
    rankings: Rows = field(default_factory=dict)
    lists: Rows = field(default_factory=dict)
    proofs: Rows = field(default_factory=dict)


ENTRY_POINTS = "demorec.extensions"
"""Entry point group of other packages, and package of demorec's own extensions."""


@dataclass(frozen=True)
class Extensions:
    """Usable extensions, the core first, and one sentence for each one left out."""

    found: tuple[Extension, ...]
    problems: tuple[str, ...]


@cache
def extensions() -> Extensions:
    """Find all extensions, once."""
    problems: list[str] = []
    declared = [_declaration("demorec", "demorec.extension:EXTENSION", problems)]
    declared += [_declaration(place, target, problems) for place, target in _targets()]
    usable: dict[str, Extension] = {}
    for extension in filter(None, declared):
        if problem := _clash(extension, usable):
            problems.append(problem)
        else:
            usable[extension.name] = extension
    while lacking := [each for each in usable.values() if not set(each.needs) <= usable.keys()]:
        for each in lacking:
            missing = ", ".join(sorted(set(each.needs) - usable.keys()))
            problems.append(f"The extension {each.name} is left out, since it needs {missing}.")
            del usable[each.name]
    return Extensions(found=tuple(usable.values()), problems=tuple(problems))


def _targets() -> Iterator[tuple[str, str]]:
    """Yield (place, "module:name") of each declaration."""
    package = importlib.import_module(ENTRY_POINTS)
    for module in sorted(pkgutil.iter_modules(package.__path__), key=lambda module: module.name):
        yield f"{ENTRY_POINTS}.{module.name}", f"{ENTRY_POINTS}.{module.name}.extension:EXTENSION"
    for point in sorted(entry_points(group=ENTRY_POINTS), key=lambda point: point.name):
        distribution = point.dist.name if point.dist is not None else point.module
        yield f"the package {distribution}", point.value


def _declaration(place: str, target: str, problems: list[str]) -> Extension | None:
    """Load a declaration; None, with a sentence among the problems, if that fails."""
    module, _, name = target.partition(":")
    try:
        found = getattr(importlib.import_module(module), name)
    except (Exception, SystemExit) as error:  # code of another package may raise anything
        words = f"{type(error).__name__}: {error}".rstrip(": ")
        problems.append(f"The extension of {place} is left out: {target} cannot be loaded ({words}).")
        return None
    if not isinstance(found, Extension):
        problems.append(f"The extension of {place} is left out: {target} is not a demorec.core.extension.Extension.")
        return None
    return found


def _clash(extension: Extension, others: Mapping[str, Extension]) -> str:
    """Describe a name conflict of an extension with another one; "" if there is none."""
    if extension.name in others:
        return f"The extension {extension.name} is left out, since another one has that name."
    for other in others.values():
        for table, rows in vars(other).items():
            own = getattr(extension, table)
            if isinstance(rows, Mapping) and (both := sorted(rows.keys() & own.keys())):
                kind = table.replace("_", " ")
                return (
                    f"The extension {extension.name} is left out, since {other.name} has {kind} with the same name: "
                    f"{', '.join(both)}."
                )
    return ""


def rows_of(table: str) -> Iterator[tuple[str, Any]]:
    """Yield (name, value) of a table, a field of `Extension`, over all extensions."""
    for extension in extensions().found:
        yield from getattr(extension, table).items()


def command_rows() -> dict[str, CommandRow]:
    """Name -> command of `demorec`."""
    return dict(rows_of("commands"))


def reader_rows() -> dict[str, ReaderRow]:
    """Kind of path -> its reader."""
    return dict(rows_of("readers"))


def kind_rows() -> dict[str, KindRow]:
    """Kind of path -> functions that read it without an import."""
    return dict(rows_of("kinds"))


def kind_function(kind: str, name: str) -> Callable[..., Any] | None:
    """Load a function of a kind of path by its name in `KindRow`; None if no extension has one."""
    row = kind_rows().get(kind)
    target = "" if row is None else getattr(row, name)
    return pkgutil.resolve_name(target) if target else None


def exporter_rows() -> dict[str, ExporterRow]:
    """Name -> format for exporting recordings."""
    return dict(rows_of("exporters"))


@cache
def extension_packages() -> frozenset[str]:
    """Packages outside demorec whose extensions are installed, and whose files may therefore be read."""
    targets = [target for table in ("robots", "objects") for _, target in rows_of(table)]
    packages = {target.partition(":")[0].partition(".")[0] for target in targets}
    return frozenset(packages - {"demorec"})


def targets_of(table: str) -> dict[str, str]:
    """Name -> "module:name" of a table."""
    return {name: getattr(row, "target", row) for name, row in rows_of(table)}
