"""Bags: MCAP, .db3 and ROS 1 .bag files, and the folders of rosbag2 with their metadata.yaml, compressed or not.

A file's format is determined by its first bytes, not by its name. A bag is read from start to end for each call of
`messages`, with one chunk in memory.
"""

from __future__ import annotations

import os
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePath

import zstandard

from demorec.core.errors import ConfigError, describe_error, resource_error
from demorec.core.files import MCAP_MAGIC, open_regular, read_text_limited
from demorec.core.replacing import is_utf8
from demorec.extensions.imports.bag_files import (
    MAX_TIME_NS,
    BagError,
    Report,
    Topics,
    read_mcap,
    read_ros1,
    read_sqlite,
)
from demorec.extensions.imports.words import in_natural_order
from demorec.extensions.recovery.scan import ScannedMessage
from demorec.runs.find import BAG_SUFFIXES, NOT_UTF8, ROS1_MAGIC, ROSBAG2, SQLITE_MAGIC, find, import_word, name_of

NS = 1_000_000_000
_SUFFIXES = (".mcap", *BAG_SUFFIXES)
"""Suffixes of bag files in a folder; other files are ignored."""
_MAX_METADATA_BYTES = 16 << 20
_MAX_PROBLEMS = 100
_MAX_UNPACKED_RATIO = 1000
"""Maximum ratio of decompressed to compressed size, to protect the disk."""
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_READERS = {MCAP_MAGIC: read_mcap, SQLITE_MAGIC: read_sqlite, ROS1_MAGIC: read_ros1}
Files = tuple[tuple[str, str], ...]
"""Name and SHA-256, hex digits, of each file of a bag."""


@dataclass(frozen=True, kw_only=True)
class Bag:
    """A recording of another robot: a file, or a folder of rosbag2.

    Attributes:
        files: Files that hold its messages, in order.
        messages_are_compressed: Whether each message is compressed separately (rosbag2's compression mode MESSAGE).
    """

    path: Path
    files: tuple[Path, ...]
    messages_are_compressed: bool = False

    @property
    def name(self) -> str:
        """Name of the file or folder, without suffixes."""
        return self.path.name.split(".")[0] if self.path.is_file() else self.path.name

    @property
    def num_bytes(self) -> int:
        """Size of its files."""
        return sum(file.stat().st_size for file in self.files)

    def messages(self, problems: list[str], topics: Topics = None) -> Iterator[ScannedMessage]:
        """Read its messages, file after file.

        Args:
            problems: Collects, without duplicates, a reason for each file that cannot be read completely and each
            message left out.
            topics: Selected topics (None: all).

        Raises:
            BagError: A file cannot be read at all.
        """
        for path in self.files:

            def report(reason: str, name: str = path.name) -> None:
                problem = f"{name}: {reason}"
                if len(problems) < _MAX_PROBLEMS and problem not in problems:
                    problems.append(problem)

            with _unpacked(path) as (plain, magic):
                for message in _READERS[magic](plain, topics, report):
                    if not 0 <= message.log_ns < MAX_TIME_NS:
                        report(f"a message of {message.channel.topic} was recorded at no possible time")
                        continue
                    yield _unpacked_message(message, report) if self.messages_are_compressed else message


def _unpacked_message(message: ScannedMessage, report: Report) -> ScannedMessage:
    try:
        return message._replace(data=zstandard.ZstdDecompressor().decompressobj().decompress(message.data))
    except zstandard.ZstdError as error:
        report(f"a message of {message.channel.topic} cannot be decompressed: {error}")
        return message._replace(data=b"")


def bags_in(path: Path) -> list[Path]:
    """The bag at a path, or, for a folder without metadata.yaml, the bags in it, in natural order of their names.

    These are rosbag2 folders, MCAP, .db3 and .bag files, and such files in subfolders that lost their metadata.yaml.
    Without any of them, it is the folder itself.
    """
    if not path.is_dir() or os.path.lexists(path / ROSBAG2) or import_word(find(path).kind):
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
    """Open the bag at a path without reading its messages.

    Raises:
        ConfigError: The path is missing, or is a dataset.
        BagError: Its format is not supported.
    """
    try:
        mode = path.stat().st_mode
    except OSError as error:
        raise resource_error(error, path) or ConfigError(f"No readable bag ({error.strerror}): {path}") from error
    if not is_utf8(path):
        raise ConfigError(f"{NOT_UTF8}: {path}")
    if stat.S_ISDIR(mode):
        return _folder(path)
    _magic_of(path)
    return Bag(path=path, files=(path,))


