"""The first moments of a program: Ctrl-C while it loads is an exit code and no traceback."""

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

COMPILED = """
import sys
import numpy as np
from demorec.core.compiled import njit

@njit
def add(a, b):
    return a + b

a, b = np.array([1.0, 2.0, 3.0]), np.array([4.0, 5.0, 6.0])
assert add(a, b).tolist() == [5, 7, 9]
print("scipy.linalg" in sys.modules)
assert njit(lambda a, b: np.dot(a, b))(a, b) == 32
assert njit(lambda a, b: np.convolve(a, b))(a, b).tolist() == [4, 13, 28, 27, 18]
"""


def test_kernels_start_without_scipy_and_other_peoples_have_all_of_numba() -> None:
    process = subprocess.run([sys.executable, "-c", COMPILED], check=False, capture_output=True, text=True)
    assert (process.returncode, process.stdout, process.stderr) == (0, "False\n", "")


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
