"""Bags: MCAP and .db3 files, and the folders of rosbag2 with their metadata.yaml, compressed or not.

What a bag is called by does not matter, what it begins with does. Reading goes from the front to the end, once for
each call of `messages`, in the memory of a chunk.
"""

from __future__ import annotations

import os
import stat
import tempfile
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any

import zstandard

from demorec.core.errors import ConfigError, resource_error
from demorec.core.files import MCAP_MAGIC, open_regular, read_text_limited, sha256_of
from demorec.mcap.limits import LimitError, Limits, Unpacked
from demorec.mcap.scan import ScannedMessage
from demorec.runs.find import BAG_SUFFIXES, IMPORT_WORDS, ROSBAG2, find, name_of
from demorec.sources.bag_files import MAX_TIME_NS, SQLITE_MAGIC, BagError, read_mcap, read_sqlite
from demorec.sources.words import in_natural_order

_SUFFIXES = (".mcap", *BAG_SUFFIXES)
"""Of files that a folder of bags holds; what else lies in it is nobody's bag."""
_MAX_METADATA_BYTES = 16 << 20
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_COPY_BYTES = 1 << 20
_MAX_EVENTS = 100_000
"""Of YAML, 25 microseconds each; a bag of 500 topics with their settings has some 40,000."""
_MAX_FILES = 10_000
_MAX_PROBLEMS = 100
Files = tuple[tuple[str, str], ...]
"""Name and SHA-256, hex digits, of each of a bag's files."""
_READERS = {MCAP_MAGIC: read_mcap, SQLITE_MAGIC: read_sqlite}


@dataclass(frozen=True, kw_only=True)
class Bag:
    """A recording of somebody else's robot: a file, or a folder of rosbag2.

    Attributes:
        files: That hold its messages, in order.
        messages_are_compressed: Whether each message is compressed by itself (rosbag2's compression mode MESSAGE).
    """

    path: Path
    files: tuple[Path, ...]
    messages_are_compressed: bool = False

    @property
    def name(self) -> str:
        """Of the file or folder, without what tells its format."""
        return self.path.name.split(".")[0] if self.path.is_file() else self.path.name

    @property
    def num_bytes(self) -> int:
        """Of its files."""
        return sum(file.stat().st_size for file in self.files)

    def sha256s(self) -> Files:
        """Of its files, by which it is known again."""
        return tuple((path.name, sha256_of(path)) for path in self.files)

    def messages(self, problems: list[str], topics: Collection[str] | None = None) -> Iterator[ScannedMessage]:
        """Its messages in the order in which they were written.

        Args:
            problems: Gets a reason for each file that cannot be read to its end, or each message that is left out; the
                same one once.
            topics: That are wanted; None: all.

        Raises:
            BagError: A file cannot be read at all.
        """
        unpacked = Unpacked(Limits.of_file(self.num_bytes))
        for path in self.files:

            def tell(reason: str, name: str = path.name) -> None:
                problem = f"{name}: {reason}"
                if len(problems) < _MAX_PROBLEMS and problem not in problems:
                    problems.append(problem)

            with _unpacked(path, unpacked) as (plain, magic):
                for message in _READERS[magic](plain, tell, unpacked):
                    if topics is not None and message.channel.topic not in topics:
                        continue
                    if not 0 <= message.log_ns < MAX_TIME_NS:
                        tell(f"a message of {message.channel.topic} was recorded at no possible time")
                        continue
                    yield self._unpack(message, tell, unpacked) if self.messages_are_compressed else message

    def _unpack(self, message: ScannedMessage, tell: Any, unpacked: Unpacked) -> ScannedMessage:
        try:
            data = b"".join(_blocks(message.data, unpacked))
        except (zstandard.ZstdError, LimitError) as error:
            tell(f"a message of {message.channel.topic} cannot be unpacked: {error}")
            data = b""
        return message._replace(data=data)


