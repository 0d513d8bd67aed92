"""Ctrl-C and SIGTERM while a run works: the first asks for an orderly end, the second ends at once."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from types import FrameType


class Interrupts:
    """How often the user has asked for the end."""

    def __init__(self) -> None:
        self.count = 0

    def handle(self, number: int, frame: FrameType | None) -> None:
        """Count the first, raise KeyboardInterrupt at the second."""
        self.count += 1
        if self.count > 1:
            raise KeyboardInterrupt


@contextmanager
def catch_interrupts() -> Iterator[Interrupts]:
    """Catch SIGINT and SIGTERM inside."""
    interrupts = Interrupts()
    with _handled(interrupts.handle, signal.SIGINT, signal.SIGTERM):
        yield interrupts


def terminate_as_interrupt() -> AbstractContextManager[None]:
    """Inside, SIGTERM raises KeyboardInterrupt as Ctrl-C does, so that every `finally` runs."""
    return _handled(signal.default_int_handler, signal.SIGTERM)


@contextmanager
def _handled(handler: Callable[[int, FrameType | None], None], *numbers: signal.Signals) -> Iterator[None]:
    """Handle signals like this inside; leaves them alone outside the main thread, where Python cannot catch them."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, usual in before.items():
            signal.signal(number, usual)
