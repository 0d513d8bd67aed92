"""The pages of a Parquet file, by their headers: what each unpacks to is known before anything is unpacked.

The footer says it as well, but nothing holds it to that: a reader makes room for what the page's own header says. And
one text of a dictionary stands for any number of values, all of which a reader writes out.
Format: github.com/apache/parquet-format, PageHeader in Thrift's compact protocol; Encodings for the levels.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, BinaryIO, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

_MAX_HEADER_BYTES = 64 << 10
"""Of one page: some numbers, and its lowest and highest value."""
_MAX_NESTED = 8
_DICTIONARY = 2
"""Kind of a page."""
_TRUE, _FALSE, _BYTE, _DOUBLE, _BINARY, _LIST, _SET, _STRUCT = 1, 2, 3, 7, 8, 9, 10, 12
_LENGTHS = {_TRUE: 1, _FALSE: 1, _BYTE: 1, _DOUBLE: 8}


class Page(NamedTuple):
    """One page: what it holds, the bytes that it unpacks to, and where they are in the file.

    Of a page of the second version `levels` is the length of its levels, which are not compressed.
    """

    is_dictionary: bool
    num_bytes: int
    begin: int
    end: int
    num_values: int
    levels: int | None = None


def pages_of(file: BinaryIO, column: pq.ColumnChunkMetaData) -> Iterator[Page]:
    """The pages of one column of one row group; ValueError when their headers are none."""
    starts = [column.data_page_offset, column.dictionary_page_offset if column.has_dictionary_page else None]
    place = min(start for start in starts if start)  # 0 is where the file's mark is
    end = place + column.total_compressed_size
    while place < end:
        file.seek(place)
        header = _Compact(file.read(min(_MAX_HEADER_BYTES, end - place)))
        fields = header.struct()
        kind, unpacked, packed = (fields.get(number) for number in (1, 2, 3))
        if not isinstance(kind, int) or not isinstance(unpacked, int) or not isinstance(packed, int):
            raise ValueError("a page without its size")
        if unpacked < 0 or packed < 0:
            raise ValueError("a page of a size below 0")
        place += header.at
        head = fields.get(5) or fields.get(8) or {}
        levels = None if 8 not in fields else fields[8].get(6)
        num_values = head.get(1) or 0
        if not 0 <= num_values <= column.num_values and kind != _DICTIONARY:
            raise ValueError("a page of more values than its column")
        yield Page(kind == _DICTIONARY, unpacked, place, place + packed, num_values, levels)
        place += packed


def longest_row(file: BinaryIO, column: pq.ColumnChunkMetaData, depth: int) -> int:
    """The most bytes of text that one row of a column of lists may have, by its longest text and its longest list.

    Args:
        file: The Parquet file.
        column: One column of one row group, of texts.
        depth: How many lists are within each other (the column's highest repetition level).

    Raises:
        ValueError: The pages are damaged.
    """
    text = values = since = 0
    for page in pages_of(file, column):
        file.seek(page.begin)
        data = file.read(page.end - page.begin)
        if page.levels is None and column.compression != "UNCOMPRESSED":
            codec = {"LZ4": "lz4_raw"}.get(column.compression, column.compression.lower())
            data = pa.decompress(data, page.num_bytes, codec=codec, asbytes=True)
        if page.is_dictionary:
            text = max(text, _longest_text(data))
            continue
        length = int.from_bytes(data[:4], "little") if page.levels is None else page.levels
        begin = 4 if page.levels is None else 0
        # A value of level 0 begins a row.
        rows = np.flatnonzero(_levels(data[begin : begin + length], depth.bit_length(), page.num_values) == 0)
        if len(rows):
            values = max(values, since + int(rows[0]), int(np.diff(rows).max(initial=0)))
            since = -int(rows[-1])
        since += page.num_values
    return text * max(values, since)


def _longest_text(data: bytes) -> int:
    """Of a dictionary of texts, each of which has its length in front."""
    place = longest = 0
    while place < len(data):
        length = int.from_bytes(data[place : place + 4], "little")
        longest, place = max(longest, length), place + 4 + length
    return longest


def _levels(data: bytes, width: int, count: int) -> NDArray[np.uint8]:
    """Runs of one level, and levels of `width` bits packed by eight, one after the other."""
    reader, found, num_found = _Compact(data), [np.zeros(0, np.uint8)], 0
    while num_found < count:
        head = reader.varint()
        if head & 1:
            packed = np.frombuffer(data, np.uint8, min((head >> 1) * width, len(data) - reader.at), reader.at)
            reader.at += len(packed)
            bits = np.unpackbits(packed, bitorder="little")
            run = bits[: len(bits) // width * width].reshape(-1, width).max(axis=1)  # only whether it is 0 matters
        else:
            run = np.full(min(head >> 1, count - num_found), reader.byte(), np.uint8)
        if not len(run):
            raise ValueError("levels that end too early")
        found.append(run)
        num_found += len(run)
    return np.concatenate(found)[:count]


class _Compact:
    """Thrift's compact protocol, as far as page headers need it: whole numbers, structures, and what is skipped."""

    def __init__(self, data: bytes) -> None:
        self._data, self.at = data, 0

    def struct(self, depth: int = 0) -> dict[int, Any]:
        """Number of a field -> its whole number, or the fields of a structure; None for one of any other kind."""
        fields: dict[int, Any] = {}
        number = 0
        while head := self.byte():
            step, kind = head >> 4, head & 15
            number = number + step if step else self._zigzag()
            fields[number] = kind if kind in (_TRUE, _FALSE) else self._value(kind, depth)
        return fields

    def _value(self, kind: int, depth: int) -> int | dict[int, Any] | None:
        if depth > _MAX_NESTED:
            raise ValueError("a page's header is nested too deeply")
        if _BYTE < kind < _DOUBLE:  # of 16, 32 and 64 bits
            return self._zigzag()
        if kind == _STRUCT:
            return self.struct(depth + 1)
        if kind in (_LIST, _SET):
            head = self.byte()
            count = head >> 4 if head >> 4 < 15 else self.varint()
            if count > len(self._data) - self.at:  # each takes a byte at least
                raise ValueError("a page's header is cut off")
            for _ in range(count):
                self._value(head & 15, depth + 1)
        else:
            length = self.varint() if kind == _BINARY else _LENGTHS[kind]
            self.at += length
        return None

    def _zigzag(self) -> int:
        found = self.varint()
        return (found >> 1) ^ -(found & 1)

    def varint(self) -> int:
        found = shift = 0
        while True:
            byte = self.byte()
            found |= (byte & 127) << shift
            shift += 7
            if byte < 128:
                return found
            if shift > 63:
                raise ValueError("a whole number without end in a page's header")

    def byte(self) -> int:
        self.at += 1
        return self._data[self.at - 1]
