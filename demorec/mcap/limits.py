"""How much a recording may unpack to, so that no small file fills the memory or takes minutes.

Compression knows no bound by itself: zstd turns gigabytes of zeros into kilobytes, and a record of nothing takes nine
bytes before it. The limits grow with the file, and small files have a floor, `DEMOREC_UNPACKED_MB` (default 64).

Calibrated on our own writer, whose chunks are those of Foxglove's, a megabyte and what the last message adds. The
sample recording unpacks to 2.3 times its size; a robot that stands still before cameras that see nothing, JPEG, to 27
times at 640x480 and 152 times at 1920x1080, single chunks of it to 942 times. A message takes 29 bytes of the file
at least, 16 of them as an entry of a Message Index, which no compression makes smaller.
"""

from __future__ import annotations

import os
from dataclasses import dataclass

from demorec.core.errors import ConfigError

VARIABLE = "DEMOREC_UNPACKED_MB"
_DEFAULT_MB = 64
_RATIO = 200
_CHUNK_RATIO = 32
"""Of a chunk that is larger than the floor: it holds a message of about that size, say a raw point cloud."""
_MIN_RECORDS = 500_000
_BYTES_PER_RECORD = 16


class LimitError(ValueError):
    """A file would unpack to more than is allowed, or a message holds more; `str` is the reason and what to do."""


@dataclass(frozen=True, kw_only=True)
class Limits:
    """What a file may unpack to.

    Attributes:
        floor: Bytes that any file, and any chunk, may unpack to.
        total: Bytes of all its chunks.
        records: Of all its chunks.
    """

    floor: int
    total: int
    records: int

    @classmethod
    def of_file(cls, size: int) -> Limits:
        """Those of a file of `size` bytes; ConfigError when the environment variable is no number of megabytes."""
        text = os.environ.get(VARIABLE, str(_DEFAULT_MB))
        if not text.isascii() or not text.isdigit() or not 1 <= int(text[:8]) <= 10**6:
            raise ConfigError(f"{VARIABLE} is {text!r}, it must be a number of megabytes from 1 to 1000000.")
        floor = int(text) << 20
        return cls(
            floor=floor,
            total=max(floor, _RATIO * size),
            records=max(_MIN_RECORDS, floor // 128, size // _BYTES_PER_RECORD),
        )

    def check_total(self, size: int) -> None:
        """Raise LimitError when all chunks together are larger than allowed."""
        _check(size, self.total)

    def check_chunk(self, size: int, stored: int) -> None:
        """Raise LimitError when a chunk that takes `stored` bytes in the file is larger than allowed."""
        _check(size, min(max(self.floor, _CHUNK_RATIO * stored), self.total))

    def check_records(self, count: int) -> None:
        """Raise LimitError for more records than allowed."""
        if count > self.records:
            raise LimitError(
                f"it holds more than {self.records:,} records, too many for a file of its size; {VARIABLE} raises this"
            )


class Unpacked:
    """What has been unpacked of a file, or of the files of one bag, and the limits that it stays within.

    Args:
        limits: Of all of it.
    """

    def __init__(self, limits: Limits) -> None:
        self.limits = limits
        self._num_bytes = self._num_records = 0

    def add(self, num_bytes: int, num_records: int = 0) -> None:
        """Count what comes; LimitError when all together is more than allowed."""
        self._num_bytes += num_bytes
        self._num_records += num_records
        self.limits.check_total(self._num_bytes)
        self.limits.check_records(self._num_records)


def _check(size: int, allowed: int) -> None:
    if size > allowed:
        raise LimitError(
            f"it would unpack to {size / 1e6:,.0f} MB, allowed are {allowed / 1e6:,.0f} MB; {VARIABLE} raises this"
        )
