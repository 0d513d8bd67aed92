"""A bag's streams: when each message of the mapping's topics was, and the numbers of those that hold any.

Numbers stay in memory, some hundred bytes a message; of images only what is needed to choose among them does. They
are read from the bag once more when their rows are written.
"""

from __future__ import annotations

import zlib
from array import array
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import in_words
from demorec.core.plain import listed
from demorec.core.registry import nearest_match
from demorec.mcap.limits import SpentError
from demorec.sources.bag import Bag
from demorec.sources.bag_files import BagChannel, BagError, BagMessage
from demorec.sources.decoding import Decoder, UnknownEncodingError, decoder_of
from demorec.sources.fields import (
    FieldError,
    OtherPublisherError,
    SourceLayout,
    SourceReader,
    converted,
    follow,
    frame_id_of,
    layout_of,
    parse_path,
    picture_bytes,
    stamp_of,
)
from demorec.sources.mapping import Source, SourceMapping
from demorec.sources.picture_messages import PictureHeads, picture_head
from demorec.sources.ros_types import Budgets, Values
from demorec.sources.service_calls import CallReader, ServiceCall
from demorec.sources.words import quoted

NO_STAMP = -(2**63)
_BYTES_OF_MESSAGE = 40
"""That a stream keeps of each, beside its numbers."""
_BYTES_OF_VALUE = 200
_VALUES_OF_ADDING = 15
"""As long as reading so many takes to give a message to a stream, of which a topic may have many."""
_MAX_NUMBERS = 16_384
"""Of all features together, in a row."""
_MAX_TEXT = 10_000
_MAX_URDF = 4 << 20
_SHOWN_JOINTS = 40
_INFO_FIELDS = ("width", "height", "k", "K", "d", "D")
"""Of a camera's calibration that are asked for."""


@dataclass(kw_only=True, eq=False)
class Stream:
    """The messages of one source or camera, in the order in which the bag has them.

    Attributes:
        label: Which it is: "observation.state" or "camera front".
        topic, type: Of its messages.
        log_ns: (N,) int64, when each was recorded.
        header_ns: (N,) int64, the time in each header, or NO_STAMP.
        numbers: (N,) int64, which of the topic's messages it is, from 0; empty for others than cameras.
        values: (N, D) in the unit of the feature; None for cameras.
        layout: Of the values; None for cameras.
        heads: (N,) what is known of each image; empty for others.
        checksums: (N,) CRC-32 of each message's bytes.
        picture_sums: (N,) CRC-32 of each image's bytes; empty for others.
        frame_ids: Coordinate frames that messages name, in the order of their first occurrence.
        num_malformed: Messages that cannot be read or lack something.
        first_problem: What is wrong with the first of them.
    """

    label: str
    topic: str
    type: str
    log_ns: NDArray[np.int64]
    header_ns: NDArray[np.int64]
    numbers: NDArray[np.int64]
    values: NDArray[np.floating[Any]] | None
    layout: SourceLayout | None
    heads: PictureHeads
    checksums: NDArray[np.uint32]
    picture_sums: NDArray[np.uint32]
    frame_ids: tuple[str, ...]
    num_malformed: int
    first_problem: str

    def __len__(self) -> int:
        return len(self.log_ns)


@dataclass(frozen=True, kw_only=True, eq=False)
class Text:
    """A text of a topic (task, marker, robot description).

    Attributes:
        time_ns: Of its message, as the mapping's clock takes it.
        value: The text, number or boolean.
        is_header: Whether the time is that of a header.
    """

    time_ns: int
    value: Any
    is_header: bool = False


@dataclass(kw_only=True, eq=False)
class BagStreams:
    """All that a mapping takes from a bag.

    Attributes:
        sources: (feature, number of the source) -> its stream.
        cameras: Name of a camera -> its stream.
        infos: Name of a camera -> its first calibration message.
        texts: Topic -> its texts.
        calls: Topic of a service's events -> its calls.
        problems: Why parts of the bag could not be read.
        num_bytes: Of the bag's files.
    """

    sources: dict[tuple[str, int], Stream]
    cameras: dict[str, Stream]
    infos: dict[str, Values]
    texts: dict[str, list[Text]]
    calls: dict[str, list[ServiceCall]]
    problems: list[str]
    num_bytes: int


