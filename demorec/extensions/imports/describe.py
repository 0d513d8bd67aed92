"""Output of `demorec info` about bags and HDF5 files, and about the bags that an import left out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from demorec.cli.shared.output import aligned, counted, size_in_words
from demorec.extensions.imports.bag import NS, TopicSummary, bags_in, open_bag
from demorec.extensions.imports.import_file import load_import_file

_MOST_PROBLEMS = 5
"""Maximum problems listed for a bag or file."""
_EPOCH_NS = 10**17
"""Times beyond it (1973) are of the Unix epoch, not of a simulation."""


def describe_bags(path: Path) -> tuple[dict[str, Any], list[str]]:
    """Describe a bag, or each bag of a folder."""
    found = [_bag(bag) for bag in bags_in(path)]
    if len(found) == 1:
        return found[0]
    plain = {"kind": "bags", "path": str(path), "bags": [plain for plain, _ in found]}
    lines = [f"{len(found)} bags in {path}"]
    for _, described in found:
        lines += ["", *described]
    return plain, lines


def _bag(path: Path) -> tuple[dict[str, Any], list[str]]:
    """Describe the readable part of a bag with the message count of each topic."""
    bag = open_bag(path)
    problems: list[str] = []
    topics: dict[str, TopicSummary] = {}
    for message in bag.messages(problems):
        topic = topics.setdefault(message.channel.topic, TopicSummary(type=message.channel.type))
        topic.add(message.log_ns)
    last_ns = max((topic.last_ns for topic in topics.values()), default=0)
    first_ns = min([last_ns, *(topic.first_ns for topic in topics.values())])
    at_0 = {name: topic.num_at_0 for name, topic in sorted(topics.items()) if topic.num_at_0}
    if first_ns > _EPOCH_NS:
        problems += [f"{name}: messages without a log time, left out of the length: {n}" for name, n in at_0.items()]
    elif at_0:  # simulated time begins at 0
        first_ns = 0
    seconds, count = (last_ns - first_ns) / NS, sum(topic.count for topic in topics.values())
    facts = [
        ("bag", f"{path} ({size_in_words(bag.num_bytes)})"),
        ("length", f"{seconds:.2f} s, {counted(count, 'message')}"),
        *(("problem", problem) for problem in problems[:_MOST_PROBLEMS]),
    ]
    rows = [("topic", "messages", "rate", "type")]
    plain = []
    for name, topic in sorted(topics.items()):
        plain.append({"topic": name, "type": topic.type, "messages": topic.count, "rate": topic.rate_hz})
        rows.append((name, str(topic.count), f"{topic.rate_hz:.1f} Hz" if topic.rate_hz else "", topic.type))
    lines = aligned(facts)
    if topics:
        lines += ["", *aligned(rows), "", f"demorec import {path} --suggest writes a mapping of these topics."]
    described = {"kind": "bag", "path": str(path), "bytes": bag.num_bytes, "seconds": seconds, "messages": count}
    return {**described, "topics": plain, "problems": problems}, lines


def describe_hdf5(path: Path) -> tuple[dict[str, Any], list[str]]:
    """Describe an HDF5 file by its first episode."""
    from demorec.extensions.imports.hdf5_suggest import summarize_hdf5  # needs h5py

    plain = summarize_hdf5(path)
    suggest = f"demorec import hdf5 {path} --suggest > mapping.toml"
    layout_is_known, rate = plain["episodes"] is not None, plain["rate"]
    facts = [("HDF5 file", f"{path} ({size_in_words(plain['bytes'])})")]
    length = f"{counted(plain['episodes'], 'episode')}, {plain['rows']} rows" if layout_is_known else "unknown layout"
    facts.append(("length", length))
    missing = "unknown: write fps under [clock] in the mapping, and give it to the import by --mapping"
    facts.append(("rate", missing if rate is None else f"{rate:g} Hz"))
    facts += [("problem", problem) for problem in plain["problems"][:_MOST_PROBLEMS]]
    rows = [("dataset", "type", "shape")]
    rows += [(one["dataset"], one["dtype"], "x".join(map(str, one["shape"]))) for one in plain["datasets"]]
    end = (
        f"{suggest} writes a mapping of these datasets." if layout_is_known else "docs/import.md explains the mapping."
    )
    return plain, [*aligned(facts), "", *aligned(rows), "", end]


def dropped_rows(path: Path) -> list[dict[str, str]]:
    """Bags that an import left out of the run, each with its reason."""
    imported = load_import_file(path)
    skipped = imported.skipped if imported else ()
    return [{"bag": bag.name, "what": "the bag", "reason": bag.reason} for bag in skipped]
