"""The topics of a bag: types, counts, rates and span, for `demorec info`; no message is decoded."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from demorec.sources.bag import open_bag
from demorec.sources.bag_files import MAX_TIME_NS

NS = 1_000_000_000


@dataclass(kw_only=True)
class TopicSummary:
    """The messages of one topic.

    Attributes:
        type: Type of the messages, as the bag names it.
        count: Number of messages.
        first_ns, last_ns: Earliest and latest time of recording.
    """

    type: str
    count: int = 0
    first_ns: int = MAX_TIME_NS
    last_ns: int = 0

    @property
    def rate_hz(self) -> float:
        """Mean rate by the times of recording; 0 for fewer than two messages."""
        span_s = (self.last_ns - self.first_ns) / NS
        return (self.count - 1) / span_s if self.count > 1 and span_s > 0 else 0.0

    def add(self, time_ns: int) -> None:
        """Count a message that was recorded at this time."""
        self.first_ns, self.last_ns = min(self.first_ns, time_ns), max(self.last_ns, time_ns)
        self.count += 1


@dataclass(frozen=True, kw_only=True)
class BagSummary:
    """A bag as far as it can be read.

    Attributes:
        num_bytes: Size of its files.
        topics: Topic -> its messages, sorted by topic.
        problems: Why parts of it could not be read.
    """

    num_bytes: int
    topics: Mapping[str, TopicSummary]
    problems: tuple[str, ...]

    @property
    def num_messages(self) -> int:
        """Number of messages of all topics."""
        return sum(topic.count for topic in self.topics.values())

    @property
    def span_s(self) -> float:
        """Seconds from the first message to the last; 0 for none."""
        if not self.topics:
            return 0.0
        first_ns = min(topic.first_ns for topic in self.topics.values())
        last_ns = max(topic.last_ns for topic in self.topics.values())
        return (last_ns - first_ns) / NS


def summarize_bag(path: Path) -> BagSummary:
    """Read a bag to its end and count the messages of each topic.

    Raises:
        ConfigError: There is no bag.
        BagError: Its format is not read, or a file of it cannot be opened.
    """
    bag = open_bag(path)
    problems: list[str] = []
    topics: dict[str, TopicSummary] = {}
    for message in bag.messages(problems):
        topic = topics.setdefault(message.channel.topic, TopicSummary(type=message.channel.type))
        topic.add(message.log_ns)
    return BagSummary(num_bytes=bag.num_bytes, topics=dict(sorted(topics.items())), problems=tuple(problems))
