"""`demorec info` lists the topics of any bag as `rosbags` counts them."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest
from rosbags.rosbag1 import Reader as Ros1Reader
from rosbags.rosbag2 import Reader as Ros2Reader
from support import bags
from support.commands import exit_code


@pytest.fixture(scope="module")
def notes() -> bags.Notes:
    """Messages of topics that do not belong to an arm, so no mapping can be suggested."""
    found = bags.in_order(bags.so101(1.0))
    return [note for note in found if "joint" not in note.topic]


@pytest.mark.parametrize("kind", ["ros1", "rosbag2"])
def test_topics_types_counts_rates_and_span(
    kind: str, notes: bags.Notes, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = bags.write_ros1(notes, tmp_path / "x.bag") if kind == "ros1" else bags.write_rosbag2(notes, tmp_path / "x")
    assert exit_code("info", path, "--json") == 0
    plain = json.loads(capsys.readouterr().out)
    with Ros1Reader(path) if kind == "ros1" else Ros2Reader(path) as reader:
        expected = {topic: (info.msgtype, info.msgcount) for topic, info in reader.topics.items()}
        span_s = (reader.end_time - reader.start_time) / 1e9
    assert {row["topic"]: (row["type"], row["messages"]) for row in plain["topics"]} == expected
    assert plain["messages"] == len(notes)
    assert plain["seconds"] == pytest.approx(span_s, abs=1e-6)
    by_topic = Counter(note.topic for note in notes)
    for row in plain["topics"]:
        times = [note.log_ns for note in notes if note.topic == row["topic"]]
        assert row["rate"] == pytest.approx((by_topic[row["topic"]] - 1) / (max(times) - min(times)) * 1e9)
    assert exit_code("info", path) == 0
    printed = capsys.readouterr().out
    for topic, (type_name, count) in expected.items():
        assert any(line.split()[:2] == [topic, str(count)] and type_name in line for line in printed.splitlines())


def test_a_truncated_bag_is_listed_up_to_its_end(
    notes: bags.Notes, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = bags.write_mcap(notes, tmp_path / "x.mcap", chunk_size=10_000)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    assert exit_code("info", path, "--json") == 0
    plain = json.loads(capsys.readouterr().out)
    assert 0 < plain["messages"] < len(notes)
    assert plain["problems"]


def test_messages_without_a_log_time_are_not_in_the_length(
    notes: bags.Notes, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    times = [note.log_ns for note in notes[2:]]
    path = bags.write_mcap([replace(note, log_ns=0) for note in notes[:2]] + notes[2:], tmp_path / "x.mcap")
    assert exit_code("info", path, "--json") == 0
    plain = json.loads(capsys.readouterr().out)
    assert plain["seconds"] == pytest.approx((max(times) - min(times)) / 1e9)
    assert plain["messages"] == len(notes)
    assert any(f"{notes[0].topic}: messages without a log time" in problem for problem in plain["problems"])


@pytest.mark.parametrize("command", ["info", "check", "view", "import"])
def test_a_text_file_is_not_mcap(command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "Dockerfile.mcap"
    path.write_text("FROM ros:jazzy\nRUN apt-get update\n")
    flags: dict[str, list[object]] = {"view": ["--save", tmp_path / "x.rrd"], "import": ["--suggest"]}
    assert exit_code(command, path, *flags.get(command, [])) in (1, 2)
    printed = capsys.readouterr()
    assert "not an MCAP file" in printed.out + printed.err
    assert "demorec made" not in printed.out + printed.err
    assert "cannot be computed" not in printed.out


def test_no_mapping_is_offered_for_a_bag_without_messages(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = bags.write_mcap([], tmp_path / "empty.mcap")
    assert exit_code("info", path) == 0
    printed = capsys.readouterr().out
    assert "0 messages" in printed
    assert "--suggest" not in printed
