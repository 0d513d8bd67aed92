"""Object sets from a folder of the user's meshes."""

from __future__ import annotations

import functools
import io
import re
from collections.abc import Callable, Collection
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import ConfigError, describe_error
from demorec.core.files import open_regular
from demorec.core.geometry import Array
from demorec.core.tables import OBJECTS
from demorec.episode.mesh import MAX_EXTENT, MAX_POINTS, UNIT, SolidMesh
from demorec.episode.words import COLOR_WORDS
from demorec.objects.shelf import Kind, Shelf
from demorec.robots.shape_files import read_obj

SUFFIXES = (".obj", ".stl", ".glb")
MAX_BYTES = 50_000_000
WIDEST = 0.07
"""Maximum length of the narrowest side, metres; a hand of 8 cm can grip it."""


def load_shelf(name: str, allowed: Collection[str] = ()) -> Shelf:
    """Load a set from `OBJECTS`, or from a folder of meshes if its name contains a slash.

    Raises:
        ConfigError: As `Registry.load` or `folder_shelf`.
    """
    return folder_shelf(Path(name)) if "/" in name else OBJECTS.load(name, allowed)


@functools.lru_cache(maxsize=16)
def folder_shelf(folder: Path) -> Shelf:
    """Read a folder's .obj, .stl and .glb files, in metres; names that differ in numbers and colours are one kind.

    Raises:
        ConfigError: The folder does not exist, it has no such file, or one cannot be handled.
    """
    if not folder.is_dir():
        raise ConfigError(f"The folder of objects does not exist: {folder}")
    kinds: dict[str, list[Path]] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() in SUFFIXES:
            kinds.setdefault(_noun(path.stem), []).append(path)
    if not kinds:
        raise ConfigError(f"The folder of objects has no .obj, .stl or .glb file: {folder}")
    for files in kinds.values():
        for path in files:
            read_solid(path)
    return Shelf(
        kinds=tuple(
            Kind(noun=noun, material="plastic", shape=_reader(files), count=len(files)) for noun, files in kinds.items()
        )
    )


def _reader(files: list[Path]) -> Callable[[int], SolidMesh]:
    return lambda number: read_solid(files[number])


def _noun(stem: str) -> str:
    words = [word for word in re.findall("[a-z]+", stem.lower()) if word not in COLOR_WORDS]
    return "_".join(words) or "object"


@functools.lru_cache(maxsize=1024)
def read_solid(path: Path) -> SolidMesh:
    """Read the solid in a mesh file, in metres, without convex parts, its middle at the origin.

    Raises:
        ConfigError: The file cannot be read, or its mesh is open, huge, too wide or has too many points.
    """
    try:
        points, faces = _read(path)
    except Exception as error:  # trimesh raises many types
        raise ConfigError(f"The mesh cannot be read ({describe_error(error)}): {path}") from error
    if not len(faces) or not np.isfinite(points).all():
        raise ConfigError(f"The mesh has no triangles, or points that are not finite: {path}")
    extents = points.max(axis=0) - points.min(axis=0)
    size = " x ".join(f"{side:.3g}" for side in extents.tolist())
    if float(extents.max()) > MAX_EXTENT:
        raise ConfigError(f"The mesh is {size} m, the maximum is {MAX_EXTENT}: is it in millimetres? {path}")
    if float(extents.min()) > WIDEST:
        raise ConfigError(f"The mesh is {size} m, a gripper takes up to {WIDEST}: scale it down: {path}")
    grid = np.round((points - (points.max(axis=0) + points.min(axis=0)) / 2) / UNIT).astype(np.int64)
    welded, rows = np.unique(grid, axis=0, return_inverse=True)
    faces = rows.reshape(-1)[faces]
    faces = faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])]
    if len(welded) > MAX_POINTS or len(faces) > 2 * MAX_POINTS:
        raise ConfigError(f"The mesh has {len(welded):,} points, the maximum is {MAX_POINTS:,}: simplify it: {path}")
    solid = SolidMesh(points=welded * UNIT, faces=faces, parts=())
    if not solid.is_closed() or solid.mass_properties()[0] <= 0:
        raise ConfigError(f"The mesh is open or inside out, so it has no volume: close its surface: {path}")
    return solid


def _read(path: Path) -> tuple[Array, NDArray[np.int64]]:
    """Read (V, 3) points and (F, 3) triangles."""
    with open_regular(path) as file:
        data = file.read(MAX_BYTES + 1)
    if len(data) > MAX_BYTES:
        raise ValueError(f"the file has more than {MAX_BYTES:,} bytes")
    if path.suffix.lower() == ".obj":
        found = read_obj(path)
        return found.points, found.faces
    import trimesh  # takes a second to load

    kind = path.suffix.lower()[1:]
    mesh = trimesh.load(io.BytesIO(data), file_type=kind, force="mesh", process=False, skip_materials=True)
    points, faces = np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)
    if len(faces) and not 0 <= faces.min() <= faces.max() < len(points):
        raise ValueError("a face refers to a missing point")
    if kind == "glb":  # y axis points up
        points = points[:, [0, 2, 1]] * (1.0, -1.0, 1.0)
    return points, faces
