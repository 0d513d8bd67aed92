"""The files of bags, MCAP and the .db3 of rosbag2, as messages: read from the front, in bounded memory and time.

An MCAP file may be chunked or not, with or without an index, whole or cut off. A table of SQLite is a program, too:
columns that are generated, views, virtual tables and triggers compute. Plain tables of the expected columns alone are
read, and no value or sum of values is larger than the file that is said to hold it."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any
from urllib.parse import quote

from demorec.core.errors import DemorecError, describe_error, resource_error
from demorec.core.files import MCAP_MAGIC, open_regular
from demorec.mcap.limits import LimitError, Unpacked
from demorec.mcap.scan import MAX_CHANNELS, MAX_SCHEMA_BYTES, CutOffError, ScannedChannel, ScannedMessage, scan

MAX_TIME_NS = 1 << 62
"""Of a message, in the year 2116: the difference of two fits 64 bits."""


class BagError(DemorecError):
    """A bag cannot be read, or does not hold what its mapping says."""


def read_mcap(path: Path, tell: Callable[[str], None], unpacked: Unpacked) -> Iterator[ScannedMessage]:
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
        file.seek(len(MCAP_MAGIC))
        try:
            for item in scan(file, unpacked):
                if isinstance(item, ScannedMessage):
                    yield item
        except MemoryError as error:
            raise resource_error(error, path) or error from error
        except Exception as error:
            is_own = isinstance(error, LimitError | CutOffError)
            tell(str(error) if is_own else f"a record is damaged: {describe_error(error)}")


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


def read_sqlite(path: Path, tell: Callable[[str], None], unpacked: Unpacked) -> Iterator[ScannedMessage]:
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
                if num_bytes > size:  # pages that several others claim
                    raise sqlite3.DatabaseError("it gives more than it holds")
                unpacked.add(0, 1)
                if topic_id not in channels or not isinstance(log_ns, int) or not isinstance(data, bytes):
                    tell("a message has no topic, time or content")
                    continue
                yield ScannedMessage(channels[topic_id], log_ns, data)
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


def _channels(database: sqlite3.Connection, path: Path) -> dict[int, ScannedChannel]:
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
    channels: dict[int, ScannedChannel] = {}
    for number, topic, kind, serialisation in _rows(database, "topics", path):
        if not isinstance(number, int) or not isinstance(topic, str) or not isinstance(kind, str):
            raise BagError(f"The bag is damaged (a topic has no number, name or type): {path}")
        if len(channels) >= MAX_CHANNELS:
            raise BagError(f"The bag has more than {MAX_CHANNELS:,} topics: {path}")
        encoding, definition = definitions.get(kind, ("", b""))
        channels[number] = ScannedChannel(
            topic=topic,
            type=kind,
            encoding=serialisation if isinstance(serialisation, str) and serialisation else "cdr",
            schema_encoding=encoding,
            schema=definition,
        )
    return channels
