"""The .db3 files of rosbag2: SQLite databases of serialised messages, read without trusting what they define."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from urllib.parse import quote

from demorec.ingest.channel import MAX_SCHEMA_BYTES, BagChannel, BagError, BagMessage

SQLITE_MAGIC = b"SQLite format 3\0"
_MAX_MESSAGE_BYTES = 1 << 28


def read_sqlite(path: Path, tell: Callable[[str], None]) -> Iterator[BagMessage]:
    """The messages of a .db3 file in the order in which they were written; arguments and errors as `read_mcap`."""
    started = False
    try:
        address = f"file:{quote(str(path.resolve()))}?mode=ro&immutable=1"
        with closing(sqlite3.connect(address, uri=True)) as database:
            database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _MAX_MESSAGE_BYTES)
            database.execute("PRAGMA trusted_schema = OFF")
            channels = _channels(database, path)
            # In the order of writing, which shows what came too late; it needs no sorting in memory either.
            for topic_id, log_ns, data in database.execute(
                "SELECT topic_id, timestamp, data FROM messages ORDER BY rowid"
            ):
                started = True
                if topic_id not in channels or not isinstance(log_ns, int) or not isinstance(data, bytes):
                    tell("a message has no topic, time or content")
                    continue
                yield BagMessage(channels[topic_id], log_ns, data)
    except (sqlite3.Error, OverflowError, UnicodeDecodeError) as error:
        if not started:
            raise BagError(f"The bag is damaged ({error}): {path}") from error
        tell(f"it is cut off or damaged: {error}")


def _channels(database: sqlite3.Connection, path: Path) -> dict[int, BagChannel]:
    # A view of that name could compute for ever.
    tables = {name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
    if missing := {"topics", "messages"} - tables:
        raise BagError(f"The bag has no table {min(missing)!r}, so it is none of rosbag2: {path}")
    definitions: dict[str, tuple[str, bytes]] = {}
    if "message_definitions" in tables:
        for name, encoding, text in database.execute(
            "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
        ):
            if len(text) > MAX_SCHEMA_BYTES:
                raise BagError(f"The definition of the type {str(name)[:80]!r} has {len(text):,} bytes: {path}")
            definitions[str(name)] = (str(encoding), str(text).encode())
    channels = {}
    for number, topic, kind, serialisation in database.execute(
        "SELECT id, name, type, serialization_format FROM topics"
    ):
        encoding, definition = definitions.get(str(kind), ("", b""))
        channels[int(number)] = BagChannel(
            topic=str(topic),
            type=str(kind),
            encoding=str(serialisation) or "cdr",
            schema_encoding=encoding,
            schema=definition,
        )
    return channels
