"""Declaration of an extension: the names that it adds, each with the location of its code.

A declaration imports nothing heavy. Its values are "module:name" texts that are loaded on use, so that `demorec --help`
takes no longer with twenty extensions than with none.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, get_args

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
        reviewer: "module:function" of a mapping's path: its features and cameras in words; ConfigError if a decision is
        open. Needed with a `suggester`.
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
    reviewer: str = ""
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
class Extension:
    """Everything an extension adds.

    Attributes:
        name: Name of its folder or package.
        summary: Its purpose in one line.
        needs: Names of the extensions that it imports.
        commands: Name -> command.
        readers: Kind of path -> reader. "dataset", "hdf5" and "rosbag" are kinds that the core knows.
        tasks: Name -> subclass of `demorec.tasks.base.Task`.
        robots: Name -> `demorec.robots.robot.RobotSpec`.
        cameras: Name -> `demorec.render.cameras.CameraPreset`.
        objects: Name -> `demorec.objects.shelf.Shelf`.
        renderers: Name -> class with the methods of `demorec.render.Renderer`.
        exporters: Name -> format for exporting recordings.
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
    tasks: Rows = field(default_factory=dict)
    robots: Rows = field(default_factory=dict)
    cameras: Rows = field(default_factory=dict)
    objects: Rows = field(default_factory=dict)
    renderers: Rows = field(default_factory=dict)
    exporters: Mapping[str, ExporterRow] = field(default_factory=dict)
    file_checks: Rows = field(default_factory=dict)
    checks: Rows = field(default_factory=dict)
    operations: Rows = field(default_factory=dict)
    columns: Rows = field(default_factory=dict)
    rankings: Rows = field(default_factory=dict)
    lists: Rows = field(default_factory=dict)
    proofs: Rows = field(default_factory=dict)