@dataclass(kw_only=True, eq=False)
class _Growing:
    """A stream while it is read."""

    label: str
    topic: str
    budgets: Budgets
    source: Source | None = None
    type: str = ""
    layout: SourceLayout | None = None
    reader: SourceReader | None = None
    log_ns: array[int] = field(default_factory=lambda: array("q"))
    header_ns: array[int] = field(default_factory=lambda: array("q"))
    numbers: array[int] = field(default_factory=lambda: array("q"))
    checksums: array[int] = field(default_factory=lambda: array("I"))
    picture_sums: array[int] = field(default_factory=lambda: array("I"))
    vectors: bytearray = field(default_factory=bytearray)
    dtype: np.dtype[np.floating[Any]] | None = None
    heads: PictureHeads = field(default_factory=PictureHeads)
    frame_ids: dict[str, None] = field(default_factory=dict)
    num_malformed: int = 0
    first_problem: str = ""
    first_refusal: str = ""

    def add(self, number: int, message: BagMessage, values: Values, checksum: int) -> None:
        """Take one message."""
        self.type = self.type or message.channel.type
        try:
            self.budgets.values.take(_VALUES_OF_ADDING)
            self.budgets.numbers.take(_BYTES_OF_MESSAGE)
            if self.source is not None:
                if self.reader is None:
                    self.layout = layout_of(self.source, values)
                    self.reader = SourceReader(self.source, self.layout)
                self._add_vector(self.reader.read(values))
            else:
                head, picture_sum = picture_head(values), zlib.crc32(picture_bytes(values))
                self.heads.append(head)  # both or neither
                self.picture_sums.append(picture_sum)
                self.numbers.append(number)
        except OtherPublisherError as error:
            self.first_refusal = self.first_refusal or str(error)
            return
        except (ValueError, RecursionError, OverflowError, TypeError) as error:
            self.malformed(in_words(error))
            return
        stamp = stamp_of(values)
        self.log_ns.append(message.log_ns)
        self.header_ns.append(NO_STAMP if stamp is None else stamp)
        self.checksums.append(checksum)
        if len(self.frame_ids) < 16:
            self.frame_ids.setdefault(frame_id_of(values))

    def malformed(self, problem: str) -> None:
        """Count a message that cannot be used."""
        self.num_malformed += 1
        self.first_problem = self.first_problem or problem

    def _add_vector(self, vector: NDArray[np.floating[Any]]) -> None:
        # Bytes behind each other: an array for each of a million messages takes three times as much, and leaves holes.
        if self.dtype is None:
            self.dtype = vector.dtype
        elif self.dtype != vector.dtype:  # float64 holds both
            self.vectors = bytearray(np.frombuffer(self.vectors, self.dtype).astype(np.float64).data)
            self.dtype = np.dtype(np.float64)
        self.budgets.numbers.take(self.dtype.itemsize * len(vector))
        self.vectors += vector.astype(self.dtype, copy=False).data

    def finished(self) -> Stream:
        """The stream as it is now."""
        values = None
        if self.source is not None and self.layout is not None and self.log_ns:
            rows = np.frombuffer(self.vectors, self.dtype).reshape(len(self.log_ns), -1)
            values = converted(self.source, rows)
        return Stream(
            label=self.label,
            topic=self.topic,
            type=self.type,
            log_ns=np.asarray(self.log_ns),
            header_ns=np.asarray(self.header_ns),
            numbers=np.asarray(self.numbers),
            values=values,
            layout=self.layout,
            heads=self.heads,
            checksums=np.asarray(self.checksums),
            picture_sums=np.asarray(self.picture_sums),
            frame_ids=tuple(self.frame_ids),
            num_malformed=self.num_malformed,
            first_problem=self.first_problem,
        )


class BagDecoder:
    """Decoders of a bag's channels, made when they are first needed.

    Args:
        num_bytes: Of the bag's files, by which grows what may be read of it.

    Attributes:
        budgets: What may still be made of it.
    """

    def __init__(self, num_bytes: int = 0) -> None:
        self.budgets = Budgets(num_bytes)
        self._decoders: dict[BagChannel, Decoder | UnknownEncodingError] = {}

    def values(self, message: BagMessage) -> Values:
        """Of a message.

        Raises:
            UnknownEncodingError: Its channel cannot be read at all.
            ValueError: The message does not fit its type.
        """
        decoder = self._decoders.get(message.channel)
        if decoder is None:
            try:
                decoder = decoder_of(message.channel, self.budgets)
            except UnknownEncodingError as error:
                decoder = error
            self._decoders[message.channel] = decoder
        if isinstance(decoder, UnknownEncodingError):
            raise UnknownEncodingError(str(decoder))
        return decoder(message.data)

    def may_keep(self, message: BagMessage) -> bool:
        """Whether the values that a message has just given are few enough to be kept beside those kept before."""
        used = self.budgets.values.used - self.budgets.values.begun
        try:
            self.budgets.numbers.take(len(message.data) + _BYTES_OF_VALUE * used)
        except SpentError:
            return False
        return True


