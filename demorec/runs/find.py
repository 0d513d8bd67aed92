"""Identify a path: a recording, a run, a dataset, another program's file, nothing, or something unreadable.

Every command with a path argument uses this module, so that all accept the same inputs and reject others with the same
messages. Nothing that could block is opened: FIFOs, sockets and devices are reported by kind.
"""

from __future__ import annotations

import os
import shlex
import stat
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO

from demorec.core.errors import ConfigError, resource_error
from demorec.core.extension import ExporterRow, ReaderRow, exporter_rows, kind_rows, reader_rows
from demorec.core.files import HDF5_MAGIC, MCAP_MAGIC, RERUN_MAGICS, irregular_kind, open_regular
from demorec.core.replacing import is_utf8, shown
from demorec.datasets.lerobot.paths import INFO_PATH
from demorec.runs.run_file import DATASET, EPISODES, FAILED, RUN_NAME, UNFINISHED

PathKind = str
"""Kind of a path: "recording", "unfinished", "rrd", "run", "evaluation", "dataset", "recordings" (a folder of them that
is not a run), "hdf5", "rosbag", the kind of an extension's reader or exporter, "nothing" or "unreadable"."""

EPISODE_FOLDERS: tuple[PathKind, ...] = ("run", "recordings", "evaluation")
"""Kinds that hold recordings, directly or in episodes/ and failed/."""

EVALUATION_NAME = "evaluation.json"

_WORDS: dict[PathKind, tuple[str, str]] = {
    "recording": ("a recording (.mcap)", ""),
    "unfinished": ("an unfinished recording (.part)", "; demorec recover keeps its intact part"),
    "rrd": ("a Rerun file (.rrd)", "; rerun shows it"),
    "hdf5": ("an HDF5 file", "; name the run that it was made from"),
    "rosbag": ("a bag of another program", ""),
    "run": ("a run", "; name one of its recordings"),
    "evaluation": ("an evaluation", "; name one of its recordings"),
    "dataset": ("a LeRobot dataset", "; name the run that it was made from"),
    "recordings": ("a folder of recordings", "; name one of them"),
}
"""Noun for each kind, and advice if the kind was not expected."""
_OF_EXTENSIONS = ("dataset", "hdf5", "rosbag")
"""Kinds above that only extensions read."""
ROSBAG2 = "metadata.yaml"
"""File that marks a folder as a bag of rosbag2."""
BAG_SUFFIXES = (".db3", ".bag", ".mcap.zstd", ".db3.zstd")
"""Suffixes of bags, besides .mcap, which may be a recording."""
OUR_METADATA = b"demorec."
"""Prefix of the metadata names in demorec's recordings."""
SQLITE_MAGIC = b"SQLite format 3\0"
ROS1_MAGIC = b"#ROSBAG V"
_HEAD_BYTES = 1 << 16
_MAGICS: tuple[tuple[bytes, PathKind], ...] = (
    (MCAP_MAGIC, "recording"),
    *((magic, "rrd") for magic in RERUN_MAGICS),
    (HDF5_MAGIC, "hdf5"),
    (ROS1_MAGIC, "rosbag"),
    (SQLITE_MAGIC, "rosbag"),
)
_SUFFIXES: dict[str, PathKind] = {".mcap": "recording", ".part": "unfinished", ".rrd": "rrd", ".hdf5": "hdf5"}
_MARKS: tuple[tuple[str, PathKind], ...] = (
    (RUN_NAME, "run"),
    (INFO_PATH, "dataset"),
    (EVALUATION_NAME, "evaluation"),
    (ROSBAG2, "rosbag"),
)
"""Files that identify a kind of folder."""

NOT_UTF8 = "This name has bytes that are not UTF-8, which some libraries cannot open: rename it"


@dataclass(frozen=True, kw_only=True)
class Found:
    """Kind and content of a path.

    Attributes:
        path: The given path.
        kind: Its kind.
        reason: Reason for "nothing" and "unreadable", as a sentence without its end.
        recordings: Finished recordings, in order: for a run or an evaluation those in episodes/, for any other folder
        those in it and in episodes/; for a recording itself.
        failed: Recordings of failed attempts, in failed/.
        unfinished: Recordings in progress, or cut off by a kill and not made again since: in the folder itself, in
        episodes/ and in folders of unfinished/.
    """

    path: Path
    kind: PathKind
    reason: str = ""
    recordings: tuple[Path, ...] = ()
    failed: tuple[Path, ...] = ()
    unfinished: tuple[Path, ...] = ()

    @property
    def left(self) -> str:
        """Unfinished recordings and what to do about them, as a sentence without its end; "" if all are finished."""
        if not self.unfinished:
            return ""
        first, count = shlex.quote(str(self.unfinished[0])), len(self.unfinished)
        what, it = ("a recording is", "it") if count == 1 else (f"{count} recordings are", "the first")
        return f"{what} unfinished (in progress, or left by a crash): demorec recover {first} keeps the rest of {it}"


