"""Scan a ROS 1 bag without an index from its start as far as possible, with `rosbags`' record parsers.

Format: http://wiki.ros.org/Bags/Format/2.0
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

from rosbags.interfaces import Connection
from rosbags.rosbag1.reader import Header, Reader, ReaderError, RecordType, decompressors, read_uint32

from demorec.core.errors import describe_error
from demorec.core.files import open_regular

_UNCOMPRESSED = "none"


def scan_ros1(path: Path, report: Callable[[str], None]) -> Iterator[tuple[Connection, int, bytes]]:
    """Read a bag's messages in file order: connection, log time and bytes of each.

    Args:
        path: The bag.
        report: Called with the reason if the bag is truncated or damaged; nothing after that place is read.
    """
    reader = Reader(path)
    with open_regular(path) as file:
        file.readline()  # "#ROSBAG V2.0"
        try:
            yield from _records(file, reader, {}, report)
        except MemoryError:
            raise
        except Exception as error:  # decompressors raise their own errors
            report(f"it is damaged or cut off ({describe_error(error).rstrip('.')})")


def _records(
    file: BinaryIO, reader: Reader, connections: dict[int, Connection], report: Callable[[str], None]
) -> Iterator[tuple[Connection, int, bytes]]:
    """Read the records of a file, or of a chunk in memory; ReaderError if one is incomplete."""
    while True:
        place = file.tell()
        if not file.read(1):
            return
        file.seek(place)
        header = Header.read(file)
        kind = header.get_uint8("op")
        if kind == RecordType.CONNECTION:
            file.seek(place)
            reader.bio = file
            connection = reader.read_connection()
            connections[connection.id] = connection
            continue
        size = read_uint32(file)
        data = file.read(size)
        if kind == RecordType.CHUNK:
            compression = header.get_string("compression")
            if len(data) < size:
                report(f"it is cut off within a chunk, of which {len(data):,} of {size:,} bytes are there")
                if compression != _UNCOMPRESSED:
                    return
            yield from _records(BytesIO(decompressors[compression](data)), reader, connections, report)
        elif len(data) < size:
            raise ReaderError(f"Got only {len(data)} of requested {size} bytes.")
        elif kind == RecordType.MSGDATA and (number := header.get_uint32("conn")) in connections:
            yield connections[number], header.get_time("time"), data
