"""Compare two recordings of one episode byte by byte, and name the fields that differ.

Recordings contain no clock, host or path, so that a remake on the same type of machine has the same bytes in every
message.
"""

from __future__ import annotations

import math
import reprlib
import struct
from collections.abc import Iterable, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from demorec.core.plain import parse_json
from demorec.mcap.container import Container
from demorec.mcap.messages import Value, message_fields
from demorec.mcap.metadata import EPISODE

_SEAL = "crc32"
"""Derived from the other values of a metadata record."""
_MADE_BY = ("info.versions", "info.simulation.cpu")
"""Fields that are reported separately, before all others."""

_SHOWN = reprlib.Repr(maxstring=80, maxother=80)

Differing = tuple[str, str, int | None, Value | None, Value | None]
"""A difference: stream, field, frame if any, recorded value, remade value."""


@dataclass(frozen=True, kw_only=True)
class RemakeDifference:
    """A field of a stream that differs in the remake.

    Attributes:
        stream: A topic, or "metadata NAME", "attachment NAME".
        field: Message field such as `pose.position.x`, or metadata field such as
        `info.simulation.scene.bodies[1].mass`; "image" for a camera's image.
        frames: Frames that differ, ascending; empty outside frames.
        recorded, again: Recorded and remade value at the first of these frames, in words; `again` is "" if `recorded`
        describes both.
        largest: Largest absolute difference over these frames; None if they are not numbers.
    """

    stream: str
    field: str
    frames: tuple[int, ...] = ()
    recorded: str
    again: str
    largest: float | None = None

    def __str__(self) -> str:
        where = f"{self.stream} {self.field}"
        if self.frames:
            where += f" at frame {self.frames[0]}"
            if len(self.frames) > 1:
                where += f" (and {len(self.frames) - 1} more, the last is {self.frames[-1]})"
        if not self.again:
            return f"{where}: {self.recorded}"
        text = f"{where}: {self.recorded} is recorded, made again it is {self.again}"
        return text if self.largest is None or len(self.frames) < 2 else f"{text}; at most {self.largest:.3g} apart"


def _in_words(value: Value | None) -> str:
    if value is None:
        return "nothing"
    if isinstance(value, bytes):
        return f"{len(value)} bytes"
    return repr(value) if isinstance(value, bool | int | float) else _SHOWN.repr(value)


@dataclass(kw_only=True)
class Contents:
    """Everything in a recording's file.

    Attributes:
        metadata: Name -> values.
        channels: Topic -> (type, encodings, definition, properties).
        schemas: Topic -> type of its messages.
        messages: Topic -> time in ns -> messages.
        attachments: Name -> bytes.
    """

    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    channels: dict[str, dict[str, Value]] = field(default_factory=dict)
    schemas: dict[str, str] = field(default_factory=dict)
    messages: dict[str, dict[int, list[bytes]]] = field(default_factory=dict)
    attachments: dict[str, bytes] = field(default_factory=dict)

    @classmethod
    def of(cls, path: Path) -> Contents:
        """Read a whole file; RecordingError if it is damaged."""
        found = cls()
        with closing(Container(path)) as container:
            for name in container.metadata_index:
                found.metadata[name] = container.metadata(name) or {}
            for name in container.attachments:
                found.attachments[name] = container.attachment(name)
            for topic, channel in container.channels.items():
                schema = container.schemas[channel.schema_id]
                found.schemas[topic] = schema.name
                found.messages[topic] = {}
                found.channels[topic] = {
                    "type": schema.name,
                    "encoding of the definition": schema.encoding,
                    "definition": schema.data,
                    "encoding": channel.message_encoding,
                    **{f"property {name}": value for name, value in channel.metadata.items()},
                }
            for topic, time_ns, data in container.messages(list(container.channels)):
                found.messages[topic].setdefault(time_ns, []).append(data)
        return found

    def cut_off(self, other: Contents) -> None:
        """Leave out data that `other`, which a crash cut off, cannot have: later messages and the final records."""
        last = max((max(times, default=0) for times in other.messages.values()), default=0)
        for topic, times in list(self.messages.items()):
            if topic.endswith("/histogram"):
                del self.messages[topic], self.channels[topic]
                continue
            for time_ns in [time_ns for time_ns in times if time_ns > last]:
                del times[time_ns]
        for name in self.metadata.keys() ^ other.metadata.keys():
            self.metadata.pop(name, None)
            other.metadata.pop(name, None)


def content_differences(recorded: Contents, again: Contents, fps: int) -> list[RemakeDifference]:
    """List the fields that differ by their first frame, those outside frames first; `fps` is of the recording."""
    found = _gathered(_all_differing(recorded, again, fps))
    return sorted(found, key=lambda difference: difference.frames[:1])


