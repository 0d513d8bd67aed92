"""Mesh files: correct reading, and errors for broken ones; a cache that survives damage."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from support import render as scenes

from demorec.core.errors import RenderError
from demorec.render.raster.mesh import cached_mesh
from demorec.render.raster.mesh_files import load_mesh


def test_stl_is_read_as_trimesh_reads_it(tmp_path: Path) -> None:
    shape = trimesh.creation.icosphere(2, 0.1)
    for kind in ("stl", "stl_ascii"):
        path = tmp_path / f"{kind}.stl"
        shape.export(path, file_type=kind)
        mesh = load_mesh(path)
        assert mesh.num_faces == len(shape.faces)
        assert np.allclose(mesh.points.min(0), shape.bounds[0], atol=1e-6)
        # Shading is smooth although the file has no shared corners: normals of a sphere point outward.
        corners = mesh.points[mesh.faces]
        outward = corners / np.sqrt((corners**2).sum(-1, keepdims=True))
        assert (mesh.normals * outward).sum(-1).min() > 0.98


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.obj", b"v 0 0 0\nf 1 2 3\n"),
        ("b.obj", b"v 0 0 zero\n"),
        ("c.obj", b""),
        ("d.stl", b"x" * 90),
        ("e.dae", b"<COLLADA><"),
        ("f.ply", b"ply"),
        ("g.obj", b"v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"),
    ],
)
def test_broken_files_are_named(tmp_path: Path, name: str, content: bytes) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(RenderError, match=name):
        load_mesh(path)


def test_the_cache_survives_damage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DEMOREC_CACHE", str(tmp_path))
    source = Path(scenes.DATA) / "cube.obj"
    made: list[int] = []

    def make() -> object:
        made.append(1)
        return load_mesh(source)

    first = cached_mesh("key", make)  # type: ignore[arg-type]
    again = cached_mesh("key", make)  # type: ignore[arg-type]
    assert len(made) == 1
    assert np.array_equal(first.points, again.points)
    assert again.texture == first.texture
    (file,) = tmp_path.glob("meshes/*/*.npz")
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2])
    assert np.array_equal(cached_mesh("key", make).points, first.points)  # type: ignore[arg-type]
    assert len(made) == 2
    assert file.read_bytes() != whole[: len(whole) // 2]
