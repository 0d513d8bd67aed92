"""demorec: robot demonstrations people can trust."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from demorec.api import Recorder

__all__ = ["Recorder"]


def __getattr__(name: str) -> Any:
    """Load `Recorder` for `from demorec import Recorder`; other imports do not pay for it."""
    if name == "Recorder":
        from demorec import api

        return api.Recorder
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
