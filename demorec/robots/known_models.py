"""Local paths of the URDFs stored as text in recordings.

A recording has no paths. To draw its robot with meshes on the machine where it was recorded or imported, the cache
folder stores the source file of each text.
"""

from __future__ import annotations

import hashlib
from contextlib import suppress
from pathlib import Path

from demorec.core.files import cache_folder, write_whole


def remember_model(description: str, urdf: Path) -> None:
    """Store the file that a recorded description comes from; an unwritable cache only loses the meshes."""
    text = str(urdf.resolve())
    with suppress(OSError, UnicodeError):
        write_whole(_place(description), lambda temporary: temporary.write_text(text))


def known_model(description: str) -> Path | None:
    """Return the file that a recorded description comes from; None if unknown or deleted."""
    with suppress(OSError, ValueError):
        path = Path(_place(description).read_text())
        return path if path.is_file() else None
    return None


def _place(description: str) -> Path:
    return cache_folder("robots") / hashlib.sha256(description.encode()).hexdigest()[:32]
