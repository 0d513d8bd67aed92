"""A bag's streams: the times of each message in the mapping's topics, and the numbers in them.

Numbers stay in memory, some hundred bytes per message; for images only the data for choosing among them. The bag is
read again for the images when the rows are written.
"""

from __future__ import annotations

from array import array
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import describe_error
from demorec.core.plain import listed
from demorec.core.registry import nearest_match
from demorec.extensions.imports.bag import Bag
from demorec.extensions.imports.bag_files import BagError
from demorec.extensions.imports.decoding import UnknownEncodingError, decode_message
from demorec.extensions.imports.fields import (
    OtherPublisherError,
    SourceReader,
    reader_of,
    stamp_of,
)
from demorec.extensions.imports.image_messages import ImageHead, image_head
from demorec.extensions.imports.mapping import CameraSource, Source, SourceMapping, Unit
from demorec.extensions.recovery.scan import ScannedMessage
from demorec.mcap.cdr import Values

NO_STAMP = -(2**63)
Key = tuple[str, int] | str
"""A stream: (feature, number of its source), or the name of a camera."""
_INFO_FIELDS = ("width", "height", "k", "K", "d", "D")
"""Fields of a camera's calibration that are read."""


@dataclass(kw_only=True, eq=False)
class Stream:
    """Messages of one source or camera, in the bag's order; it grows while they are read.

    Attributes:
        label: Name: "observation.state" or "camera front".
        part: Its entry in the mapping.
        reader: Reader of a source's numbers, set by its first message.
        logged, stamped: Growing `log_ns` and `header_ns`.
        places: Index of each message within its topic, from 0; empty except for cameras.
        vectors: Concatenated vectors of the source: a separate array per message would take three times as
        much memory for a million messages, and fragment it.
        heads: (N,) head of each image; empty except for cameras.
        num_malformed, first_problem: Messages that cannot be read or are incomplete, and the first one's problem.
        first_refusal: Reason why the first message was left to another publisher.
    """

    label: str
    part: Source | CameraSource
    type: str = ""
    reader: SourceReader | None = None
    logged: array[int] = field(default_factory=lambda: array("q"))
    stamped: array[int] = field(default_factory=lambda: array("q"))
    places: array[int] = field(default_factory=lambda: array("q"))
    vectors: bytearray = field(default_factory=bytearray)
    dtype: np.dtype[np.floating[Any]] | None = None
    heads: list[ImageHead] = field(default_factory=list)
    _known_heads: dict[ImageHead, ImageHead] = field(default_factory=dict)
    num_malformed: int = 0
    first_problem: str = ""
    first_refusal: str = ""

    def add(self, number: int, message: ScannedMessage, values: Values) -> None:
        """Add one message."""
        self.type = self.type or message.channel.type
        try:
            if isinstance(self.part, Source):
                self.reader = self.reader or reader_of(self.part, values)
                self._add_vector(self.reader.read(values))
            else:
                head = image_head(values)
                self.heads.append(self._known_heads.setdefault(head, head))
                self.places.append(number)
        except OtherPublisherError as error:
            self.first_refusal = self.first_refusal or str(error)
            return
        except (ValueError, RecursionError, OverflowError, TypeError) as error:
            self.malformed(describe_error(error))
            return
        stamp = stamp_of(values)
        self.logged.append(message.log_ns)
        self.stamped.append(NO_STAMP if stamp is None else stamp)

    def malformed(self, problem: str) -> None:
        """Count a message that cannot be used."""
        self.num_malformed += 1
        self.first_problem = self.first_problem or problem

    def _add_vector(self, vector: NDArray[np.floating[Any]]) -> None:
        if self.dtype is None:
            self.dtype = vector.dtype
        self.vectors += vector.astype(self.dtype, copy=False).data

    def __len__(self) -> int:
        return len(self.logged)

    @property
    def topic(self) -> str:
        """Topic of its messages."""
        return self.part.topic

    @property
    def log_ns(self) -> NDArray[np.int64]:
        """(N,) log time of each."""
        return np.asarray(self.logged)

    @property
    def header_ns(self) -> NDArray[np.int64]:
        """(N,) header time of each, or NO_STAMP."""
        return np.asarray(self.stamped)

    @property
    def names(self) -> tuple[str, ...]:
        """(D,) names of a source's elements, set by its first message; empty for cameras."""
        return self.reader.names if self.reader else ()

    @property
    def unit(self) -> Unit:
        """Unit of the numbers; "" for cameras."""
        return self.part.unit if isinstance(self.part, Source) else ""

    @property
    def are_keyframes(self) -> NDArray[np.bool_]:
        """(N,) whether each image can be decoded independently; empty except for cameras."""
        return np.array([head.is_keyframe for head in self.heads], bool)

    @cached_property
    def values(self) -> NDArray[np.floating[Any]]:
        """(N, D) numbers of a source."""
        return np.frombuffer(self.vectors, self.dtype).reshape(len(self.logged), -1)


