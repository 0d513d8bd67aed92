"""Decimated meshes, kept between runs in the user's cache folder."""

from __future__ import annotations

import functools
import hashlib
import logging
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from demorec.core.cache import cache_folder, folder_lock, write_whole
from demorec.render.raster.mesh import RasterMesh

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
