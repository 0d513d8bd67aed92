"""Object sets, meshes in recordings, resting poses of objects and their grasps."""

from __future__ import annotations

import base64
import math
from pathlib import Path

import numpy as np
import pytest
import trimesh
from support.sim import episode, run

from demorec.core.errors import ConfigError, SceneError
from demorec.core.tables import OBJECTS, ROBOTS
from demorec.episode.mesh import SolidMesh, decode_mesh, encode_mesh
from demorec.extensions.tasks.solid_physics import at_rest, with_parts
from demorec.loop import ScriptAgent, Session, make_world
from demorec.objects.antipodal import antipodal_grasps
from demorec.objects.folder import load_shelf, read_solid
from demorec.objects.shelf import Kind

pytestmark = pytest.mark.slow

PANDA_HAND = ROBOTS.load("panda").gripper
UP = (0.0, 0.0, 1.0)
KINDS = {kind.noun: kind for name in ("household", "blocks") for kind in OBJECTS.load(name).kinds}


def as_trimesh(mesh: SolidMesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(vertices=mesh.points, faces=mesh.faces, process=False)


def block(x: float, y: float, z: float) -> SolidMesh:
    box = trimesh.creation.box(extents=(x, y, z))
    return SolidMesh(points=np.array(box.vertices), faces=np.array(box.faces), parts=(np.arange(8),))


@pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS.keys())
def test_each_shape_is_a_closed_solid_that_physics_has_as_it_is_drawn(kind: Kind) -> None:
    for number in range(0, kind.count, 10):
        mesh = kind.shape(number)
        assert mesh.is_closed()
        surface = as_trimesh(mesh)
        assert surface.is_watertight
        assert surface.volume > 0
        parts = [trimesh.convex.convex_hull(mesh.points[part]) for part in mesh.parts]
        outside = trimesh.util.concatenate(parts).bounds - surface.bounds
        assert np.abs(outside).max() < 1e-6
        filled = sum(part.volume for part in parts)
        if kind.noun not in ("mug", "glass", "bowl"):  # whose insides are filled
            assert filled == pytest.approx(surface.volume, rel=0.02)


@pytest.mark.parametrize("noun", ["bottle", "corner", "banana"])
def test_mass_properties_are_those_of_the_mesh(noun: str) -> None:
    mesh = KINDS[noun].shape(3)
    other = as_trimesh(mesh)
    volume, centre, moments = mesh.mass_properties()
    assert volume == pytest.approx(other.volume)
    np.testing.assert_allclose(centre, other.center_mass, atol=1e-9)
    np.testing.assert_allclose(moments * other.mass, np.diag(other.moment_inertia), rtol=1e-6)
    np.testing.assert_allclose(mesh.centred().mass_properties()[1], 0.0, atol=1e-5)


def test_shapes_differ_and_held_out_ones_are_distinct() -> None:
    for kind in KINDS.values():
        texts = [encode_mesh(kind.shape(number)) for number in range(kind.count)]
        assert len(set(texts)) == kind.count, kind.noun
        assert texts[1] == encode_mesh(kind.shape(1))
        train, held_out = set(kind.numbers("train")), set(kind.numbers("eval"))
        assert not train & held_out
        assert train | held_out == set(kind.numbers("all"))
        assert len(held_out) == kind.count // 5


def test_a_mesh_comes_back_from_its_text_and_a_broken_one_is_refused() -> None:
    mesh = KINDS["mug"].shape(0)
    text = encode_mesh(mesh)
    back = decode_mesh(text)
    assert np.array_equal(back.points, mesh.points)
    assert np.array_equal(back.faces, mesh.faces)
    assert all(np.array_equal(a, b) for a, b in zip(back.parts, mesh.parts, strict=True))
    data = base64.b64decode(text)
    wrong_row = bytearray(data)
    wrong_row[12 + 6 * len(mesh.points) : 14 + 6 * len(mesh.points)] = b"\xff\xfe"
    for broken in (data[:-1], data[:8], b"", b"\xff" * 40, bytes(wrong_row)):
        with pytest.raises(SceneError, match="broken"):
            decode_mesh(base64.b64encode(broken).decode())
    with pytest.raises(SceneError, match="broken"):
        decode_mesh("no base64 at all")
    with pytest.raises(SceneError, match="reaches"):
        encode_mesh(block(0.7, 0.1, 0.1))