def find(path: Path) -> Found:
    """Identify a path: files by their first bytes or else their suffix, folders by their content.

    Raises:
        ResourceError: The machine lacks the resources to check it.
    """
    if not is_utf8(path):
        return Found(path=path, kind="unreadable", reason=NOT_UTF8)
    try:
        mode = path.stat().st_mode
        if stat.S_ISDIR(mode):
            found = _folder(path)
            if odd := [file for file in (*found.recordings, *found.failed) if not is_utf8(file)]:
                return Found(path=odd[0], kind="unreadable", reason=NOT_UTF8)
            return found
        if not stat.S_ISREG(mode):
            return Found(path=path, kind="unreadable", reason=f"This is {irregular_kind(mode)}, not a file or folder")
        return _file(path)
    except FileNotFoundError:
        if path.is_symlink():
            return Found(path=path, kind="nothing", reason="This is a link whose target is missing")
        part = path.with_name(f"{path.name}.part")
        left = Found(path=path, kind="unfinished", unfinished=(part,) if _is_there(part) else ()).left
        return Found(path=path, kind="nothing", reason="; ".join(filter(None, ("No such file or folder", left))))
    except OSError as error:
        if (lack := resource_error(error, path)) is not None:
            raise lack from error
        return Found(path=path, kind="unreadable", reason=f"This cannot be read ({error.strerror})")


def name_of(kind: PathKind) -> str:
    """Noun for a kind in a sentence: "an HDF5 file"."""
    return _words(kind)[0]


def import_word(kind: PathKind) -> str:
    """Return the word after `demorec import` for a kind; "" if it needs none or is not imported."""
    row = reader_rows().get(kind)
    return "" if row is None else row.word


def _words(kind: PathKind) -> tuple[str, str]:
    """Noun for a kind in a sentence, and advice if the kind was not expected."""
    row = reader_rows().get(kind)
    if row is None and kind not in _WORDS:
        return exporter_rows()[kind].name, "; name the run that it was made from"
    if row is None or (kind in _WORDS and not row.advice):
        name, advice = _WORDS[kind]
        is_read = row is not None or kind in kind_rows() or kind not in _OF_EXTENSIONS
        return name, advice if is_read else f", which no installed extension reads{advice}"
    return row.name, f"; {row.advice}" if row.advice else ""


def expect(path: Path, *kinds: PathKind) -> Found:
    """Identify a path that must be of one of these kinds and, if it is a folder of episodes, hold a recording.

    Raises:
        ConfigError: It has another kind, is missing, or cannot be read.
        ResourceError: As in `find`.
    """
    found = find(path)
    if found.reason:
        raise ConfigError(f"{found.reason}: {found.path}")
    if found.kind not in kinds:
        taken, (name, advice) = [_words(kind)[0] for kind in kinds], _words(found.kind)
        if kinds == ("dataset",) and found.kind == "run":
            inside = path / DATASET
            advice = (
                f"; its dataset is {inside}" if _is_there(inside / INFO_PATH) else "; demorec export converts it to one"
            )
        allowed = " or ".join(filter(None, (", ".join(taken[:-1]), taken[-1])))
        raise ConfigError(f"Expected {allowed}, found {name}{advice}: {path}")
    return found


def expect_recordings(found: Found, files: Sequence[Path]) -> None:
    """Raise ConfigError if `files`, the recordings that a command selected from `found`, is empty."""
    if files:
        return
    only = " except failed attempts, in failed/" if found.failed else ""
    left = f"; {found.left}" if found.left else ""
    raise ConfigError(f"No finished recording in {_words(found.kind)[0]}{only}{left}: {found.path}")


def _file(path: Path) -> Found:
    with open_regular(path) as file:
        head = file.read(max(len(magic) for magic, _ in _MAGICS))
        kind: PathKind | None = "rosbag" if path.name.endswith(BAG_SUFFIXES) else _SUFFIXES.get(path.suffix)
        if kind is None:
            rows: Mapping[PathKind, ExporterRow | ReaderRow] = {**exporter_rows(), **reader_rows()}
            kind = next((kind for kind, row in rows.items() if path.name.endswith(row.suffixes)), None)
        if kind != "unfinished":
            kind = next((kind for magic, kind in _MAGICS if head.startswith(magic)), kind)
        if kind == "recording" and _is_foreign(file):
            kind = "rosbag"
    if kind is None:
        reason = "The file is not a recording (.mcap), HDF5 file or bag" if head else "The file is empty"
        return Found(path=path, kind="nothing", reason=reason)
    return Found(path=path, kind=kind, recordings=(path,) if kind == "recording" else ())


