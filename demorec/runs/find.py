"""What a path is: a recording, a run, a dataset, something of another program, nothing, or something unreadable.

Every command that is given a path asks here, so that all of them take the same things and refuse the rest in the same
words. Nothing is opened that could block: a FIFO, a socket or a device is named as what it is.
"""

from __future__ import annotations

import os
import shlex
import stat
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO

from demorec.core.errors import ConfigError, resource_error
from demorec.core.extensions import reader_rows
from demorec.core.files import HDF5_MAGIC, MCAP_MAGIC, RERUN_MAGICS, irregular_kind, open_regular
from demorec.core.replacing import shown
from demorec.core.targets import is_utf8
from demorec.datasets.lerobot.paths import INFO_PATH
from demorec.runs.run_file import DATASET, EPISODES, FAILED, RUN_NAME, UNFINISHED

PathKind = str
"""Kind of a path: "recording", "unfinished", "rrd", "run", "evaluation", "dataset", "recordings" (a folder of them that
is not a run), "hdf5", "rosbag", the kind of an extension's reader, "nothing" or "unreadable"."""

EPISODE_FOLDERS: tuple[PathKind, ...] = ("run", "recordings", "evaluation")
"""What holds recordings, in itself or in episodes/ and failed/."""

EVALUATION_NAME = "evaluation.json"

_WORDS: dict[PathKind, tuple[str, str]] = {
    "recording": ("a recording (.mcap)", ""),
    "unfinished": ("an unfinished recording (.part)", "; demorec recover keeps what is whole in it"),
    "rrd": ("a Rerun file (.rrd)", "; demorec view shows it by a name that ends in .rrd"),
    "hdf5": ("an HDF5 file", "; name the run that it was made from"),
    "rosbag": ("a bag of another program", ""),
    "run": ("a run", "; name one of its recordings"),
    "evaluation": ("an evaluation", "; name one of its recordings"),
    "dataset": ("a LeRobot dataset", "; name the run that it was made from"),
    "recordings": ("a folder of recordings", "; name one of them"),
}
"""What each kind is called, and what to do where it was not expected."""
ROSBAG2 = "metadata.yaml"
"""In a folder that is a bag of rosbag2."""
BAG_SUFFIXES = (".db3", ".bag", ".mcap.zstd", ".db3.zstd")
"""Of files that are bags, beside .mcap, which may be a recording."""
OUR_METADATA = b"demorec."
"""How the names of our recordings' metadata begin."""
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
"""The file by whose presence a folder is known."""

NOT_UTF8 = "This name has bytes that are not UTF-8, which not every library can open: rename it"


@dataclass(frozen=True, kw_only=True)
class Found:
    """What a path is.

    Attributes:
        path: As it was given.
        kind: What is there.
        reason: Of "nothing" and "unreadable": why, as a sentence without its end.
        recordings: Finished recordings, in order: of a run or an evaluation those in episodes/, of any other folder
            those in itself and in episodes/; of a recording itself.
        failed: Recordings of failed attempts, in failed/.
        unfinished: What is still being recorded, or was when a process was killed, and has not been made again since:
            in the folder itself, in episodes/ and in folders of unfinished/.
    """

    path: Path
    kind: PathKind
    reason: str = ""
    recordings: tuple[Path, ...] = ()
    failed: tuple[Path, ...] = ()
    unfinished: tuple[Path, ...] = ()

    @property
    def left(self) -> str:
        """What is unfinished, and what to do about it, as a sentence without its end; "" for nothing."""
        if not self.unfinished:
            return ""
        first, count = shlex.quote(str(self.unfinished[0])), len(self.unfinished)
        what, it = ("a recording is", "it") if count == 1 else (f"{count} recordings are", "the first")
        return (
            f"{what} unfinished (being made, or left by a crash): demorec recover {first} keeps what is whole in {it}"
        )