def test_objects_rest_in_stable_poses_and_balanced_ones_fall() -> None:
    text, height = at_rest(encode_mesh(block(0.03, 0.05, 0.04)))
    np.testing.assert_allclose(decode_mesh(text).extents, (0.03, 0.05, 0.04), atol=2e-5)
    assert height == pytest.approx(0.02, abs=1.5e-3)
    half = math.sqrt(0.5)
    on_edge = block(0.03, 0.05, 0.04).moved(np.array([[1, 0, 0], [0, half, -half], [0, half, half]]), np.zeros(3))
    text, height = at_rest(encode_mesh(on_edge))
    assert sorted(decode_mesh(text).extents.tolist()) == pytest.approx([0.03, 0.04, 0.05], abs=3e-4)
    assert min(abs(height - half_side) for half_side in (0.02, 0.025)) < 1.5e-3


def test_an_overhang_in_the_path_of_a_finger_prevents_the_grasp() -> None:
    """A post can be grasped, but not below a plate on it that is nearly as wide as the open hand."""
    post, plate = trimesh.creation.box(extents=(0.03, 0.03, 0.04)), trimesh.creation.box(extents=(0.076, 0.076, 0.01))
    plate.apply_translation((0.0, 0.0, 0.025))
    both = SolidMesh(
        points=np.concatenate([post.vertices, plate.vertices]),
        faces=np.concatenate([post.faces, plate.faces + 8]),
        parts=(np.arange(8), np.arange(8, 16)),
    )
    assert antipodal_grasps(encode_mesh(block(0.03, 0.03, 0.04)), PANDA_HAND, up=UP)
    assert not antipodal_grasps(encode_mesh(both), PANDA_HAND, up=UP)


@pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS.keys())
def test_each_kind_has_grasps_for_the_usual_hand(kind: Kind) -> None:
    for number in range(0, kind.count, 15):
        text, _ = at_rest(encode_mesh(kind.shape(number)))
        assert antipodal_grasps(text, PANDA_HAND, up=UP), f"{kind.noun} {number}"


@pytest.mark.parametrize("target", ["white_bowl", "white_plate"])
def test_an_object_ends_at_rest_on_the_floor_of_a_bowl_or_a_plate(target: str) -> None:
    """Verified with PyBullet's contacts and with the object's points, all inside the rim."""
    made = next(
        made
        for made in (episode(number, task="pick_anything") for number in range(100, 140))
        if made.info.simulated.scene.goals[0].onto == target
    )
    scene = made.info.simulated.scene
    goal, vessel = scene.goals[0], scene.body(target)
    assert f"the {target.replace('_', ' ')}" in made.info.instruction
    with make_world(made.info) as world:
        session = Session.of_episode(world, made)
        for _ in session.run(ScriptAgent(made)):
            pass
        assert session.outcome.success, session.outcome.failure_reason
        assert world.touches(goal.object, target)
        points = world.pose(goal.object).apply(decode_mesh(scene.body(goal.object).shape.mesh).points)
    inside = vessel.world_from_body.inverse().apply(points)
    assert inside[:, 2].min() == pytest.approx(0.004, abs=2e-3)
    assert np.hypot(inside[:, 0], inside[:, 1]).max() < vessel.shape.size[0] / 2


def test_tasks_with_their_own_objects_refuse_shelves() -> None:
    with pytest.raises(ConfigError, match="--objects was given"):
        episode(task="stack", objects=("blocks",))
    with pytest.raises(ConfigError, match="--object-split was given"):
        episode(task="stack", object_split="train")
    with pytest.raises(ConfigError, match=r"Unknown shelf 'houshold'.*household"):
        episode(task="pick_anything", objects=("houshold",))


def export(mesh: trimesh.Trimesh, path: Path) -> Path:
    mesh.export(path)
    return path