def _is_foreign(file: BinaryIO) -> bool:
    """Whether an MCAP file begins as another program writes it: with records but without demorec's metadata.

    demorec's recordings have this metadata at the start and again at the end, so that one damaged place does not turn a
    recording into a bag.
    """
    file.seek(0)
    head = file.read(_HEAD_BYTES)
    file.seek(-min(_HEAD_BYTES, file.seek(0, os.SEEK_END)), os.SEEK_END)
    place = len(MCAP_MAGIC)
    if not head.startswith(MCAP_MAGIC) or head[place : place + 1] != b"\x01" or OUR_METADATA in head + file.read():
        return False
    return len(head) > place + 9 + int.from_bytes(head[place + 1 : place + 9], "little")


def _folder(path: Path) -> Found:
    entries = [entry.name for entry in path.iterdir()]
    kind = next((kind for name, kind in _MARKS if _is_there(path / name)), exported_kind(path))
    if kind in ("dataset", "rosbag") or kind in exporter_rows():
        return Found(path=path, kind=kind)
    here = _recordings_in(path) if kind is None else ()
    if kind is None and _holds_bags(path, here):
        return Found(path=path, kind="rosbag")
    if kind is None and not here and (held := _held_kind(entries)) is not None:
        return Found(path=path, kind=held)
    recordings, failed = (*here, *_recordings_in(path / EPISODES)), _recordings_in(path / FAILED)
    made = {file.stem for file in (*recordings, *failed)}
    places = [path, path / EPISODES]
    with suppress(OSError):
        places += _entries(path / UNFINISHED)
    parts: list[Path] = []
    for place in places:
        with suppress(OSError):  # an unreadable entry must not hide the rest
            parts += [file for file in _entries(place) if file.name.endswith(".mcap.part")]
    unfinished = tuple(p for p in parts if not {p.name.removesuffix(".mcap.part"), p.name.partition(".")[0]} & made)
    found = Found(path=path, kind=kind or "recordings", recordings=recordings, failed=failed, unfinished=unfinished)
    if kind is None and not recordings and not failed:
        return replace(found, kind="nothing", reason=_nothing_in(found, entries))
    return found


def exported_kind(folder: Path) -> PathKind | None:
    """Return the format of which a folder is an export, by its mark; None if it has none."""
    return next((name for name, row in exporter_rows().items() if row.mark and _is_there(folder / row.mark)), None)


def _held_kind(entries: Sequence[str]) -> PathKind | None:
    """Return the kind of an extension's reader whose files a folder holds, by their suffixes; None if none has them."""
    rows = ((kind, row.suffixes) for kind, row in reader_rows().items() if row.suffixes)
    return next((kind for kind, suffixes in rows if any(entry.endswith(suffixes) for entry in entries)), None)


def _holds_bags(path: Path, recordings: Sequence[Path]) -> bool:
    """Whether a folder holds bags: files, or folders of rosbag2."""
    if recordings:
        with suppress(OSError, ValueError), open_regular(recordings[0]) as file:
            return _is_foreign(file)
        return False
    return any(entry.name.endswith(BAG_SUFFIXES) or _is_there(entry / ROSBAG2) for entry in _entries(path))


def _is_there(path: Path) -> bool:
    """Whether a path exists; OSError if that cannot be determined."""
    try:
        path.lstat()
    except (FileNotFoundError, NotADirectoryError):
        return False
    return True


def _recordings_in(folder: Path) -> tuple[Path, ...]:
    return tuple(path for path in _entries(folder) if path.suffix == ".mcap")


def _entries(folder: Path) -> tuple[Path, ...]:
    """Entries of a folder, in order; empty if it is missing."""
    try:
        return tuple(sorted(folder.iterdir()))
    except (FileNotFoundError, NotADirectoryError):
        return ()


def _nothing_in(found: Found, entries: Sequence[str]) -> str:
    """Reason why a folder counts as "nothing", with suggestions."""
    reason = f"The folder holds no recording (*.mcap), run ({RUN_NAME}) or dataset ({INFO_PATH})"
    if found.left:
        return f"{reason}; {found.left}"
    path = found.path
    for what, marks in (("runs", (RUN_NAME, EPISODES)), ("datasets", (INFO_PATH,))):
        if below := sorted(name for name in entries if any(_is_there(path / name / mark) for mark in marks)):
            return f"{reason}; it holds {what}: name one ({shown(below)})"
    return reason
