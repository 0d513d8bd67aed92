"""MCAP files of any writer, read from the front: chunked or not, with or without an index, whole or cut off.

One way of reading serves all of them, and needs no more memory than a chunk. What is read is bounded as in our own
recordings (`demorec.mcap.limits`).
"""

from __future__ import annotations

import os
import struct
from collections.abc import Callable, Iterator
from pathlib import Path

from demorec.core.errors import in_words, resource_error
from demorec.core.files import MCAP_MAGIC, open_regular
from demorec.mcap.chunks import MAX_RECORD_BYTES, RECORD_HEAD, chunk_content
from demorec.mcap.limits import LimitError, Unpacked
from demorec.sources.channel import MAX_CHANNELS, MAX_SCHEMA_BYTES, BagChannel, BagError, BagMessage

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
