"""OBJ files, verified by the description of the format."""

from __future__ import annotations

from pathlib import Path

import pytest

from demorec.core.errors import SceneError
from demorec.mcap.description import self_contained
from demorec.robots.shape_files import read_obj

SQUARE = "v 0 0 0\nv 2 0 0\nv 2 3 0\nv 0 3 0\n"


@pytest.mark.parametrize("face", ["f 1 2 3 4", "f -4 -3 -2 -1", "f 1//7 2/5 3/5/6 4", "f\t1 2 3 4"])
def test_polygons_become_fans_however_their_corners_are_named(tmp_path: Path, face: str) -> None:
    (tmp_path / "x.obj").write_text(f"{SQUARE}{face}\n")
    found = read_obj(tmp_path / "x.obj")
    assert found.faces.tolist() == [[0, 1, 2], [0, 2, 3]]
    assert found.face_materials == ("", "")


def test_materials_are_the_existing_ones(tmp_path: Path) -> None:
    (tmp_path / "m.mtl").write_text("newmtl red\nKd 1 0 0\nmap_Kd gone.png\nnewmtl plain\n")
    (tmp_path / "x.obj").write_text(f"mtllib m.mtl\nmtllib missing.mtl\n{SQUARE}usemtl red\nf 1 2 3\n")
    found = read_obj(tmp_path / "x.obj")
    assert found.face_materials == ("red",)
    assert {name: (m.color.tolist(), m.texture) for name, m in found.materials.items()} == {
        "red": ([1, 0, 0], None),
        "plain": ([1, 1, 1], None),
    }


@pytest.mark.parametrize("face", ["f 1 2 5", "f 1 2 -9", "f 1 2 0"])
def test_a_face_with_missing_points_is_refused(tmp_path: Path, face: str) -> None:
    (tmp_path / "x.obj").write_text(f"{SQUARE}{face}\n")
    with pytest.raises(ValueError, match=r"a face names vertex \d+ of 4"):
        read_obj(tmp_path / "x.obj")
    mesh = "<visual><geometry><mesh filename='x.obj'/></geometry></visual>"
    with pytest.raises(SceneError, match="A mesh of the scene cannot be read"):  # its error message agrees
        self_contained(f"<robot name='x'><link name='l'>{mesh}</link></robot>", tmp_path)
