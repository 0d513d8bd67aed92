"""The files of bags, MCAP and the .db3 of rosbag2, as messages: read from the front, in bounded memory and time.

An MCAP file may be chunked or not, with or without an index, whole or cut off. A table of SQLite is a program, too:
columns that are generated, views, virtual tables and triggers compute. Plain tables of the expected columns alone are
read, and no value or sum of values is larger than the file that is said to hold it."""

from __future__ import annotations

import os
import sqlite3
import struct
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

from demorec.core.errors import DemorecError, in_words, resource_error
from demorec.core.files import MCAP_MAGIC, open_regular
from demorec.mcap.chunks import MAX_RECORD_BYTES, RECORD_HEAD, chunk_content
from demorec.mcap.limits import LimitError, Unpacked

MAX_SCHEMA_BYTES = 1 << 20
"""Of a message type's definition; the largest of ROS with all that it refers to have some 30 kB."""

MAX_CHANNELS = 4096
"""Of a bag; large systems have some hundred topics."""
MAX_TIME_NS = 1 << 62
"""Of a message, in the year 2116: the difference of two fits 64 bits."""


class BagError(DemorecError):
    """A bag cannot be read, or does not hold what its mapping says."""


@dataclass(frozen=True, kw_only=True)
class BagChannel:
    """Messages of one topic, type and encoding; a bag may have several channels of a topic.

    Attributes:
        topic: "/joint_states".
        type: "sensor_msgs/msg/JointState", "foxglove.CompressedImage".
        encoding: Of its messages: cdr, ros1, protobuf, json.
        schema_encoding: Of the definition: ros2msg, ros2idl, ros1msg, protobuf, jsonschema; "" for none.
        schema: The definition: data, never code.
    """

    topic: str
    type: str
    encoding: str
    schema_encoding: str
    schema: bytes


class BagMessage(NamedTuple):
    """A message as the bag has it.

    Attributes:
        channel: Of which topic and type it is.
        log_ns: When it was recorded, nanoseconds.
        data: Its bytes.
    """

    channel: BagChannel
    log_ns: int
    data: bytes


_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _DATA_END, _FOOTER = 3, 4, 5, 6, 15, 2
_MESSAGE_HEAD = struct.Struct("<HIQQ")


def read_mcap(path: Path, tell: Callable[[str], None], unpacked: Unpacked) -> Iterator[BagMessage]:
    """The messages of an MCAP file in the order of the file.

    Args:
        path: Of a file that begins with `MCAP_MAGIC`.
        tell: Called with the reason, for the inside of a sentence, when the file ends or is damaged before its end.
        unpacked: What has been unpacked of the bag.

    Raises:
        BagError: It cannot be read at all.
    """
    try:
        file = open_regular(path)
    except OSError as error:
        raise resource_error(error, path) or BagError(f"The bag cannot be read ({error.strerror}): {path}") from error
    with file:
        size = os.fstat(file.fileno()).st_size
        file.seek(len(MCAP_MAGIC))
        records = _Records(unpacked)
        while True:
            head = file.read(RECORD_HEAD.size)
            if len(head) < RECORD_HEAD.size:
                tell("it is cut off")
                return
            opcode, length = RECORD_HEAD.unpack(head)
            if opcode in (_DATA_END, _FOOTER):
                return
            if length > size - file.tell():
                tell("it is cut off within a record")
                return
            if length > MAX_RECORD_BYTES:
                tell(f"a record has {length:,} bytes")
                return
            if opcode not in (_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK):
                file.seek(length, os.SEEK_CUR)
                continue
            try:
                yield from records.read(opcode, file.read(length))
            except MemoryError as error:
                raise resource_error(error, path) or error from error
            except Exception as error:
                # The decompressors' own errors share no base class but Exception.
                if isinstance(error, BagError):
                    raise
                tell(str(error) if isinstance(error, LimitError) else f"a record is damaged: {in_words(error)}")
                return


