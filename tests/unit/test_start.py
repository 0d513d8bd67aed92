"""Ctrl-C while a program loads: an exit code and no traceback."""

from __future__ import annotations

import subprocess
import sys

import pytest

INTERRUPTED_WHILE_LOADING = """
import sys

class Interrupts:
    def find_spec(self, name, path=None, target=None):
        if name == "demorec.cli":
            raise KeyboardInterrupt

sys.meta_path.insert(0, Interrupts())
from demorec.__main__ import {program}
{program}()
"""


@pytest.mark.parametrize("program", ["main", "generate_dataset"])
def test_ctrl_c_while_it_loads(program: str) -> None:
    code = INTERRUPTED_WHILE_LOADING.format(program=program)
    process = subprocess.run([sys.executable, "-c", code], check=False, capture_output=True, text=True)
    assert (process.returncode, process.stdout, process.stderr) == (130, "", "")


def test_python_m_demorec() -> None:
    process = subprocess.run(
        [sys.executable, "-m", "demorec", "--version"], check=False, capture_output=True, text=True
    )
    assert (process.returncode, process.stderr) == (0, "")
    assert process.stdout.startswith("demorec ")
