"""Messages of bag files: MCAP by the reader of recordings, SQLite (.db3) and ROS 1 (.bag) by `rosbags`."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote

from demorec.core.errors import DemorecError, describe_error
from demorec.core.files import MCAP_MAGIC, open_regular
from demorec.extensions.recovery.scan import CutOffError, ScannedChannel, ScannedMessage, scan

MAX_TIME_NS = 1 << 62
"""Maximum time of a message, in the year 2116: the difference of two fits 64 bits."""
Topics = Collection[str] | None
"""Selected topics; None: all."""
Report = Callable[[str], None]
"""Called with the reason, as a sentence part, if part of a file cannot be read."""


class BagError(DemorecError):
    """A bag cannot be read, or lacks content that its mapping names."""


def read_mcap(path: Path, topics: Topics, report: Report) -> Iterator[ScannedMessage]:
    """Read an MCAP file in file order: with or without chunks and an index, complete or truncated.

    `mcap`'s own readers create an object for each field's bytes, which makes an import 10 % slower.
    """
    with open_regular(path) as file:
        file.seek(len(MCAP_MAGIC))
        try:
            for item in scan(file):
                if isinstance(item, ScannedMessage) and (topics is None or item.channel.topic in topics):
                    yield item
        except MemoryError:
            raise
        except Exception as error:  # the parsers' own errors have no other common base class
            report(str(error) if isinstance(error, CutOffError) else f"a record is damaged: {describe_error(error)}")


def read_sqlite(path: Path, topics: Topics, report: Report) -> Iterator[ScannedMessage]:
    """Read a rosbag2 .db3 file in the order of log times; BagError if it is damaged."""
    from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

    journal = Path(f"{path}-wal")
    if journal.is_file() and journal.stat().st_size:
        report(f"messages in {journal.name} are not read: open a copy of the bag with sqlite3, which takes them in")
    reader = Sqlite3Reader(Path(quote(str(path.resolve()))))  # which becomes a URI
    try:
        reader.open()
    except (MemoryError, OSError):
        raise
    except Exception as error:  # its own errors, and unforeseen ones
        raise BagError(f"The bag is damaged ({describe_error(error).rstrip('.')}): {path}") from error
    yield from _rosbags_messages(reader, topics, report)


def read_ros1(path: Path, topics: Topics, report: Report) -> Iterator[ScannedMessage]:
    """Read a ROS 1 bag in the order of log times, or in file order if its index is missing."""
    from rosbags.rosbag1 import Reader

    reader = Reader(path)
    try:
        reader.open()
    except (MemoryError, OSError):
        raise
    except Exception as error:  # its own errors, and unforeseen ones
        report(f"it was not finished ({describe_error(error).rstrip('.')}), so it is read without its index")
        from demorec.extensions.imports.ros1_scan import scan_ros1

        channels: dict[int, ScannedChannel] = {}
        for connection, time_ns, data in scan_ros1(path, report):
            if topics is None or connection.topic in topics:
                channel = channels.get(connection.id) or channels.setdefault(connection.id, _channel(connection))
                yield ScannedMessage(channel, time_ns, data)
        return
    yield from _rosbags_messages(reader, topics, report)


def _rosbags_messages(reader: Any, topics: Topics, report: Report) -> Iterator[ScannedMessage]:
    """Read the messages of an open `rosbags` reader, and close it."""
    try:
        wanted = [connection for connection in reader.connections if topics is None or connection.topic in topics]
        channels = {connection.id: _channel(connection) for connection in wanted}
        for connection, time_ns, data in reader.messages(wanted) if wanted else ():
            yield ScannedMessage(channels[connection.id], time_ns, data)
    except MemoryError:
        raise
    except Exception as error:
        report(f"it is damaged: {describe_error(error)}")
    finally:
        reader.close()


def _channel(connection: Any) -> ScannedChannel:
    """Channel of a `rosbags` connection."""
    encoding = getattr(connection.ext, "serialization_format", "ros1")
    kind = connection.msgdef.format.name
    return ScannedChannel(
        topic=connection.topic,
        type=connection.msgtype,
        encoding=encoding or "cdr",
        schema_encoding="ros1msg" if encoding == "ros1" else {"MSG": "ros2msg", "NONE": ""}.get(kind, kind),
        schema=connection.msgdef.data.encode(),
    )
