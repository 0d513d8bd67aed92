"""A bug in the user's task: the message ends with the line of the user's file that raised the error."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest
from support.commands import exit_code

from demorec.cli import generate_dataset_main
from demorec.core.own_versions import source_digest

DOCS = Path(__file__).parents[2] / "docs" / "tasks.md"
SCRIPT = """
    def script(self, expert):
        yield from expert.pick_and_place(
            expert.world.scene.goals[3],
        )
"""
EVALUATE = """
    def evaluate(self, world):
        return (world.pose("no such body"),)
"""


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The task of docs/tasks.md, in the user's folder."""
    (source,) = (
        text for text in re.findall(r"```python\n(.*?)```", DOCS.read_text(), re.DOTALL) if "ToTheLeft(P" in text
    )
    file = tmp_path / "left_tasks.py"
    file.write_text(source)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    for name in ("left_tasks", "left_helpers"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    source_digest.cache_clear()
    return file


@pytest.mark.slow
@pytest.mark.parametrize(
    ("old", "new", "code", "says"),
    [
        ("color=color)\n", "colour=color)\n", 'return wording(rng, "move the', "KeyError: 'color'"),
        ("", SCRIPT, "expert.world.scene.goals[3],", "IndexError: "),
        ("", EVALUATE, 'return (world.pose("no such body"),)', "KeyError: 'no such body'"),
    ],
)
def test_a_bug_in_a_task_is_named_by_its_line(
    old: str, new: str, code: str, says: str, module: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = module.read_text()
    assert old in text
    module.write_text(text.replace(old, new) if old else text + new)
    line = next(n for n, words in enumerate(module.read_text().splitlines(), 1) if words.strip().startswith(code))
    flags = ["--task", "left_tasks:ToTheLeft", "--num-episodes", "1", "--workers", "1", "--cameras", "none"]
    assert exit_code(*flags, "--out", tmp_path / "run", program=generate_dataset_main) == 1
    told = capsys.readouterr().err
    assert f"Episode 0 raised {says}" in told
    assert re.search(rf"; raised at left_tasks\.py:{line}: {re.escape(code)}[^\n]*\n$", told), told


@pytest.mark.parametrize(
    ("old", "new", "code"),
    [
        ("def instruction(self,", "def instruction(self;", "def instruction(self;"),
        ("STARTS = Region", "STARTS = Regionn", "STARTS = Regionn("),
        ("import numpy as np", "import no_such_package", "import no_such_package"),
    ],
)
def test_a_module_that_cannot_be_imported_is_named_by_its_line(
    old: str, new: str, code: str, module: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = module.read_text()
    assert old in text
    module.write_text(text.replace(old, new))
    line = next(n for n, words in enumerate(module.read_text().splitlines(), 1) if words.strip().startswith(code))
    flags = ["--task", "left_tasks:ToTheLeft", "--num-episodes", "1", "--out", tmp_path / "run"]
    assert exit_code(*flags, program=generate_dataset_main) == 2
    told = capsys.readouterr().err
    assert re.search(rf"cannot be imported \(.*\): mend left_tasks\.py:{line}: {re.escape(code)}[^\n]*\n$", told), told
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_a_missing_layout_is_reported(module: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = module.read_text()
    module.write_text(text.replace("        return Scene(", "        Scene("))
    flags = ["--task", "left_tasks:ToTheLeft", "--num-episodes", "1", "--workers", "1", "--cameras", "none"]
    assert exit_code(*flags, "--out", tmp_path / "run", program=generate_dataset_main) == 2
    assert (
        "sample_scene of the task 'left_tasks:ToTheLeft' returned NoneType; return a Scene" in capsys.readouterr().err
    )
