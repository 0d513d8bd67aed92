"""Words of mappings: tasks in names of files, which are foreign, and names that are free."""

from __future__ import annotations

import subprocess
import sys


def test_long_numbers_do_not_hold_it_up() -> None:
    name = "1" * 200 + "a"
    program = f"from demorec.sources.words import task_in_name; print(task_in_name({name!r}))"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.strip() == name