def _label(feature: str, source: Source, sources: Sequence[Source]) -> str:
    """Name of a feature, with the first joint if several of its sources share a topic."""
    is_shared = source.joints and sum(other.topic == source.topic for other in sources) > 1
    return f"{feature} ({source.joints[0]}{', ...' if len(source.joints) > 1 else ''})" if is_shared else feature


class BagStreams:
    """All data that a mapping takes from a bag.

    Attributes:
        all: Key -> stream, the sources of features before cameras.
        infos: Camera name -> its first calibration message.
        urdf: First robot description; None without one.
        problems: Reasons why parts of the bag could not be read.
    """

    def __init__(self, mapping: SourceMapping) -> None:
        self.problems: list[str] = []
        self.all: dict[Key, Stream] = {
            (name, index): Stream(label=_label(name, source, sources), part=source)
            for name, sources in mapping.features.items()
            for index, source in enumerate(sources)
            if source.topic
        }
        for name, camera in mapping.cameras.items():
            self.all[name] = Stream(label=f"camera {name}", part=camera)
        self._of_topic: dict[str, list[Stream]] = {}
        for stream in self.all.values():
            self._of_topic.setdefault(stream.topic, []).append(stream)
        self._urdf_topic = mapping.robot.urdf_topic
        self.urdf: Any = None
        self.infos: dict[str, Values] = {}
        self._info_topics = {camera.info_topic: name for name, camera in mapping.cameras.items() if camera.info_topic}
        self._wanted = {*self._of_topic, *self._info_topics, self._urdf_topic} - {""}
        self._counts: dict[str, int] = {}
        self._types: defaultdict[str, set[str]] = defaultdict(set)
        self._refused: dict[str, str] = {}

    def add(self, message: ScannedMessage) -> None:
        """Add a message."""
        topic = message.channel.topic
        number = self._counts.get(topic, 0)
        self._counts[topic] = number + 1
        self._types[topic].add(message.channel.type)
        if topic not in self._wanted or topic in self._refused:
            return
        streams = self._of_topic.get(topic, ())
        try:
            values = decode_message(message)
        except UnknownEncodingError as error:
            self._refused[topic] = str(error)
            return
        except (ValueError, RecursionError, OverflowError, TypeError) as error:
            for stream in streams:
                stream.malformed(str(error))
            return
        for stream in streams:
            stream.add(number, message, values)
        if topic == self._urdf_topic and self.urdf is None:
            self.urdf = values.get("data")
        if topic in self._info_topics:
            kept = {key: values[key] for key in _INFO_FIELDS if key in values}
            self.infos.setdefault(self._info_topics[topic], kept)

    def check(self, bag: Bag) -> None:
        """Raise BagError with everything that the mapping names and the bag lacks."""
        problems = []
        if not self._counts:
            unread = f" ({self.problems[0]})" if self.problems else ""
            raise BagError(f"The bag holds no messages{unread}: {bag.path}")
        for topic in sorted(self._wanted):
            if topic not in self._counts:
                problems.append(f"no message of {topic!r}.{nearest_match(topic, self._counts)}".rstrip("."))
            elif topic in self._refused:
                problems.append(f"{topic} cannot be read, since {self._refused[topic]}")
            elif len(self._types[topic]) > 1:
                problems.append(f"{topic} has messages of several types ({', '.join(sorted(self._types[topic]))})")
        for stream in self.all.values():
            if stream.topic in self._counts and stream.topic not in self._refused and not len(stream):
                reason = stream.first_problem or stream.first_refusal
                problems.append(f"{stream.label} cannot be taken from {stream.topic} ({stream.type}): {reason}")
        for stream in self.all.values():
            if stream.heads and not stream.are_keyframes.any():
                reason = stream.first_problem or "it has no keyframe with its parameter sets"
                problems.append(f"{stream.topic} cannot be decoded: {reason}")
        if problems:
            raise BagError(f"The mapping does not fit the bag: {listed(problems)}: {bag.path}")


def read_streams(bag: Bag, mapping: SourceMapping) -> BagStreams:
    """Read a whole bag; BagError with all problems if the mapping does not fit it."""
    streams = BagStreams(mapping)
    for message in bag.messages(streams.problems):
        streams.add(message)
    streams.check(bag)
    return streams
