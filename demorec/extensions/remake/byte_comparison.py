"""Compare two recordings of one episode byte by byte, and name the fields that differ.

Recordings contain no clock, host or path, so that a remake on the same type of machine has the same bytes in every
message.
"""

from __future__ import annotations

import reprlib
from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from demorec.core.plain import parse_json
from demorec.mcap.container import Container
from demorec.mcap.messages import message_fields
from demorec.mcap.metadata import EPISODE

_SEAL = "crc32"
"""Derived from the other values of a metadata record."""
_MADE_BY = ("info.versions", "info.simulation.cpu")
"""Fields that are reported separately, before all others."""

_SHOWN = reprlib.Repr(maxstring=80, maxother=80)

Value = bool | int | float | str | bytes
Differing = tuple[str, int | None, Value | None, Value | None]
"""A difference in a stream: field, frame if any, recorded value, remade value."""


@dataclass(frozen=True, kw_only=True)
class RemakeDifference:
    """A field of a stream that differs in the remake.

    Attributes:
        stream: A topic, or "metadata NAME".
        field: Message field such as `pose.position.x`, or metadata field such as
        `info.simulation.scene.bodies[1].mass`.
        frames: Frames that differ, ascending; empty outside frames.
        recorded, again: Recorded and remade value at the first of these frames, in words.
    """

    stream: str
    field: str
    frames: tuple[int, ...] = ()
    recorded: str
    again: str

    def __str__(self) -> str:
        where = f"{self.stream} {self.field}"
        if self.frames:
            where += f" at frame {self.frames[0]}"
            if len(self.frames) > 1:
                where += f" (and {len(self.frames) - 1} more, the last is {self.frames[-1]})"
        return f"{where}: {self.recorded} is recorded, made again it is {self.again}"


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
        fixed: Topic or "metadata NAME" -> field -> value, for all that is outside frames; of a topic
        its type, encodings, definition and properties.
        schemas: Topic -> type of its messages.
        messages: Topic -> time in ns -> messages.
    """

    fixed: dict[str, dict[str, Value]] = field(default_factory=dict)
    schemas: dict[str, str] = field(default_factory=dict)
    messages: dict[str, dict[int, list[bytes]]] = field(default_factory=dict)

    @classmethod
    def of(cls, path: Path) -> Contents:
        """Read a whole file; RecordingError if it is damaged."""
        found = cls()
        with closing(Container(path)) as container:
            for name in container.metadata_index:
                values = dict(_leaves(container.metadata(name) or {}))
                left_out = _MADE_BY if name == EPISODE else ()
                found.fixed[f"metadata {name}"] = {
                    path: value for path, value in values.items() if not path.startswith(left_out)
                }
            for topic, channel in container.channels.items():
                schema = container.schemas[channel.schema_id]
                found.schemas[topic] = schema.name
                found.messages[topic] = {}
                found.fixed[topic] = {
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
        for topic in [topic for topic in self.messages if topic.endswith("/histogram")]:
            del self.messages[topic], self.fixed[topic]
        for times in self.messages.values():
            for time_ns in [time_ns for time_ns in times if time_ns > last]:
                del times[time_ns]
        for stream in self.fixed.keys() ^ other.fixed.keys():
            if stream.startswith("metadata "):
                self.fixed.pop(stream, None)
                other.fixed.pop(stream, None)


def content_differences(recorded: Contents, again: Contents, fps: int) -> list[RemakeDifference]:
    """List the fields that differ by their first frame, those outside frames first; `fps` is of the recording."""
    found: list[RemakeDifference] = []
    for stream in dict.fromkeys((*again.fixed, *recorded.fixed)):
        fields: dict[str, list[Differing]] = {}
        for differing in _stream_differences(stream, recorded, again, fps):
            fields.setdefault(differing[0], []).append(differing)
        for name, all_differing in fields.items():
            _, _, first, first_again = all_differing[0]
            frames = dict.fromkeys(frame for _, frame, _, _ in all_differing if frame is not None)
            found.append(
                RemakeDifference(
                    stream=stream,
                    field=name,
                    frames=tuple(frames),
                    recorded=_in_words(first),
                    again=_in_words(first_again),
                )
            )
    return sorted(found, key=lambda difference: difference.frames[:1])


def _stream_differences(stream: str, recorded: Contents, again: Contents, fps: int) -> Iterator[Differing]:
    ours, theirs = recorded.fixed.get(stream), again.fixed.get(stream)
    if ours is None or theirs is None:
        yield "presence", None, None if ours is None else "present", None if theirs is None else "present"
        return
    for name, a, b in _differing(ours, theirs):
        yield name, None, a, b
    if stream in again.messages:
        yield from _message_differences(stream, recorded, again, fps)


def _differing(a: Mapping[str, Value], b: Mapping[str, Value]) -> Iterator[tuple[str, Any, Any]]:
    """Yield the fields that are not equal to the bit: -0.0 is not 0.0, and a NaN equals itself."""
    for name in dict.fromkeys((*b, *a)):
        if repr(a.get(name)) != repr(b.get(name)):
            yield name, a.get(name), b.get(name)


def _message_differences(topic: str, recorded: Contents, again: Contents, fps: int) -> Iterator[Differing]:
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
                a_fields = dict(_nested("", message_fields(schema, a)))
            except (ValueError, KeyError) as error:
                yield "message", frame, f"{len(a)} bytes that are not a message ({error})", b
                continue
            differing = list(_differing(a_fields, dict(_nested("", message_fields(schema, b)))))
            for name, ours_now, theirs_now in differing or [("padding", a, b)]:
                yield name, frame, ours_now, theirs_now


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
    if isinstance(value, np.ndarray):
        value = value.tobytes() if value.dtype == np.uint8 else value.tolist()
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else None
    if items is None:
        yield path, "null" if value is None else value
        return
    if not value:
        yield path, f"an empty {'object' if isinstance(value, dict) else 'list'}"
    for key, child in items:
        yield from _nested(f"{path}.{key}".lstrip(".") if isinstance(key, str) else f"{path}[{key}]", child)
