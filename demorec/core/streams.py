"""Standard streams that a program can rely on even if the shell has closed them."""

from __future__ import annotations

import os
import sys


def open_closed_streams() -> None:
    """Connect each standard stream that the shell has closed (`<&-`, `>&-`, `2>&-`) to the null device.

    Otherwise the next file that is opened would take its number, and receive what libraries print.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            opened = os.open(os.devnull, os.O_RDWR)
            if opened != number:
                os.dup2(opened, number)
                os.close(opened)
            os.set_inheritable(number, True)
        if getattr(sys, name) is None:  # as Python does for a missing stream
            stream = os.fdopen(number, "w" if number else "r", closefd=False)
            setattr(sys, name, stream)
            setattr(sys, f"__{name}__", stream)


def drop_output(number: int) -> None:
    """Connect a standard stream that cannot be written to the null device.

    Otherwise flushing its buffer would fail again at exit, with a traceback and Python's exit code.
    """
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, number)
    os.close(nowhere)
