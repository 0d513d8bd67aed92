"""Suggested mappings are TOML whatever a bag's topics, joints and frames are called; `tomllib` judges."""

from __future__ import annotations

import io
import tempfile
import tomllib
import unicodedata
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from support import bags
from support.bags import EPOCH_NS, Note, Notes

from demorec.cli import main
from demorec.ingest.words import quoted

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


def _suggested(notes: Notes) -> str:
    with tempfile.TemporaryDirectory() as folder:
        bag = bags.write_mcap(notes, Path(folder) / "bag.mcap")
        out = io.StringIO()
        with redirect_stdout(out), redirect_stderr(io.StringIO()), pytest.raises(SystemExit) as ended:
            main(["import", "--suggest", str(bag)])
        assert not ended.value.code
    return out.getvalue()


@settings(deadline=None, max_examples=60)
@given(TEXTS, st.lists(TEXTS, min_size=2, max_size=4, unique=True), TEXTS)
@example("odd" + "".join(ODD), ODD, "".join(ODD))
def test_a_suggestion_is_toml_and_names_what_is_there(topic: str, joints: list[str], frame: str) -> None:
    moments = [EPOCH_NS + k * 20_000_000 for k in range(3)]
    notes = bags.joints(topic, joints, moments)
    notes += [
        Note(topic=f"{topic}/tf", type="tf2_msgs/msg/TFMessage", log_ns=moment, header_ns=moment,
             body={"transforms": [{"child_frame_id": frame}]})
        for moment in moments
    ]  # fmt: skip
    notes += bags.jpeg_pictures(f"{topic}/image", moments, 0, frame)
    notes += [
        Note(topic=f"{topic}{frame}", type="std_msgs/msg/String", log_ns=moments[0], header_ns=0, body={"data": frame})
    ]
    text = _suggested(bags.in_order(notes))
    assert not {unicodedata.category(sign) for sign in text.replace("\n", "")} & {"Cc", "Cf", "Zl", "Zp"}
    mapping = tomllib.loads(text)
    (camera,) = mapping["cameras"].values()
    assert camera["topic"] == f"{topic}/image"
    sources = [source for parts in mapping.get("features", {}).values() for source in parts if "topic" in source]
    assert all(source["topic"] == topic and source["joints"] == joints for source in sources)
    plain = "\n".join(
        line.removeprefix("# ") for line in text.split("\n") if line.startswith(("# [[", "# topic", "# field"))
    )
    tomllib.loads(plain)


@given(st.text())
def test_a_text_comes_back_from_toml(text: str) -> None:
    line = quoted(text)
    assert tomllib.loads(f"x = {line}")["x"] == text
    assert line.isprintable()


def test_half_a_character_becomes_a_replacement() -> None:
    """JSON and file names may hold surrogates, TOML cannot."""
    assert tomllib.loads(f"x = {quoted('a' + chr(0xDC80))}")["x"] == "a\ufffd"
