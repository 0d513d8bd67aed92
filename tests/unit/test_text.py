"""Third-party text has no effect on a terminal."""

from __future__ import annotations

import io
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from demorec.cli.shared.output import OutputError, say, tell
from demorec.core.text import printable


@given(st.text())
def test_no_control_characters_remain(text: str) -> None:
    shown = printable(text)
    assert not any(ord(character) < 0x20 or 0x7F <= ord(character) < 0xA0 for character in shown)
    assert not set(shown) & set("\u061c\u200e\u200f\u2028\u2029\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069")


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("\x1b[31mred\x1b[0m", "\\x1b[31mred\\x1b[0m"),
        ("one\nsecond line", "one\\nsecond line"),
        ("\u202egnp.exe", "\\u202egnp.exe"),
        ("\x9b2J", "\\x9b2J"),
        ("a\udcffb", "a\\udcffb"),
        ("\U000e0041", "\\U000e0041"),
        ("把红色方块放好 ✓", "把红色方块放好 ✓"),
    ],
)
def test_control_characters_are_escaped(text: str, shown: str) -> None:
    assert printable(text) == shown


def test_a_line_cannot_become_two(capsys: pytest.CaptureFixture[str]) -> None:
    say("task: a\ndigest: forged", "second")
    tell("b\x07")
    out, err = capsys.readouterr()
    assert out == "task: a\\ndigest: forged\nsecond\n"
    assert err == "b\\x07\n"


def test_a_terminal_of_another_alphabet_gets_what_it_can_show(monkeypatch: pytest.MonkeyPatch) -> None:
    raw = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(raw, encoding="ascii"))
    say("Würfel")
    assert raw.getvalue() == b"W\\xfcrfel\n"


def test_a_full_disk_behind_the_output_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    with open("/dev/full", "w") as full:  # noqa: PTH123 - a device, not a path of ours
        monkeypatch.setattr(sys, "stdout", full)
        with pytest.raises(OutputError, match="No space left"):
            say("x" * 10)
