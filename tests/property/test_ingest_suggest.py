"""Suggested mappings are valid TOML for any names of topics, joints and frames; `tomllib` verifies."""

from __future__ import annotations

import io
import json
import tempfile
import tomllib
import unicodedata
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from mcap.writer import Writer
from support import bags
from support.bags import EPOCH_NS, Note

from demorec.cli import main

TEXTS = st.text(min_size=1, max_size=12)
ODD = [
    "\x00",
    '"',
    "\\",
    "\n\r\t\b\f",
    "\x1b[2J",
    "\x7f",
    "\x85",
    "\xad",
    "\u2028",
    "\u202e",
    "\ufeff",
    "\U000e0001",
    "é",
    "関節",
]


def _suggestion(bag: Path) -> str:
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err), pytest.raises(SystemExit) as ended:
        main(["import", "--suggest", str(bag)])
    assert not ended.value.code, err.getvalue()
    return out.getvalue()


@pytest.mark.slow
@settings(max_examples=30)
@given(TEXTS, st.lists(TEXTS, min_size=2, max_size=4, unique=True), TEXTS)
@example("odd" + "".join(ODD), ODD, "".join(ODD))
def test_a_suggestion_is_toml_and_names_existing_topics(topic: str, joints: list[str], frame: str) -> None:
    moments = [EPOCH_NS + k * 20_000_000 for k in range(3)]
    notes = bags.joints(topic, joints, moments)
    notes += [
        Note(topic=f"{topic}/tf", type="tf2_msgs/msg/TFMessage", log_ns=moment, header_ns=moment,
             body={"transforms": [{"child_frame_id": frame}]})
        for moment in moments
    ]  # fmt: skip
    notes += bags.jpeg_images(f"{topic}/image", moments, 0, frame)
    notes += [
        Note(topic=f"{topic}{frame}", type="std_msgs/msg/String", log_ns=moments[0], header_ns=0, body={"data": frame})
    ]
    with tempfile.TemporaryDirectory() as folder:
        text = _suggestion(bags.write_mcap(bags.in_order(notes), Path(folder) / "bag.mcap"))
    assert not {unicodedata.category(sign) for sign in text.replace("\n", "")} & {"Cc", "Cf", "Zl", "Zp"}
    mapping = tomllib.loads(text)
    (camera,) = mapping["cameras"].values()
    assert camera["topic"] == f"{topic}/image"
    sources = [source for parts in mapping.get("features", {}).values() for source in parts if "topic" in source]
    assert all(source["topic"] == topic and source["joints"] == joints for source in sources)


WORDS = st.sampled_from(
    ["q", "position", "orientation", "name", "points", "positions", "transforms", "child_frame_id", "transform", "data",
     "linear", "angular", "gripper", "x", "command", "header", "stamp", "joint_names", "actual", "desired"]
)  # fmt: skip
JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=3),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(WORDS, inner, max_size=4),
    max_leaves=12,
)


@pytest.mark.slow
@settings(max_examples=60)
@given(st.lists(st.dictionaries(WORDS, JSON, max_size=5), min_size=1, max_size=4), st.sampled_from(["/state", "/cmd"]))
@example([{"name": ["a"], "position": [1.0]}, {"name": [[1], {}], "position": [[1.0], [2.0, 3.0]]}], "/state")
@example([{"position": [[1.0], [2.0, 3.0]], "points": [{"positions": [[1], []]}, 3]}], "/cmd")
def test_messages_of_any_shape_are_suggested_or_left_out(messages: list[dict[str, object]], topic: str) -> None:
    """JSON has any shape, and two messages may differ."""
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / "bag.mcap"
        with bag.open("wb") as file:
            writer = Writer(file)
            writer.start()
            channel = writer.register_channel(topic, "json", writer.register_schema("State", "jsonschema", b"{}"))
            for number, message in enumerate(messages):
                writer.add_message(channel, EPOCH_NS + number, json.dumps(message).encode(), EPOCH_NS + number)
            writer.finish()
        tomllib.loads(_suggestion(bag))
