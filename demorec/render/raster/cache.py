"""Decimated meshes and compiled code, kept between runs in the user's cache folder, which several processes share."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import logging
import os
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import platformdirs

from demorec.render.raster.mesh import RasterMesh


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
    import fcntl

    try:
        file = (folder / "lock").open("a")
    except OSError:
        yield
        return
    with file:
        fcntl.flock(file, fcntl.LOCK_EX)
        try:
            yield
        finally:
            fcntl.flock(file, fcntl.LOCK_UN)


log = logging.getLogger(__name__)
_SOURCES = ("mesh.py", "mesh_files.py", "decimate.py", "textures.py")


@functools.cache
def _version() -> str:
    """Digest of the code that makes meshes: another version reads nothing of this one's."""
    digest = hashlib.sha256()
    for name in _SOURCES:
        digest.update((Path(__file__).parent / name).read_bytes())
    return digest.hexdigest()[:16]


def cached_mesh(key: str, make: Callable[[], RasterMesh]) -> RasterMesh:
    """The mesh that `make` makes, from the cache when it was made before under this key.

    A file that cannot be read, whatever the reason, is made anew; a folder that cannot be written to costs time only.
    Of several processes that ask at once, one makes it and the others wait.
    """
    name = hashlib.sha256(key.encode()).hexdigest()[:32]
    path = cache_folder("meshes", _version()) / f"{name}.npz"
    mesh = _read(path)
    if mesh is not None:
        return mesh
    with folder_lock(path.parent):
        mesh = _read(path)
        return mesh if mesh is not None else _make(path, make)


def _make(path: Path, make: Callable[[], RasterMesh]) -> RasterMesh:
    mesh = make()
    arrays = {"points": mesh.points, "faces": mesh.faces, "normals": mesh.normals, "colors": mesh.colors}
    if mesh.uv is not None:
        arrays["uv"] = mesh.uv
    arrays["texture"] = np.array("" if mesh.texture is None else str(mesh.texture))
    try:
        write_whole(path, lambda temporary: np.savez(temporary, **arrays))  # type: ignore[arg-type]
    except OSError as error:
        log.warning("The mesh cache cannot be written (%s): %s", error.strerror, path)
    return mesh


def _read(path: Path) -> RasterMesh | None:
    try:
        with np.load(path) as data:
            texture = str(data["texture"])
            return RasterMesh(
                points=data["points"],
                faces=data["faces"],
                normals=data["normals"],
                uv=data["uv"] if "uv" in data.files else None,
                colors=data["colors"],
                texture=Path(texture) if texture else None,
            )
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
