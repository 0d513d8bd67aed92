"""Compilation of the kernels: flags that keep every bit, and a cache that is invalidated when sources change."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import llvmlite.binding
import numba
import numpy as np

from demorec.core.compiled import njit
from demorec.core.files import cache_folder

# Only flags that change no finite result: images are equal for any vector width of the CPU. `contract`, `arcp` and
# `reassoc` are excluded on purpose.
_FLAGS = {"nnan", "ninf", "nsz"}

f4 = np.float32
f8 = np.float64
i4 = np.int32
u4 = np.uint32
index = np.uintp  # an unsigned index avoids the test for negative ones


@functools.cache
def compiled_folder() -> Path:
    """Create the cache of compiled code, one folder per state and location of the sources, numba and kind of CPU.

    numba recompiles when a kernel's own file has moved or its modification time has changed, but not when the files of
    functions inlined into it have changed. The folder name covers all of that, so that it is complete or empty.
    """
    digest = hashlib.sha256(f"{numba.__version__} {llvmlite.binding.get_host_cpu_name()}".encode())
    for path in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(f"{path} {path.stat().st_mtime_ns} ".encode() + path.read_bytes())
    return cache_folder("compiled", digest.hexdigest()[:16])


def kernel(function: Callable[..., Any], **options: Any) -> Any:
    """Compile a function on first use, cached on disk."""
    # numba reads the folder while decorating; its own setting is restored for other users of numba.
    before = numba.config.CACHE_DIR
    numba.config.CACHE_DIR = str(compiled_folder())
    try:
        return njit(cache=True, fastmath=_FLAGS, error_model="numpy", **options)(function)
    finally:
        numba.config.CACHE_DIR = before


def inlined(function: Callable[..., Any]) -> Any:
    """Compile a function into each kernel that calls it."""
    return kernel(function, forceinline=True)
