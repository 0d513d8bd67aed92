"""An MCAP file in the making: NAME.mcap.part, which gets its name when it is complete and on the disk."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import foxglove
from foxglove.mcap import MCAPCompression, MCAPWriteOptions
from foxglove.messages import CompressedVideo

from demorec.errors import RecordingError
from demorec.recording import messages
from demorec.recording.ros2 import DEFINITIONS

_CHUNK_BYTES = 1 << 20
_LATCHED_QOS = (
    "- history: 1\n  depth: 1\n  reliability: 1\n  durability: 1\n"
    "  deadline:\n    sec: 9223372036\n    nsec: 854775807\n"
    "  lifespan:\n    sec: 9223372036\n    nsec: 854775807\n"
    "  liveliness: 1\n  liveliness_lease_duration:\n    sec: 9223372036\n    nsec: 854775807\n"
    "  avoid_ros_namespace_conventions: false"
)
"""Quality of service of topics that are said once: "transient local", so that a late subscriber hears them too."""


def part_path(path: Path) -> Path:
    """Where the file is while it is being written."""
    return path.with_name(path.name + ".part")


class _Disk:
    """The file below the MCAP writer, unbuffered; it keeps the first error, which the writer may swallow."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("wb", buffering=0)
        self.error: OSError | None = None

    def write(self, data: bytes) -> int:
        """Write all of it."""
        rest = memoryview(data)
        try:
            while rest:
                rest = rest[self._file.write(rest) :]
        except OSError as error:
            self.error = self.error or error
            raise
        return len(data)

    def seek(self, offset: int, whence: int = 0) -> int:
        """As any file."""
        return self._file.seek(offset, whence)

    def flush(self) -> None:
        """Nothing is buffered here."""

    def sync(self) -> None:
        """Have the operating system put everything on the disk."""
        try:
            os.fsync(self._file.fileno())
        except OSError as error:
            self.error = self.error or error

    def close(self) -> None:
        """Close it."""
        self._file.close()


class PartFile:
    """Writes messages and metadata through foxglove-sdk's MCAP writer, unbuffered below it.

    Args:
        path: The finished file.
        part: Where it is until then, when that is not NAME.part; a file of that name is replaced.
        overwrite: Whether `path`, or an unfinished recording of its name, may be replaced.

    Raises:
        RecordingError: A file of that name, or an unfinished one, is there already; or it cannot be written.
    """

    def __init__(self, path: Path, *, part: Path | None = None, overwrite: bool = False) -> None:
        self.path, self.part, self._overwrite = path, part or part_path(path), overwrite
        self._check_free()
        if part is None and self.part.exists() and not overwrite:
            raise RecordingError(
                f"An unfinished recording of that name is there already; recover it, delete it, or --overwrite: "
                f"{self.part}"
            )
        try:
            self._disk = _Disk(self.part)
        except OSError as error:
            raise self._unwritable(error) from error
        self._channels: dict[str, foxglove.Channel] = {}
        self._log: dict[str, Callable[..., None]] = {}
        self._context = foxglove.Context()
        self._mcap = foxglove.open_mcap(
            self._disk,
            context=self._context,
            writer_options=MCAPWriteOptions(
                compression=MCAPCompression.Zstd, chunk_size=_CHUNK_BYTES, profile="ros2", compression_threads=0
            ),
        )
        self._is_open = True

    def _check_free(self) -> None:
        if self.path.exists() and not self._overwrite:
            raise RecordingError(f"The recording is there already, choose another name or --overwrite: {self.path}")

    def _unwritable(self, error: Exception) -> RecordingError:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        return RecordingError(f"The recording cannot be written ({reason}): {self.part}")

    def log(self, topic: str, schema: str, data: bytes, time_ns: int, *, latched: bool = False) -> None:
        """Add a message; every topic has one type."""
        self.logger(topic, schema, latched=latched)(data, log_time=time_ns)

    def logger(self, topic: str, schema: str, *, latched: bool = False) -> Callable[..., None]:
        """What adds messages to a topic, for many of them: called with the data and, by name, log_time."""
        log = self._log.get(topic)
        if log is None:
            channel = self._channels[topic] = self._open_channel(topic, schema, latched)
            log = self._log[topic] = channel.base.log  # without the wrapper, which looks for JSON in every message
        return log

    def _open_channel(self, topic: str, schema: str, latched: bool) -> foxglove.Channel:
        if schema == messages.PROTOBUF_VIDEO:
            encoding, definition = "protobuf", CompressedVideo.get_schema()
        else:
            encoding = "cdr"
            definition = foxglove.Schema(name=schema, encoding="ros2msg", data=DEFINITIONS[schema].encode())
        return foxglove.Channel(
            topic,
            message_encoding=encoding,
            schema=definition,
            context=self._context,
            metadata={"offered_qos_profiles": _LATCHED_QOS} if latched else {},
        )

    def metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Add a metadata record."""
        with self._disk_errors():
            self._mcap.write_metadata(name, dict(values))

    def flush(self) -> None:
        """End the chunk; when this returns, what was logged is with the operating system and survives this process.

        Raises:
            RecordingError: The disk is full or gone.
        """
        with self._disk_errors():
            self._mcap.flush()

    @contextmanager
    def _disk_errors(self) -> Iterator[None]:
        try:
            yield
        except RuntimeError as error:  # what foxglove makes of any failure below it
            raise self._unwritable(self._disk.error or error) from (self._disk.error or error)
        if self._disk.error is not None:
            raise self._unwritable(self._disk.error) from self._disk.error

    def close(self) -> None:
        """Leave NAME.part as it is; harmless when called twice."""
        if self._is_open:
            self._is_open = False
            try:
                with self._disk_errors():
                    self._mcap.close()
                    self._disk.sync()
            finally:
                self._disk.close()

    def publish(self) -> None:
        """Write the index, make the file durable and give it its name.

        Raises:
            RecordingError: A file of that name has appeared meanwhile, or the disk is full.
        """
        self.close()
        self._check_free()
        try:
            self.part.replace(self.path)
            folder = os.open(self.path.parent, os.O_RDONLY)
            try:
                os.fsync(folder)
            finally:
                os.close(folder)
        except OSError as error:
            raise self._unwritable(error) from error
