"""An unfinished MCAP file: NAME.mcap.part, renamed when it is complete and on disk."""

from __future__ import annotations

import io
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

import foxglove
from foxglove.mcap import MCAPCompression, MCAPWriteOptions
from foxglove.messages import CompressedVideo

from demorec.core.atomic import snapshot, take_name
from demorec.core.errors import ConfigError, RecordingError, describe_error, write_error
from demorec.core.files import open_locked, sync_path
from demorec.core.replacing import RECORDING, check_replaceable
from demorec.mcap import messages
from demorec.mcap.ros2 import DEFINITIONS

_CHUNK_BYTES = 1 << 20
_LATCHED_QOS = (
    "- history: 1\n  depth: 1\n  reliability: 1\n  durability: 1\n"
    "  deadline:\n    sec: 9223372036\n    nsec: 854775807\n"
    "  lifespan:\n    sec: 9223372036\n    nsec: 854775807\n"
    "  liveliness: 1\n  liveliness_lease_duration:\n    sec: 9223372036\n    nsec: 854775807\n"
    "  avoid_ros_namespace_conventions: false"
)
"""Quality of service of topics with one message: "transient local", so that late subscribers receive it too."""


class _Disk(io.FileIO):
    """The file under the MCAP writer, unbuffered.

    It keeps the first error, then discards further data silently: otherwise the writer would print a line for every
    message until the recorder checks `error`.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path, "w")
        self._place = self._end = 0  # as assumed by the writer
        self.error: OSError | None = None

    def write(self, data: bytes) -> int:  # type: ignore[override]
        rest = memoryview(data)
        try:
            while rest and self.error is None:
                rest = rest[super().write(rest) :]
        except OSError as error:
            self.error = error
        self._place += len(data)
        self._end = max(self._end, self._place)
        return len(data)

    def seek(self, offset: int, whence: int = 0) -> int:
        self._place = offset + (0, self._place, self._end)[whence]
        if self.error is None:
            super().seek(self._place)
        return self._place

    def sync(self) -> None:
        try:
            os.fsync(self.fileno())
        except OSError as error:
            self.error = self.error or error


class PartFile:
    """Writes messages and metadata through foxglove-sdk's MCAP writer, unbuffered below it.

    Args:
        path: The finished file.
        part: Path of the unfinished file, if not NAME.part.
        overwrite: Whether `path`, or an unfinished recording of its name, may be replaced by the new one.
        is_worthless: Whether an unfinished recording of a dead writer could be made again, so that it may be replaced.

    Raises:
        ConfigError: A file of that name, or an unfinished one, exists and must not be replaced.
        RecordingError: The file cannot be written; raised by all methods.
    """

    def __init__(
        self,
        path: Path,
        *,
        part: Path | None = None,
        overwrite: bool = False,
        is_worthless: Callable[[Path], bool] = lambda part: False,
    ) -> None:
        self.path, self.part = path, part or path.with_name(f"{path.name}.part")
        check_replaceable(path, RECORDING, overwrite=overwrite)
        self._before = snapshot(path)
        # Held until the file is renamed or closed: other processes must not mistake it for a dead one's.
        self._lock: int | None = None
        try:
            self._lock = _lock_part(self.part)
            if os.fstat(self._lock).st_size and not overwrite and not is_worthless(self.part):
                raise ConfigError(
                    "An unfinished recording of that name exists; recover it, delete it, or use --overwrite: "
                    f"{self.part}"
                )
            self._disk = _Disk(self.part)
        except BaseException as error:
            self._unlock()
            if not isinstance(error, OSError):
                raise
            reason = describe_error(error)
            raise write_error("The recording", error, path, RecordingError, reason=reason) from error
        self._channels: dict[str, foxglove.Channel] = {}
        self._context = foxglove.Context()
        self._mcap = foxglove.open_mcap(
            self._disk,
            context=self._context,
            writer_options=MCAPWriteOptions(
                compression=MCAPCompression.Zstd, chunk_size=_CHUNK_BYTES, profile="ros2", compression_threads=0
            ),
        )
        self._is_open = True

    def _unwritable(self, error: Exception) -> RecordingError:
        return RecordingError(f"The recording cannot be written ({describe_error(error)}): {self.path}")

    def log(self, topic: str, schema: str, data: bytes, time_ns: int, *, latched: bool = False) -> None:
        """Add a message; every topic has one type."""
        self.logger(topic, schema, latched=latched)(data, log_time=time_ns)

    def logger(self, topic: str, schema: str, *, latched: bool = False) -> Callable[..., None]:
        """Return a function that adds many messages to a topic: called with the data and, by name, log_time."""
        if topic not in self._channels:
            if schema == messages.PROTOBUF_VIDEO:
                encoding, definition = "protobuf", CompressedVideo.get_schema()
            else:
                encoding = "cdr"
                definition = foxglove.Schema(name=schema, encoding="ros2msg", data=DEFINITIONS[schema].encode())
            self._channels[topic] = foxglove.Channel(
                topic,
                message_encoding=encoding,
                schema=definition,
                context=self._context,
                metadata={"offered_qos_profiles": _LATCHED_QOS} if latched else {},
            )
        log: Callable[..., None] = self._channels[topic].base.log  # bypasses its wrapper, which checks for JSON
        return log

    def metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Add a metadata record."""
        with self._disk_errors():
            self._mcap.write_metadata(name, dict(values))

    def flush(self) -> None:
        """End the chunk; afterwards everything logged is with the operating system and survives this process."""
        with self._disk_errors():
            self._mcap.flush()

    @contextmanager
    def _disk_errors(self) -> Iterator[None]:
        try:
            yield
        except RuntimeError as error:  # foxglove's error for any failure below it
            raise self._unwritable(self._disk.error or error) from (self._disk.error or error)
        if self._disk.error is not None:
            raise self._unwritable(self._disk.error) from self._disk.error

    def end(self) -> None:
        """Write the index and make NAME.part durable, complete but not renamed; safe to call twice."""
        if self._is_open:
            self._is_open = False
            try:
                with self._disk_errors():
                    self._mcap.close()
                    self._disk.sync()
            finally:
                self._disk.close()

    def close(self) -> None:
        """End the file and keep it as NAME.part; safe to call twice."""
        try:
            self.end()
        finally:
            self._unlock()

    def _unlock(self) -> None:
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def discard(self) -> None:
        """Abandon the file and remove it; safe to call twice, and after `publish`."""
        if self._lock is not None:
            self.part.unlink(missing_ok=True)  # while the lock is held, the file is ours
        with suppress(RecordingError):
            self.close()

    def publish(self) -> None:
        """End the file and rename it; ConfigError if another file has taken the name meanwhile."""
        try:
            self.end()
            if self._before and snapshot(self.path) == self._before:
                self.part.replace(self.path)
            else:
                take_name(self.part, self.path)
            sync_path(self.path.parent)
        except FileExistsError as error:
            raise name_taken(self.path, self.part) from error
        except OSError as error:
            raise self._unwritable(error) from error
        finally:
            self.close()