def _magic_of(path: Path) -> bytes:
    """First bytes of a file, which determine its format: a key of `_READERS`, or zstd's."""
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
    _refuse_other_formats(path)
    what = "This is not an MCAP file" if path.suffix == ".mcap" else "This is not a bag"
    raise BagError(f"{what}: MCAP, .db3 and .bag files and rosbag2 folders are supported: {path}")


def _refuse_other_formats(path: Path) -> None:
    """Raise ConfigError for a format with another subcommand of `demorec import`."""
    kind = find(path).kind
    if word := import_word(kind):
        raise ConfigError(
            f"This is {name_of(kind)}, not a bag: demorec import {word} {path} imports it: {path}"
        ) from None


def _folder(path: Path) -> Bag:
    """Open a rosbag2 folder by its metadata.yaml."""
    from ruamel.yaml import YAML

    metadata = path / ROSBAG2
    try:
        _refuse_link(metadata)
        information = YAML(typ="safe").load(read_text_limited(metadata, _MAX_METADATA_BYTES))[
            "rosbag2_bagfile_information"
        ]
        names = [PurePath(str(name)).name for name in information["relative_file_paths"]]
        mode = str(information.get("compression_mode") or "").lower()
        compression = str(information.get("compression_format") or "")
    except FileNotFoundError:
        _refuse_other_formats(path)
        raise BagError(
            f"The folder holds no {ROSBAG2}, so it is not a rosbag2 bag, and no bags (rosbag2 folders, "
            f"{', '.join('*' + suffix for suffix in _SUFFIXES)}): {path}"
        ) from None
    except (BagError, MemoryError):
        raise
    except Exception as error:  # the parser's own errors, and unforeseen ones
        raise resource_error(error, path) or BagError(
            f"The bag's {ROSBAG2} cannot be read ({describe_error(error)}): {path}"
        ) from error
    if mode not in ("", "none") and compression != "zstd":
        raise BagError(f"The bag is compressed with {compression[:40]!r}, only zstd is supported: {path}")
    if not names:
        raise BagError(f"The bag's {ROSBAG2} names no files: {path}")
    files = tuple(path / name for name in dict.fromkeys(names))
    for file in files:
        if not os.path.lexists(file):
            raise BagError(f"The bag lacks its file {file.name[:80]}: {path}")
        _refuse_link(file)
        _magic_of(file)
    return Bag(path=path, files=files, messages_are_compressed=mode == "message")


def _refuse_link(file: Path) -> None:
    """Raise BagError for a link to a file outside the bag's folder, which the user did not name."""
    if file.is_symlink() and file.resolve().parent != file.parent.resolve():
        raise BagError(f"The bag's file is a link to another folder: name {file.name} itself, or copy it: {file}")


@contextmanager
def _unpacked(path: Path) -> Iterator[tuple[Path, bytes]]:
    """Yield a file and its first bytes; a compressed one is decompressed to a temporary file."""
    magic = _magic_of(path)
    if magic != _ZSTD_MAGIC:
        yield path, magic
        return
    with tempfile.TemporaryDirectory(prefix="demorec-bag-") as folder:
        plain = Path(folder) / path.stem
        try:
            _unpack(path, plain)
        except (zstandard.ZstdError, ValueError) as error:
            raise BagError(f"The bag cannot be decompressed ({error}): {path}") from error
        kind = _magic_of(plain)
        if kind == _ZSTD_MAGIC:
            raise BagError(f"The bag is compressed twice: {path}")
        yield plain, kind


def _unpack(path: Path, target: Path) -> None:
    """Decompress a file; ValueError if its content is far larger than any bag's."""
    most = _MAX_UNPACKED_RATIO * path.stat().st_size
    with open_regular(path) as source, target.open("wb") as file:
        for block in zstandard.ZstdDecompressor().read_to_iter(source):
            file.write(block)
            if file.tell() > most:
                raise ValueError(f"it is more than {_MAX_UNPACKED_RATIO} times as large")


@dataclass(kw_only=True)
class TopicSummary:
    """The messages of one topic.

    Attributes:
        type: Type of the messages, as the bag names it.
        count: Number of messages.
        first_ns, last_ns: Earliest and latest log time above 0.
        num_at_0: Number of messages with log time 0.
    """

    type: str
    count: int = 0
    first_ns: int = MAX_TIME_NS
    last_ns: int = 0
    num_at_0: int = 0

    @property
    def rate_hz(self) -> float:
        """Mean rate by log times; 0 for fewer than two messages."""
        span_s = (self.last_ns - self.first_ns) / NS
        return (self.count - self.num_at_0 - 1) / span_s if span_s > 0 else 0.0

    def add(self, time_ns: int) -> None:
        """Count a message with this log time."""
        self.count += 1
        if time_ns == 0:
            self.num_at_0 += 1
        else:
            self.first_ns, self.last_ns = min(self.first_ns, time_ns), max(self.last_ns, time_ns)
