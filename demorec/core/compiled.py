"""Numba's compiler for the kernel modules, without loading SciPy at the first kernel.

Numba imports SciPy's linear algebra (0.1 CPU s, 16 MB) to find out whether np.convolve and np.correlate may use BLAS.
No kernel here calls them, and without BLAS they add up products themselves. np.dot and np.linalg repeat the check when
they are compiled.
"""

from __future__ import annotations

import sys
from typing import Any

import numba
from numba.np import linalg

njit: Any = numba.njit


def _has_no_blas() -> None:
    raise ImportError("not looked for")


if "scipy.linalg" not in sys.modules and hasattr(linalg, "ensure_blas"):  # a private name: other versions may lack it
    _ensure_blas, linalg.ensure_blas = linalg.ensure_blas, _has_no_blas
    try:
        import numba.np.arraymath
    finally:
        linalg.ensure_blas = _ensure_blas
