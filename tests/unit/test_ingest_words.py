"""Words of mappings: tasks in names of files, which are foreign, and names that are free."""

from __future__ import annotations

import subprocess
import sys

import pytest

from demorec.sources.words import task_in_name, unique_name


@pytest.mark.parametrize(
    ("name", "task"),
    [
        ("stack_the_cups_003", "stack the cups"),
        ("stack-the-cups", "stack the cups"),
        ("open_drawer_2024-01-03_11.30", "open drawer"),
        ("pick 2 cups 7", "pick 2 cups"),
        ("episode0", "episode"),
        ("0012", ""),
    ],
)
def test_a_name_tells_its_task(name: str, task: str) -> None:
    assert task_in_name(name) == task


def test_long_numbers_do_not_hold_it_up() -> None:
    name = "1" * 200 + "a"
    program = f"from demorec.sources.words import task_in_name; print(task_in_name({name!r}))"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.strip() == name


def test_taken_names_are_told_apart() -> None:
    assert unique_name("top", ["front"]) == "top"
    assert unique_name("top", ["top", "top_2"]) == "top_2_2"
