"""Findings about files that name `demorec dataset repair` are gone after it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from support.commands import exit_code
from support.doctor_bases import BASES
from support.doctor_judge import Bench, bench, check, findings_of

MENDED = (
    "never finalized",
    "total of frames",
    "length of an episode",
    "rows of the next episode",
    "row numbers",
    "instruction of another task",
    "deviation of the state",
    "tasks' statistics",
)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    """A sound dataset without cameras, which is quick to check."""
    return bench(BASES["panda"], tmp_path_factory.mktemp("bench"))


def named(answer: dict[str, Any]) -> list[str]:
    return [finding["message"] for finding in findings_of(answer) if finding["do"].startswith("demorec dataset repair")]


@pytest.mark.slow
@pytest.mark.parametrize("name", MENDED)
def test_repair_mends_what_names_it(name: str, made: Bench, tmp_path: Path) -> None:
    root = made.plant(name)
    assert named(check(root))
    assert exit_code("dataset", "repair", root, "--out", tmp_path / "sound") == 0
    assert named(check(tmp_path / "sound")) == []