class _Records:
    """What has been learnt from the records so far."""

    def __init__(self, unpacked: Unpacked) -> None:
        self._unpacked = unpacked
        self._schemas: dict[int, tuple[str, str, bytes]] = {0: ("", "", b"")}
        self._channels: dict[int, BagChannel] = {}

    def read(self, opcode: int, content: bytes) -> Iterator[BagMessage]:
        """The messages in a record."""
        if opcode == _MESSAGE:
            channel_id, _, log_ns, _ = _MESSAGE_HEAD.unpack_from(content)
            yield BagMessage(self._channels[channel_id], log_ns, content[_MESSAGE_HEAD.size :])
        elif opcode == _CHUNK:
            yield from self._read_chunk(content)
        elif opcode == _SCHEMA:
            self._read_schema(content)
        else:
            self._read_channel(content)

    def _read_chunk(self, content: bytes) -> Iterator[BagMessage]:
        unpacked = chunk_content(content, self._unpacked.limits)
        self._unpacked.add(len(unpacked))
        position, count, end = 0, 0, len(unpacked)
        while position < end:
            opcode, length = RECORD_HEAD.unpack_from(unpacked, position)
            start = position + RECORD_HEAD.size
            position = start + length
            if position > end:
                raise ValueError("a record that reaches beyond its chunk")
            count += 1
            if opcode == _MESSAGE:
                channel_id, _, log_ns, _ = _MESSAGE_HEAD.unpack_from(unpacked, start)
                yield BagMessage(self._channels[channel_id], log_ns, unpacked[start + _MESSAGE_HEAD.size : position])
            elif opcode in (_SCHEMA, _CHANNEL):
                yield from self.read(opcode, unpacked[start:position])
        self._unpacked.add(0, count)

    def _read_schema(self, content: bytes) -> None:
        (number,) = struct.unpack_from("<H", content)
        name, position = _string(content, 2)
        encoding, position = _string(content, position)
        (length,) = struct.unpack_from("<I", content, position)
        if length > MAX_SCHEMA_BYTES:
            raise ValueError(f"the definition of {name[:80]!r} has {length:,} bytes")
        self._schemas[number] = (name, encoding, content[position + 4 : position + 4 + length])

    def _read_channel(self, content: bytes) -> None:
        number, schema = struct.unpack_from("<HH", content)
        topic, position = _string(content, 4)
        encoding, _ = _string(content, position)
        name, schema_encoding, definition = self._schemas[schema]
        if number not in self._channels and len(self._channels) >= MAX_CHANNELS:
            raise ValueError("too many channels")
        self._channels[number] = BagChannel(
            topic=topic, type=name, encoding=encoding, schema_encoding=schema_encoding, schema=definition
        )


def _string(content: bytes, position: int) -> tuple[str, int]:
    (length,) = struct.unpack_from("<I", content, position)
    end = position + 4 + length
    if end > len(content):
        raise ValueError("a text that reaches beyond its record")
    return content[position + 4 : end].decode(), end


SQLITE_MAGIC = b"SQLite format 3\0"
_MAX_MESSAGE_BYTES = 1 << 28
_ROW_BYTES = 8
"""Of a row without its values, at least."""
_STEP = 1_000_000
"""Instructions of SQLite's machine between two looks at how many there were; a row takes some ten."""
_TABLES = {
    "topics": ("id", "name", "type", "serialization_format"),
    "messages": ("topic_id", "timestamp", "data"),
    "message_definitions": ("topic_type", "encoding", "encoded_message_definition"),
}
_ALLOWED = (sqlite3.SQLITE_SELECT, sqlite3.SQLITE_READ)


