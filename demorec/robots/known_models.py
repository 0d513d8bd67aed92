"""Where on this machine the URDFs are whose text recordings hold.

A recording has no paths. So that its robot can be drawn with its meshes on the machine on which it was recorded or
imported, the cache folder keeps, for each text, the file that it came from.
"""

from __future__ import annotations

import hashlib
from contextlib import suppress
from pathlib import Path

from demorec.core.files import cache_folder, write_whole


def remember_model(description: str, urdf: Path) -> None:
    """Keep that a recorded description comes from this file; a cache that cannot be written only costs the meshes."""
    text = str(urdf.resolve())
    with suppress(OSError, UnicodeError):
        write_whole(_place(description), lambda temporary: temporary.write_text(text))


def known_model(description: str) -> Path | None:
    """The file that a recorded description comes from; None if it is not known or has gone."""
    with suppress(OSError, ValueError):
        path = Path(_place(description).read_text())
        return path if path.is_file() else None
    return None


def _place(description: str) -> Path:
    return cache_folder("robots") / hashlib.sha256(description.encode()).hexdigest()[:32]
