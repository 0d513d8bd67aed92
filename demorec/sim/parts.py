"""The convex parts that a solid collides as, where nobody has said them: its hull, or what V-HACD cuts it into."""

from __future__ import annotations

import functools
import hashlib
import tempfile
from pathlib import Path

import numpy as np

from demorec.core.cache import cache_folder, write_whole
from demorec.core.errors import SceneError
from demorec.core.geometry import Array
from demorec.episode.mesh import UNIT, SolidMesh, decode_mesh, encode_mesh
from demorec.sim.client import silence

HULL_IS_RIGHT = 1.1
"""Volume of the hull over that of the solid up to which the hull is taken."""


def with_parts(mesh: SolidMesh) -> SolidMesh:
    """The solid with convex parts, found once for each content and kept in the user's cache folder."""
    return mesh if mesh.parts else decode_mesh(_found(mesh.surface_obj(), mesh))


@functools.lru_cache(maxsize=1024)
def _found(surface: str, mesh: SolidMesh) -> str:
    hull = SolidMesh(points=mesh.points, faces=mesh.faces, parts=(np.unique(mesh.faces),))
    from scipy.spatial import ConvexHull  # takes a while to load

    if ConvexHull(mesh.points).volume < HULL_IS_RIGHT * mesh.mass_properties()[0]:
        return encode_mesh(hull)
    path = cache_folder("objects") / f"{hashlib.sha256(surface.encode()).hexdigest()[:32]}.parts"
    try:
        text = path.read_text()
        decode_mesh(text)
    except (OSError, SceneError, UnicodeDecodeError):
        text = encode_mesh(_cut(surface, mesh))
        write_whole(path, lambda temporary: temporary.write_text(text))
    return text


def _cut(surface: str, mesh: SolidMesh) -> SolidMesh:
    import pybullet

    with tempfile.TemporaryDirectory(prefix="demorec_") as folder:
        source, target, log = (Path(folder) / name for name in ("mesh.obj", "parts.obj", "log.txt"))
        source.write_text(surface)
        with silence():
            pybullet.vhacd(
                str(source), str(target), str(log), resolution=50_000, concavity=0.0025, maxNumVerticesPerCH=32
            )
        parts = _parts(target)
    starts = np.cumsum([len(mesh.points), *map(len, parts)]).tolist()
    return SolidMesh(
        points=np.concatenate([mesh.points, *parts]),
        faces=mesh.faces,
        parts=tuple(np.arange(start, start + len(part)) for start, part in zip(starts, parts, strict=False)),
    )


def _parts(path: Path) -> list[Array]:
    """The points of each object of V-HACD's file, rounded to what is stored."""
    parts: list[list[list[float]]] = []
    for line in path.read_text().splitlines():
        if line.startswith("o "):
            parts.append([])
        elif line.startswith("v "):
            parts[-1].append([float(word) for word in line.split()[1:4]])
    return [np.unique(np.round(np.array(part) / UNIT), axis=0) * UNIT for part in parts]