def bags_in(path: Path) -> list[Path]:
    """The bag at a path, or, of a folder without metadata.yaml, the bags in it, in the natural order of their names.

    They are rosbag2 folders, MCAP and .db3 files, and those files in folders in it whose metadata.yaml was lost. A
    folder that holds none of them is given back itself.
    """
    if not path.is_dir() or os.path.lexists(path / ROSBAG2) or find(path).kind in IMPORT_WORDS:
        return [path]
    found: list[Path] = []
    for entry in _entries(path):
        if not entry.is_dir():
            found += [entry] if entry.name.endswith(_SUFFIXES) else []
        elif os.path.lexists(entry / ROSBAG2):
            found.append(entry)
        else:
            found += [file for file in _entries(entry) if file.name.endswith(_SUFFIXES)]
    return found or [path]


def _entries(folder: Path) -> list[Path]:
    try:
        return sorted(folder.iterdir(), key=lambda path: in_natural_order(path.name))
    except OSError as error:
        raise resource_error(error, folder) or BagError(
            f"The folder cannot be read ({error.strerror}): {folder}"
        ) from error


def open_bag(path: Path) -> Bag:
    """The bag at a path; nothing of its messages is read.

    Raises:
        ConfigError: There is none, or a dataset.
        BagError: It is of no kind that is read.
    """
    try:
        mode = path.stat().st_mode
    except OSError as error:
        raise resource_error(error, path) or ConfigError(
            f"There is no bag that could be read ({error.strerror}): {path}"
        ) from error
    if stat.S_ISDIR(mode):
        return _folder(path)
    _kind_of(path)
    return Bag(path=path, files=(path,))


def _kind_of(path: Path) -> bytes:
    """The first bytes that tell what a file is: those of MCAP, SQLite or zstd."""
    try:
        with open_regular(path) as file:
            head = file.read(max(map(len, (*_READERS, _ZSTD_MAGIC))))
    except OSError as error:
        raise resource_error(error, path) or BagError(f"The bag cannot be read ({error.strerror}): {path}") from error
    if not head:
        raise BagError(f"The bag is empty: {path}")
    for magic in (*_READERS, _ZSTD_MAGIC):
        if head.startswith(magic):
            return magic
    if head.startswith(b"#ROSBAG"):
        raise BagError(
            f"This is a bag of ROS 1; rosbags-convert --src {path.name} --dst {path.stem} makes a rosbag2 folder of "
            f"it, which is read: {path}"
        )
    _refuse_other_formats(path)
    raise BagError(f"This is no bag: MCAP files, .db3 files and rosbag2 folders are read: {path}")


def _refuse_other_formats(path: Path) -> None:
    """ConfigError for what is no bag and imported by a word of its own."""
    kind = find(path).kind
    if kind in IMPORT_WORDS:
        raise ConfigError(
            f"This is {name_of(kind)}, no bag: demorec import {IMPORT_WORDS[kind]} {path} imports it: {path}"
        ) from None


def _folder(path: Path) -> Bag:
    try:
        if (path / ROSBAG2).is_symlink():
            _refuse_link(path / ROSBAG2)
        information = _plain_yaml(read_text_limited(path / ROSBAG2, _MAX_METADATA_BYTES))["rosbag2_bagfile_information"]
        names = [PurePath(str(name)).name for name in information["relative_file_paths"]]
        mode = str(information.get("compression_mode") or "").lower()
        compression = str(information.get("compression_format") or "")
    except FileNotFoundError:
        _refuse_other_formats(path)
        raise BagError(
            f"The folder holds no {ROSBAG2}, so it is no bag of rosbag2, and no bags (rosbag2 folders, "
            f"{', '.join('*' + suffix for suffix in _SUFFIXES)}): {path}"
        ) from None
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        reason = f" ({error})" if isinstance(error, LimitError) else ""
        raise resource_error(error, path) or BagError(f"The bag's {ROSBAG2} cannot be read{reason}: {path}") from error
    if mode not in ("", "none") and compression != "zstd":
        raise BagError(f"The bag is compressed with {compression[:40]!r}, only zstd is read: {path}")
    if not names:
        raise BagError(f"The bag's {ROSBAG2} names no files: {path}")
    if len(names) > _MAX_FILES or len(set(names)) < len(names):
        raise BagError(f"The bag's {ROSBAG2} names a file twice, or more than {_MAX_FILES:,}: {path}")
    files = tuple(path / name for name in names)
    if missing := [file.name for file in files if not os.path.lexists(file)]:
        raise BagError(f"The bag lacks its file {missing[0][:80]}: {path}")
    for file in files:
        _refuse_link(file)
        _kind_of(file)
    return Bag(path=path, files=files, messages_are_compressed=mode == "message")