def _label(feature: str, source: Source, sources: Sequence[Source]) -> str:
    """The name of a feature, and the joints where several of its sources are of one topic."""
    if not source.joints or sum(other.topic == source.topic for other in sources) == 1:
        return feature
    return f"{feature} ({', '.join(source.joints[:2])}{', ...' if len(source.joints) > 2 else ''})"


def _unnamed_joints(stream: _Growing, others: Sequence[str]) -> str:
    """What to write where a source takes whatever its topic names, and that is not the same in all messages."""
    assert stream.layout is not None
    lists = " and one with ".join(
        f"joints = [{', '.join(map(quoted, joints[:_SHOWN_JOINTS]))}{', ...' if len(joints) > _SHOWN_JOINTS else ''}]"
        for joints in (stream.layout.joints, others)
    )
    return (
        f"{stream.label} takes all joints of {stream.topic}, whose messages do not name the same ones, as those of two "
        f"publishers: write a source with {lists}, or leave the latter out"
    )


def read_streams(bag: Bag, mapping: SourceMapping) -> BagStreams:
    """Read a bag from its front to its end.

    Raises:
        BagError: The mapping does not fit the bag; one message tells all problems.
    """
    reading = _Reading(mapping, bag.num_bytes)
    problems: list[str] = []
    try:
        for message in bag.messages(problems):
            reading.add(message)
    except SpentError as error:
        raise BagError(f"{error}: {bag.path}") from error
    reading.check(bag, problems)
    return reading.finished(problems)