def test_a_folder_of_meshes_is_a_shelf_and_a_ring_keeps_its_hole(tmp_path: Path) -> None:
    ring = trimesh.creation.annulus(r_min=0.012, r_max=0.025, height=0.03)
    export(ring, tmp_path / "red_ring_1.stl")
    export(trimesh.creation.annulus(r_min=0.01, r_max=0.02, height=0.03), tmp_path / "ring_2.stl")
    export(trimesh.creation.box(extents=(0.03, 0.05, 0.03)), tmp_path / "Soap Bar.obj")
    (tmp_path / "notes.txt").write_text("no mesh")
    shelf = load_shelf(f"{tmp_path}/")
    assert {kind.noun: kind.count for kind in shelf.kinds} == {"soap_bar": 1, "ring": 2}
    solid = with_parts(next(kind for kind in shelf.kinds if kind.noun == "ring").shape(0))
    assert solid.mass_properties()[0] == pytest.approx(ring.volume, rel=1e-3)
    parts = [trimesh.convex.convex_hull(solid.points[part]) for part in solid.parts]
    assert len(parts) > 1
    assert not any(part.contains(np.zeros((1, 3)))[0] for part in parts)
    info = episode(task="pick_anything", objects=(f"{tmp_path}/",)).info
    assert {body.name.split("_", 1)[1] for body in info.simulated.scene.movable} <= {"soap_bar", "ring"}
    _, outcome = run(episode(task="pick_anything", objects=(f"{tmp_path}/",)))
    assert outcome.success, outcome.failure_reason


@pytest.mark.parametrize(
    ("mesh", "wrong"),
    [
        (trimesh.creation.box(extents=(30.0, 50.0, 30.0)), "is it in millimetres"),
        (trimesh.creation.box(extents=(0.09, 0.08, 0.08)), "a gripper takes up to 0.07"),
        (trimesh.creation.icosphere(subdivisions=5, radius=0.03), "simplify it"),
        (trimesh.Trimesh([[0, 0, 0], [0.05, 0, 0], [0, 0.05, 0], [0, 0, 0.05]], [[0, 2, 1], [0, 1, 3]]), "is open"),
    ],
)
def test_an_unsuitable_mesh_is_refused_in_one_sentence(tmp_path: Path, mesh: trimesh.Trimesh, wrong: str) -> None:
    export(mesh, tmp_path / "thing.stl")
    with pytest.raises(ConfigError, match=wrong) as error:
        load_shelf(f"{tmp_path}/")
    assert "thing.stl" in str(error.value)


def test_a_glb_file_is_turned_upright_and_a_broken_one_is_refused(tmp_path: Path) -> None:
    """glTF uses metres and has y up; two boxes at different places of its scene are one solid."""
    both = trimesh.Scene()
    both.add_geometry(trimesh.creation.box(extents=(0.03, 0.05, 0.04)))
    lid = trimesh.transformations.translation_matrix((0.0, 0.03, 0.0))
    both.add_geometry(trimesh.creation.box(extents=(0.02, 0.01, 0.02)), transform=lid)
    data = both.export(file_type="glb")
    (tmp_path / "tin.glb").write_bytes(data)
    solid = load_shelf(f"{tmp_path}/").kinds[0].shape(0)
    np.testing.assert_allclose(solid.extents, (0.03, 0.04, 0.06), atol=1e-5)
    assert solid.mass_properties()[0] == pytest.approx(0.03 * 0.05 * 0.04 + 0.02 * 0.02 * 0.01)
    top = solid.points[solid.points[:, 2] > solid.points[:, 2].max() - 1e-4]
    assert float(np.ptp(top[:, 0])) == pytest.approx(0.02, abs=1e-5)  # the lid is on top
    (tmp_path / "tin.glb").write_bytes(data[: len(data) // 2])
    read_solid.cache_clear()
    with pytest.raises(ConfigError, match=r"tin\.glb"):
        read_solid(tmp_path / "tin.glb")


def test_a_folder_without_meshes_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"no \.obj, \.stl or \.glb"):
        load_shelf(f"{tmp_path}/")
    with pytest.raises(ConfigError, match="does not exist"):
        load_shelf(f"{tmp_path}/missing/")
    (tmp_path / "broken.stl").write_bytes(b"no mesh")
    with pytest.raises(ConfigError, match="no triangles"):
        load_shelf(f"{tmp_path}//")
