"""The user's cache folder, which several processes share."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import platformdirs

from demorec.core.files import open_locked


def cache_folder(*parts: str) -> Path:
    """A folder below the user's cache folder, created when missing; `DEMOREC_CACHE` moves it elsewhere."""
    root = os.environ.get("DEMOREC_CACHE") or platformdirs.user_cache_dir("demorec", appauthor=False)
    folder = Path(root).joinpath(*parts)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        # A home that cannot be written to (containers): work goes on, and is lost with the temporary folder.
        folder = Path(tempfile.gettempdir()).joinpath(f"demorec-{os.getuid()}", *parts)
        folder.mkdir(parents=True, exist_ok=True)
    return folder


def write_whole(path: Path, write: Callable[[Path], object]) -> None:
    """Let `write` fill a temporary file beside `path`, then move it there: readers see all of it or nothing."""
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=path.stem, suffix=path.suffix)
    os.close(handle)
    temporary = Path(name)
    try:
        write(temporary)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def folder_lock(folder: Path) -> Iterator[None]:
    """Hold a lock between processes for as long as the context lasts; the system frees it if the process dies.

    A folder that cannot be written to is not locked: nothing will be kept in it.
    """
    try:
        descriptor = open_locked(folder / "lock", waits=True)
    except OSError:
        yield
        return
    try:
        yield
    finally:
        os.close(descriptor)