def find(path: Path) -> Found:
    """What a path is: files are known by their first bytes, or else by their suffix, folders by what they hold.

    Raises:
        ResourceError: This machine lacks what it takes to look.
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
            return Found(path=path, kind="unreadable", reason=f"This is {irregular_kind(mode)}, no file and no folder")
        return _file(path)
    except FileNotFoundError:
        if path.is_symlink():
            return Found(path=path, kind="nothing", reason="This is a link whose target is missing")
        part = path.with_name(f"{path.name}.part")
        left = Found(path=path, kind="unfinished", unfinished=(part,) if _is_there(part) else ()).left
        return Found(
            path=path, kind="nothing", reason="; ".join(filter(None, ("There is no such file or folder", left)))
        )
    except OSError as error:
        if (lack := resource_error(error, path)) is not None:
            raise lack from error
        return Found(path=path, kind="unreadable", reason=f"This cannot be read ({error.strerror})")


def name_of(kind: PathKind) -> str:
    """What a kind is called in a sentence: "an HDF5 file"."""
    return _words(kind)[0]


def import_word(kind: PathKind) -> str:
    """Return the word after `demorec import` that stands for a kind; "" if it needs none or is not imported."""
    row = reader_rows().get(kind)
    return "" if row is None else row.word


def _words(kind: PathKind) -> tuple[str, str]:
    """Name of a kind in a sentence, and what to do where it was not expected."""
    row = reader_rows().get(kind)
    if row is None or (kind in _WORDS and not row.advice):
        return _WORDS[kind]
    return row.name, f"; {row.advice}" if row.advice else ""


def expect(path: Path, *kinds: PathKind) -> Found:
    """What a path is, if it is of one of these kinds and, as a folder of episodes, has a recording.

    Raises:
        ConfigError: It is something else, nothing, or cannot be read.
        ResourceError: As `find`.
    """
    found = find(path)
    if found.reason:
        raise ConfigError(f"{found.reason}: {found.path}")
    if found.kind not in kinds:
        taken, (name, advice) = [_words(kind)[0] for kind in kinds], _words(found.kind)
        if kinds == ("dataset",) and found.kind == "run":
            inside = path / DATASET
            advice = (
                f"; its dataset is {inside}" if _is_there(inside / INFO_PATH) else "; demorec export makes one of it"
            )
        allowed = " or ".join(filter(None, (", ".join(taken[:-1]), taken[-1])))
        raise ConfigError(f"Expected {allowed}, found {name}{advice}: {path}")
    return found


def expect_recordings(found: Found, files: Sequence[Path]) -> None:
    """Raise ConfigError when `files`, those that a command takes of what was found, are none."""
    if files:
        return
    only = " but failed attempts, in failed/" if found.failed else ""
    left = f"; {found.left}" if found.left else ""
    raise ConfigError(f"There is no finished recording in {_words(found.kind)[0]}{only}{left}: {found.path}")


def _file(path: Path) -> Found:
    with open_regular(path) as file:
        head = file.read(max(len(magic) for magic, _ in _MAGICS))
        kind: PathKind | None = "rosbag" if path.name.endswith(BAG_SUFFIXES) else _SUFFIXES.get(path.suffix)
        if kind is None:
            kind = next((kind for kind, row in reader_rows().items() if path.name.endswith(row.suffixes)), None)
        if kind != "unfinished":
            kind = next((kind for magic, kind in _MAGICS if head.startswith(magic)), kind)
        if kind == "recording" and _is_foreign(file):
            kind = "rosbag"
    if kind is None:
        reason = "The file is no recording (.mcap), HDF5 file or bag" if head else "The file is empty"
        return Found(path=path, kind="nothing", reason=reason)
    return Found(path=path, kind=kind, recordings=(path,) if kind == "recording" else ())


def _is_foreign(file: BinaryIO) -> bool:
    """Whether an MCAP file begins as others write them: with records, but without the metadata that all of ours have.

    Ours have them in front and name them again at the end, so that one damaged place makes no bag of a recording.
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
    kind = next((kind for name, kind in _MARKS if _is_there(path / name)), None)
    if kind in ("dataset", "rosbag"):
        return Found(path=path, kind=kind)
    here = _recordings_in(path) if kind is None else ()
    if kind is None and _holds_bags(path, here):
        return Found(path=path, kind="rosbag")
    recordings, failed = (*here, *_recordings_in(path / EPISODES)), _recordings_in(path / FAILED)
    made = {file.stem for file in (*recordings, *failed)}
    places = [path, path / EPISODES]
    with suppress(OSError):
        places += _entries(path / UNFINISHED)
    parts: list[Path] = []
    for place in places:
        with suppress(OSError):  # what cannot be seen of these is no reason to refuse the rest
            parts += [file for file in _entries(place) if file.name.endswith(".mcap.part")]
    unfinished = tuple(p for p in parts if not {p.name.removesuffix(".mcap.part"), p.name.partition(".")[0]} & made)
    found = Found(path=path, kind=kind or "recordings", recordings=recordings, failed=failed, unfinished=unfinished)
    if kind is None and not recordings and not failed:
        return replace(found, kind="nothing", reason=_nothing_in(found, entries))
    return found


def _holds_bags(path: Path, recordings: Sequence[Path]) -> bool:
    """Whether a folder holds bags: as files, or as folders of rosbag2."""
    if recordings:
        with suppress(OSError, ValueError), open_regular(recordings[0]) as file:
            return _is_foreign(file)
        return False
    return any(entry.name.endswith(BAG_SUFFIXES) or _is_there(entry / ROSBAG2) for entry in _entries(path))


def _is_there(path: Path) -> bool:
    """Whether there is anything of that name; OSError when that cannot be seen."""
    try:
        path.lstat()
    except (FileNotFoundError, NotADirectoryError):
        return False
    return True


def _recordings_in(folder: Path) -> tuple[Path, ...]:
    return tuple(path for path in _entries(folder) if path.suffix == ".mcap")


def _entries(folder: Path) -> tuple[Path, ...]:
    """What is in a folder, in order; nothing where there is none."""
    try:
        return tuple(sorted(folder.iterdir()))
    except (FileNotFoundError, NotADirectoryError):
        return ()


def _nothing_in(found: Found, entries: Sequence[str]) -> str:
    """Why a folder is taken for nothing, with what may have been meant."""
    reason = f"The folder holds no recording (*.mcap), run ({RUN_NAME}) or dataset ({INFO_PATH})"
    if found.left:
        return f"{reason}; {found.left}"
    path = found.path
    for what, marks in (("runs", (RUN_NAME, EPISODES)), ("datasets", (INFO_PATH,))):
        if below := sorted(name for name in entries if any(_is_there(path / name / mark) for mark in marks)):
            return f"{reason}; it holds {what}, name one ({shown(below)})"
    return reason