def name_taken(path: Path, kept: Path) -> ConfigError:
    """Build the error for a recording whose name another file has taken; it stays at `kept`."""
    return ConfigError(
        f"Another file has appeared while this recording was made, and is left unchanged ({path}); the recording is "
        f"kept as {kept}"
    )


def _lock_part(part: Path) -> int:
    """Open an unfinished file, with what a dead process left, locked until closed; ConfigError if in use or foreign."""
    while True:
        if os.path.lexists(part) and (part.is_symlink() or not part.is_file()):
            raise ConfigError(f"This is not an unfinished file and is in the way; move it elsewhere: {part}")
        try:
            handle = open_locked(part)
        except BlockingIOError as error:
            raise ConfigError(f"Another process is writing this file; wait until it is done: {part}") from error
        try:
            found = os.fstat(handle)
            if found.st_nlink > 1:  # killed during the renaming
                part.unlink()
            # Its previous owner may have renamed the file between the two calls.
            if not part.exists() or not os.path.samestat(found, part.stat()):
                os.close(handle)
                continue
            if found.st_size and not RECORDING.recognises(part):
                raise ConfigError(
                    f"This is not the unfinished beginning of {RECORDING.name}; move it elsewhere: {part}"
                )
            return handle
        except BaseException:
            os.close(handle)
            raise