def read_sqlite(path: Path, tell: Callable[[str], None], unpacked: Unpacked) -> Iterator[BagMessage]:
    """The messages of a .db3 file in the order in which they were written; arguments and errors as `read_mcap`."""
    started = False
    try:
        size = path.stat().st_size
        address = f"file:{quote(str(path.resolve()))}?mode=ro&immutable=1"
        with closing(sqlite3.connect(address, uri=True)) as database:
            _restrict(database, size)
            channels = _channels(database, path)
            if (journal := Path(f"{path}-wal")).is_file() and journal.stat().st_size:
                tell(
                    f"messages in {journal.name} are not read: open a copy of the bag with sqlite3, which takes them in"
                )
            # In the order of writing, which shows what came too late; it needs no sorting in memory either.
            num_bytes = 0
            for topic_id, log_ns, data in _rows(database, "messages", path, " ORDER BY rowid"):
                started = True
                num_bytes += _ROW_BYTES + (len(data) if isinstance(data, bytes | str) else 0)
                if num_bytes > size:  # pages that are told to belong to several others
                    raise sqlite3.DatabaseError("it gives more than it holds")
                unpacked.add(0, 1)
                if topic_id not in channels or not isinstance(log_ns, int) or not isinstance(data, bytes):
                    tell("a message has no topic, time or content")
                    continue
                yield BagMessage(channels[topic_id], log_ns, data)
    except (sqlite3.Error, OverflowError, LimitError, OSError) as error:
        if not started:
            raise BagError(f"The bag is damaged ({error}): {path}") from error
        tell(f"it is cut off or damaged: {error}")


def _restrict(database: sqlite3.Connection, size: int) -> None:
    """Let a database read its own tables, and nothing else, within bounds of memory and time."""
    database.text_factory = lambda text: text.decode(errors="replace")
    database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, min(_MAX_MESSAGE_BYTES, max(size, 1 << 16)))
    for pragma in ("trusted_schema = OFF", "query_only = ON", "temp_store = MEMORY", "cache_size = -8192"):
        database.execute(f"PRAGMA {pragma}")
    calls = 0

    def progress() -> bool:
        nonlocal calls
        calls += 1
        return calls * _STEP > 10 * _STEP + 10 * size

    def may(action: int, *what: Any) -> int:
        is_table_info = action == sqlite3.SQLITE_PRAGMA and what[0] == "table_xinfo"
        return sqlite3.SQLITE_OK if is_table_info or action in _ALLOWED else sqlite3.SQLITE_DENY

    database.set_progress_handler(progress, _STEP)
    database.set_authorizer(may)


def _rows(database: sqlite3.Connection, table: str, path: Path, order: str = "") -> Iterator[tuple[Any, ...]]:
    """The expected columns of a table; none where it is missing. BagError unless it is a plain one."""
    found = database.execute("SELECT type, rootpage FROM sqlite_master WHERE name = ?", (table,)).fetchone()
    if found is None:
        return
    columns = {row[1].lower(): row[6] for row in database.execute(f"PRAGMA table_xinfo({table})")}
    if found[0] != "table" or not found[1] or any(columns.values()) or "rowid" in columns:
        raise BagError(f"The bag's table {table!r} computes what it holds, so it is none of rosbag2: {path}")
    yield from database.execute(f"SELECT {', '.join(_TABLES[table])} FROM {table}{order}")


def _channels(database: sqlite3.Connection, path: Path) -> dict[int, BagChannel]:
    tables = {name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
    if missing := {"topics", "messages"} - tables:
        raise BagError(f"The bag has no table {min(missing)!r}, so it is none of rosbag2: {path}")
    definitions: dict[str, tuple[str, bytes]] = {}
    for name, encoding, text in _rows(database, "message_definitions", path):
        if not isinstance(name, str) or not isinstance(encoding, str) or not isinstance(text, str):
            continue
        if len(text) > MAX_SCHEMA_BYTES or len(definitions) >= MAX_CHANNELS:
            raise BagError(f"The definition of the type {name[:80]!r} has {len(text):,} bytes: {path}")
        definitions[name] = (encoding, text.encode())
    channels: dict[int, BagChannel] = {}
    for number, topic, kind, serialisation in _rows(database, "topics", path):
        if not isinstance(number, int) or not isinstance(topic, str) or not isinstance(kind, str):
            raise BagError(f"The bag is damaged (a topic has no number, name or type): {path}")
        if len(channels) >= MAX_CHANNELS:
            raise BagError(f"The bag has more than {MAX_CHANNELS:,} topics: {path}")
        encoding, definition = definitions.get(kind, ("", b""))
        channels[number] = BagChannel(
            topic=topic,
            type=kind,
            encoding=serialisation if isinstance(serialisation, str) and serialisation else "cdr",
            schema_encoding=encoding,
            schema=definition,
        )
    return channels
