"""The topics of a bag: types, counts, rates and span, for `demorec info`; no message is decoded."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

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


def summarize_bag(path: Path) -> dict[str, Any]:
    """Read a bag as far as it can be read, and count the messages of each topic, as `demorec info --json` prints it.

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
    first_ns = min((topic.first_ns for topic in topics.values()), default=0)
    last_ns = max((topic.last_ns for topic in topics.values()), default=0)
    return {
        "kind": "bag",
        "path": str(path),
        "bytes": bag.num_bytes,
        "seconds": (last_ns - first_ns) / NS,
        "messages": sum(topic.count for topic in topics.values()),
        "topics": [
            {"topic": name, "type": topic.type, "messages": topic.count, "rate": topic.rate_hz}
            for name, topic in sorted(topics.items())
        ],
        "problems": problems,
    }