def _refuse_link(file: Path) -> None:
    """BagError for a link out of the bag's folder: what lies elsewhere was not named by whoever gave the folder."""
    if file.is_symlink() and file.resolve().parent != file.parent.resolve():
        raise BagError(f"The bag's file is a link to another folder: name {file.name} itself, or copy it: {file}")


def _plain_yaml(text: str) -> Any:
    """Mappings, lists and texts of a YAML document: numbers and dates stay texts.

    Raises:
        ValueError: It is no YAML; LimitError for an alias, which may stand for anything any number of times, or more
            than is read.
    """
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError
    from ruamel.yaml.events import (
        AliasEvent,
        MappingEndEvent,
        MappingStartEvent,
        ScalarEvent,
        SequenceEndEvent,
        SequenceStartEvent,
    )

    root: list[Any] = []
    open_lists = [root]
    """What is begun: of mappings the keys and values in turn."""
    try:
        for number, event in enumerate(YAML(typ="safe", pure=True).parse(text)):
            if number == _MAX_EVENTS:
                raise LimitError(f"it holds more than {_MAX_EVENTS:,} values")
            if isinstance(event, AliasEvent):
                raise LimitError("it has aliases, which rosbag2 never writes")
            if isinstance(event, ScalarEvent):
                open_lists[-1].append(event.value)
            elif isinstance(event, MappingStartEvent | SequenceStartEvent):
                open_lists.append([])
            elif isinstance(event, MappingEndEvent):
                items = iter(open_lists.pop())
                open_lists[-1].append({str(key): value for key, value in zip(items, items, strict=True)})
            elif isinstance(event, SequenceEndEvent):
                items_of_list = open_lists.pop()
                open_lists[-1].append(items_of_list)
    except (YAMLError, RecursionError, IndexError) as error:
        raise ValueError("it is no YAML") from error
    return root[0] if root else None


def _blocks(source: Any, unpacked: Unpacked) -> Iterator[bytes]:
    """Unpacked bytes, block by block: unpacking at once would reserve as much memory as the data claim to need."""
    for block in zstandard.ZstdDecompressor().read_to_iter(source, write_size=_COPY_BYTES):
        unpacked.add(len(block))
        yield block


@contextmanager
def _unpacked(path: Path, unpacked: Unpacked) -> Iterator[tuple[Path, bytes]]:
    """A file and its kind; a compressed one is unpacked into a temporary file, within the limits of the bag."""
    magic = _kind_of(path)
    if magic != _ZSTD_MAGIC:
        yield path, magic
        return
    with tempfile.TemporaryDirectory(prefix="demorec-bag-") as folder:
        plain = Path(folder) / path.stem
        try:
            with open_regular(path) as source, plain.open("wb") as file:
                file.writelines(_blocks(source, unpacked))
            kind = _kind_of(plain)
        except (zstandard.ZstdError, ValueError) as error:
            raise BagError(f"The compressed bag cannot be unpacked ({error}): {path}") from error
        if kind == _ZSTD_MAGIC:
            raise BagError(f"The bag is compressed twice: {path}")
        yield plain, kind