class _Reading:
    def __init__(self, mapping: SourceMapping, num_bytes: int) -> None:
        self._mapping, self._num_bytes = mapping, num_bytes
        self._decoder = BagDecoder(num_bytes)
        budgets = self._decoder.budgets
        self._sources = {
            (name, index): _Growing(
                label=_label(name, source, sources), topic=source.topic, budgets=budgets, source=source
            )
            for name, sources in mapping.features.items()
            for index, source in enumerate(sources)
            if source.topic
        }
        self._cameras = {
            name: _Growing(label=f"camera {name}", topic=camera.topic, budgets=budgets)
            for name, camera in mapping.cameras.items()
        }
        self._streams: dict[str, list[_Growing]] = {}
        for stream in (*self._sources.values(), *self._cameras.values()):
            self._streams.setdefault(stream.topic, []).append(stream)
        self._fields = {mapping.task.topic: mapping.task.field, mapping.robot.urdf_topic: "data"}
        self._fields[mapping.subtasks.topic] = mapping.subtasks.field
        if mapping.episodes.cut == "marker":
            self._fields[mapping.episodes.topic] = mapping.episodes.field
        self._fields.pop("", None)
        self._texts: dict[str, list[Text]] = {topic: [] for topic in self._fields}
        by_header = mapping.clock.stamp == "header"
        self._calls = {topic: CallReader(by_header=by_header) for topic in mapping.episodes.services}
        self._infos: dict[str, Values] = {}
        self._info_topics = {camera.info_topic: name for name, camera in mapping.cameras.items() if camera.info_topic}
        self._wanted = mapping.topics
        self._counts: dict[str, int] = {}
        self._types: dict[str, set[str]] = {}
        self._refused: dict[str, str] = {}

    def add(self, message: BagMessage) -> None:
        """Take a message."""
        topic = message.channel.topic
        number = self._counts.get(topic, 0)
        self._counts[topic] = number + 1
        if number == 0 or message.channel.type not in self._types[topic]:
            self._types.setdefault(topic, set()).add(message.channel.type)
        if topic not in self._wanted or topic in self._refused:
            return
        streams = self._streams.get(topic, ())
        try:
            values = self._decoder.values(message)
        except UnknownEncodingError as error:
            self._refused[topic] = str(error)
            return
        except (ValueError, RecursionError, OverflowError, TypeError) as error:
            for stream in streams:
                stream.malformed(str(error))
            if topic in self._texts or topic in self._calls:
                self._refused[topic] = in_words(error)
            return
        checksum = zlib.crc32(message.data)
        for stream in streams:
            stream.add(number, message, values, checksum)
        if (topic in self._texts or topic in self._calls) and not self._decoder.may_keep(message):
            self._refused[topic] = "it holds too much to be kept in memory"
            return
        if topic in self._texts:
            self._add_text(topic, message, values)
        if topic in self._calls:
            try:
                self._calls[topic].add(values, message.log_ns)
            except FieldError as error:
                self._refused[topic] = str(error)
        if topic in self._info_topics:
            kept = {key: values[key] for key in _INFO_FIELDS if key in values} | {"frame_id": frame_id_of(values)}
            self._infos.setdefault(self._info_topics[topic], kept)

    def _add_text(self, topic: str, message: BagMessage, values: Values) -> None:
        try:
            value = follow(values, parse_path(self._fields[topic]))
        except ValueError as error:
            self._refused[topic] = str(error)
            return
        if isinstance(value, np.generic):
            value = value.item()
        if not isinstance(value, str | bool | int | float):
            self._refused[topic] = f"the field {self._fields[topic]!r} is no text, number or boolean"
            return
        limit = _MAX_URDF if topic == self._mapping.robot.urdf_topic else _MAX_TEXT
        if isinstance(value, str) and len(value) > limit:
            self._refused[topic] = f"a text has {len(value):,} characters, at most {limit:,} are read"
            return
        stamp = stamp_of(values) if self._mapping.clock.stamp == "header" else None
        time_ns = message.log_ns if stamp is None else stamp
        self._texts[topic].append(Text(time_ns=time_ns, value=value, is_header=stamp is not None))

    def check(self, bag: Bag, unread: Sequence[str]) -> None:
        """Raise BagError for all that the mapping names and the bag lacks; `unread` is what could not be read of it."""
        problems = []
        if not self._counts:
            raise BagError(f"The bag holds no messages{f' ({unread[0]})' if unread else ''}: {bag.path}")
        for topic in sorted(self._wanted):
            if topic not in self._counts:
                problems.append(f"there is no message of {topic!r}.{nearest_match(topic, self._counts)}".rstrip("."))
            elif topic in self._refused:
                problems.append(f"{topic} cannot be read, since {self._refused[topic]}")
            elif len(self._types[topic]) > 1:
                problems.append(f"{topic} has messages of several types ({', '.join(sorted(self._types[topic]))})")
        for stream in (*self._sources.values(), *self._cameras.values()):
            if stream.topic in self._counts and stream.topic not in self._refused and not stream.log_ns:
                reason = stream.first_problem or stream.first_refusal
                problems.append(f"{stream.label} cannot be taken from {stream.topic} ({stream.type}): {reason}")
            if stream.reader is not None and (others := list(stream.reader.others)):
                problems.append(_unnamed_joints(stream, others))
        count = sum(len(stream.layout.names) for stream in self._sources.values() if stream.layout)
        if count > _MAX_NUMBERS:
            problems.append(f"its features have {count:,} numbers, at most {_MAX_NUMBERS:,} are read")
        problems += self._double_names()
        problems += self._lacking_stamps()
        for camera in self._cameras.values():
            if camera.heads and not camera.heads.are_keyframes.any():
                problems.append(f"{camera.topic} has no keyframe with its parameter sets, so it cannot be decoded")
        if problems:
            raise BagError(f"The mapping does not fit the bag: {listed(problems)}: {bag.path}")

    def _lacking_stamps(self) -> list[str]:
        features, cameras = self._mapping.features, self._mapping.cameras
        chosen = [(features[name][index].stamp, stream) for (name, index), stream in self._sources.items()]
        chosen += [(cameras[name].stamp, stream) for name, stream in self._cameras.items()]
        return [
            f'{stream.label} has stamp = "header", but the headers of {stream.topic} have no time: write "log"'
            for stamp, stream in chosen
            if stamp == "header" and stream.header_ns and max(stream.header_ns) <= 0
        ]

    def _double_names(self) -> list[str]:
        problems = []
        for feature in self._mapping.features:
            seen: dict[str, str] = {}
            for (name, _), stream in self._sources.items():
                for label in stream.layout.names if name == feature and stream.layout else ():
                    if label in seen:
                        problems.append(
                            f"{feature} gets {label!r} from {seen[label]} and from {stream.topic}: leave one out, or "
                            "tell them apart by prefix or names"
                        )
                        break
                    seen[label] = stream.topic
        return problems

    def finished(self, problems: list[str]) -> BagStreams:
        """All that was read."""
        return BagStreams(
            sources={key: stream.finished() for key, stream in self._sources.items()},
            cameras={name: stream.finished() for name, stream in self._cameras.items()},
            infos=self._infos,
            texts=self._texts,
            calls={topic: reader.calls() for topic, reader in self._calls.items()},
            problems=problems,
            num_bytes=self._num_bytes,
        )