def _all_differing(recorded: Contents, again: Contents, fps: int) -> Iterator[Differing]:
    for name in recorded.attachments.keys() | again.attachments.keys():
        a, b = recorded.attachments.get(name), again.attachments.get(name)
        if a != b:
            yield f"attachment {name}", "data", None, a, b
    for name in dict.fromkeys((*again.metadata, *recorded.metadata)):
        for path, a, b in _metadata_differences(recorded.metadata.get(name), again.metadata.get(name)):
            if not (name == EPISODE and path.startswith(_MADE_BY)):
                yield f"metadata {name}", path, None, a, b
    for topic in dict.fromkeys((*again.channels, *recorded.channels)):
        if topic not in recorded.channels or topic not in again.channels:
            ours, theirs = (sum(map(len, c.messages.get(topic, {}).values())) for c in (recorded, again))
            yield topic, "messages", None, ours or None, theirs or None
            continue
        for name, a, b in _differing(recorded.channels[topic], again.channels[topic]):
            yield topic, name, None, a, b
        for name, frame, a, b in _topic_differences(topic, recorded, again, fps):
            if name == "data" and isinstance(a, bytes) and isinstance(b, bytes):
                yield topic, "image", frame, a, b
            else:
                yield topic, name, frame, a, b


def _gathered(found: Iterable[Differing]) -> Iterator[RemakeDifference]:
    """Merge the differences of one field over all frames into one, which shows the first."""
    groups: dict[tuple[str, str], tuple[str, str, dict[int, None]]] = {}
    largest: dict[tuple[str, str], float] = {}
    for stream, name, frame, a, b in found:
        key = stream, name
        if key not in groups:
            groups[key] = _in_words(a), _in_words(b), {}
        if frame is not None:
            groups[key][2][frame] = None
        if (apart := _apart(a, b)) is not None:
            largest[key] = max(apart, largest.get(key, 0.0))
    for (stream, name), (recorded, again, frames) in groups.items():
        yield RemakeDifference(
            stream=stream,
            field=name,
            frames=tuple(frames),
            recorded=recorded,
            again=again,
            largest=largest.get((stream, name)),
        )


def _apart(a: Value | None, b: Value | None) -> float | None:
    if isinstance(a, bool) or isinstance(b, bool) or not isinstance(a, int | float) or not isinstance(b, int | float):
        return None
    return abs(a - b) if math.isfinite(a) and math.isfinite(b) else math.inf


def _differing(a: Mapping[str, Value], b: Mapping[str, Value]) -> Iterator[tuple[str, Any, Any]]:
    for name in dict.fromkeys((*b, *a)):
        if not _is_same(a.get(name), b.get(name)):
            yield name, a.get(name), b.get(name)


def _is_same(a: Value | None, b: Value | None) -> bool:
    """Whether two values are equal to the bit: -0.0 is not 0.0, and a NaN equals itself."""
    if isinstance(a, float) and isinstance(b, float):
        return struct.pack("<d", a) == struct.pack("<d", b)
    return type(a) is type(b) and a == b


def _topic_differences(
    topic: str, recorded: Contents, again: Contents, fps: int
) -> Iterator[tuple[str, int, Any, Any]]:
    """Yield (field, frame, recorded, remade) of the differences in a topic."""
    ours, theirs, schema = recorded.messages[topic], again.messages[topic], again.schemas[topic]
    if ours == theirs:
        return
    for time_ns in sorted(ours.keys() | theirs.keys()):
        a_messages, b_messages = ours.get(time_ns, []), theirs.get(time_ns, [])
        frame = round(time_ns * fps / 1e9)
        if len(a_messages) != len(b_messages):
            yield "messages", frame, len(a_messages) or None, len(b_messages) or None
        for a, b in zip(a_messages, b_messages, strict=False):
            if a == b:
                continue
            try:
                a_fields = message_fields(schema, a)
            except (ValueError, KeyError) as error:
                yield "message", frame, f"{len(a)} bytes that are not a message ({error})", b
                continue
            differing = list(_differing(a_fields, message_fields(schema, b)))
            for name, ours_now, theirs_now in differing or [("padding", a, b)]:
                yield name, frame, ours_now, theirs_now


def _metadata_differences(
    recorded: Mapping[str, str] | None, again: Mapping[str, str] | None
) -> Iterator[tuple[str, Any, Any]]:
    if recorded is None or again is None:
        yield "record", None if recorded is None else "a record", None if again is None else "a record"
        return
    yield from _differing(dict(_leaves(recorded)), dict(_leaves(again)))


def _leaves(values: Mapping[str, str]) -> Iterator[tuple[str, Value]]:
    """Yield each value of a metadata record, also within JSON."""
    for key, text in values.items():
        if key == _SEAL:
            continue
        try:
            parsed = parse_json(text) if text[:1] in "{[" else text
        except ValueError:
            parsed = text
        yield from _nested(key, parsed)


def _nested(path: str, value: Any) -> Iterator[tuple[str, Value]]:
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else None
    if items is None:
        yield path, "null" if value is None else value
        return
    if not value:
        yield path, f"an empty {'object' if isinstance(value, dict) else 'list'}"
    for key, child in items:
        yield from _nested(f"{path}.{key}" if isinstance(key, str) else f"{path}[{key}]", child)
