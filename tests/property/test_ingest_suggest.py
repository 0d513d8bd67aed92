"""Suggested mappings are valid TOML for any names of topics, joints and frames; `tomllib` verifies."""

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
from support.bags import EPOCH_NS, Note

from demorec.cli import main

TEXTS = st.text(min_size=1, max_size=12)
ODD = ["\x00", '"', "\\", "\n\r\t\b\f", "\x1b[2J", "\x85", "\u2028", "\u202e", "\U000e0001", "é", "関節"]


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
