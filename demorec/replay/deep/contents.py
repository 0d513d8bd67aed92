"""Two recordings of one episode compared byte by byte, and what differs taken apart into named fields.

Recordings hold no clock, host or path, so that the same episode made again on the same type of machine has the same
bytes in every message. Coded images that differ are left to `images`, which looks at what they show.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, field
from itertools import zip_longest
from pathlib import Path
from typing import Any

from demorec.core.plain import parse_json
from demorec.episode.info import EpisodeInfo
from demorec.mcap.channels import camera_topic
from demorec.mcap.container import Container
from demorec.mcap.messages import Value, message_fields
from demorec.mcap.metadata import EPISODE
from demorec.replay.deep.difference import Difference, Differences

CODED = ("h264", "video", "image/compressed", "depth", "segmentation")
"""Streams of a camera whose messages hold a coded image in the field `data`."""
_SEAL = "crc32"
"""Follows from the other values of a metadata record."""
_VERSIONS = "info.versions"
"""Reported by themselves, before all else."""

Messages = Mapping[str, Mapping[int, list[bytes]]]
"""Topic -> time in ns -> messages."""


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
        """Read all of a file; RecordingError when it is damaged."""
        found = cls()
        with closing(Container(path)) as container:
            for name in container.metadata_names:
                found.metadata[name] = container.metadata(name) or {}
            for name in container.attachment_names:
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
        """Leave out what `other`, which a crash cut off, cannot have: later messages, what is written at the end."""
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


def coded_topics(info: EpisodeInfo) -> dict[str, str]:
    """Topic -> camera, of all streams of coded images."""
    return {camera_topic(camera.name, stream): camera.name for camera in info.scene.cameras for stream in CODED}


def content_differences(
    recorded: Contents, again: Contents, info: EpisodeInfo, fps: int
) -> tuple[list[Difference], dict[str, list[int]]]:
    """What differs, less the coded images; and topic -> frames, ascending, whose coded images differ.

    Args:
        recorded, again: The two files.
        info: Of the one made again.
        fps: Of the recording.
    """
    found = Differences()
    for name in recorded.attachments.keys() | again.attachments.keys():
        a, b = recorded.attachments.get(name), again.attachments.get(name)
        if a != b:
            found.add(f"attachment {name}", "data", None, a, b)
    for name in dict.fromkeys((*again.metadata, *recorded.metadata)):
        for path, values in _metadata_differences(recorded.metadata.get(name), again.metadata.get(name)):
            if not (name == EPISODE and path.startswith(_VERSIONS)):
                found.add(f"metadata {name}", path, None, *values)
    images: dict[str, list[int]] = {}
    coded = coded_topics(info)
    for topic in dict.fromkeys((*again.channels, *recorded.channels)):
        if topic not in recorded.channels or topic not in again.channels:
            counts = [sum(map(len, c.messages.get(topic, {}).values())) for c in (recorded, again)]
            found.add(topic, "messages", None, *(count if count else None for count in counts))
            continue
        for name, values in _differing(recorded.channels[topic], again.channels[topic]):
            found.add(topic, name, None, *values)
        differing = _topic_differences(found, topic, recorded, again, fps=fps, is_coded=topic in coded)
        if differing:
            images[topic] = differing
    return list(found), images


def _differing(a: Mapping[str, Value], b: Mapping[str, Value]) -> Iterator[tuple[str, tuple[Any, Any]]]:
    for name in dict.fromkeys((*b, *a)):
        if not _is_same(a.get(name), b.get(name)):
            yield name, (a.get(name), b.get(name))


def _is_same(a: Value | None, b: Value | None) -> bool:
    """Whether two values are equal to the bit: -0.0 is not 0.0, and a NaN equals itself."""
    if isinstance(a, float) and isinstance(b, float):
        return struct.pack("<d", a) == struct.pack("<d", b)
    return type(a) is type(b) and a == b


def _topic_differences(
    found: Differences, topic: str, recorded: Contents, again: Contents, *, fps: int, is_coded: bool
) -> list[int]:
    """Add what differs in a topic; return the frames whose coded images differ."""
    ours, theirs, schema = recorded.messages[topic], again.messages[topic], again.schemas[topic]
    if ours == theirs:
        return []
    images = []
    for time_ns in sorted(ours.keys() | theirs.keys()):
        a_messages, b_messages = ours.get(time_ns, []), theirs.get(time_ns, [])
        frame = round(time_ns * fps / 1e9)
        if len(a_messages) != len(b_messages):
            found.add(topic, "messages", frame, len(a_messages) or None, len(b_messages) or None)
        for a, b in zip_longest(a_messages, b_messages):
            if a is None or b is None or a == b:
                continue
            try:
                a_fields = message_fields(schema, a)
            except (ValueError, KeyError) as error:
                found.add(topic, "message", frame, f"{len(a)} bytes that are none ({error})", b)
                continue
            b_fields = message_fields(schema, b)
            differing = dict(_differing(a_fields, b_fields))
            if is_coded and differing.pop("data", None) is not None:
                images.append(frame)
            for name, values in differing.items():
                found.add(topic, name, frame, *values)
            if not differing and not (is_coded and images and images[-1] == frame):
                found.add(topic, "padding", frame, a, b)
    return images


def _metadata_differences(
    recorded: Mapping[str, str] | None, again: Mapping[str, str] | None
) -> Iterator[tuple[str, tuple[Any, Any]]]:
    if recorded is None or again is None:
        yield "record", (None if recorded is None else "a record", None if again is None else "a record")
        return
    a, b = dict(_leaves(recorded)), dict(_leaves(again))
    yield from _differing(a, b)


def _leaves(values: Mapping[str, str]) -> Iterator[tuple[str, Value]]:
    """Every single value of a metadata record, whose values may be JSON."""
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
