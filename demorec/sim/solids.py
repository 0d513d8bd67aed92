"""What a solid needs before it is in a scene: the convex parts that it collides as, and the pose in which it rests.

Parts are its hull, or what V-HACD cuts it into, where nobody has said them. How it rests on a table is found by
dropping it in the simulator.
"""

from __future__ import annotations

import functools
import hashlib
import math
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from demorec.core.errors import SceneError
from demorec.core.files import cache_folder, write_whole
from demorec.core.geometry import Array, Pose
from demorec.episode.mesh import UNIT, SolidMesh, decode_mesh, encode_mesh
from demorec.episode.scene import Body, Physics, Shape
from demorec.sim.bodies import add_body
from demorec.sim.client import connect, silence
from demorec.sim.world import set_engine

HULL_IS_RIGHT = 1.1
"""Volume of the hull over that of the solid up to which the hull is taken."""
ROLLING_FRICTION = 0.001
"""Of what may roll, as felt on a table would slow it down."""
_SECONDS = 4.0
"""After which a solid has to be at rest."""
_ASLANT = Pose(quat_xyzw=np.array([0.012, 0.009, 0.0, math.sqrt(1 - 0.015**2)]))
"""It is let go turned by 1.7 degrees, so that it does not stay balanced on an edge."""
_STILL = 2e-3
"""m/s and, times 0.05 m, rad/s."""
_UPRIGHT = math.radians(2.0)
"""A solid that comes to rest so little aslant keeps the axes that it was made with."""


def with_parts(mesh: SolidMesh) -> SolidMesh:
    """The solid with convex parts, found once for each content and kept in the user's cache folder."""
    return mesh if mesh.parts else decode_mesh(_text_with_parts(mesh))


@functools.lru_cache(maxsize=1024)
def _text_with_parts(mesh: SolidMesh) -> str:
    """The same solid as text (`Shape.mesh`), its parts its hull or those of the cache folder."""
    from scipy.spatial import ConvexHull  # takes a while to load

    if ConvexHull(mesh.points).volume < HULL_IS_RIGHT * mesh.mass_properties()[0]:
        return encode_mesh(replace(mesh, parts=(np.unique(mesh.faces),)))
    surface = mesh.surface_obj()
    path = cache_folder("objects") / f"{hashlib.sha256(surface.encode()).hexdigest()[:32]}.parts"
    try:
        text = path.read_text()
        decode_mesh(text)
    except (OSError, SceneError, UnicodeDecodeError):
        parts = _vhacd(surface)
        starts = np.cumsum([len(mesh.points), *map(len, parts)]).tolist()
        rows = tuple(np.arange(start, start + len(part)) for start, part in zip(starts, parts, strict=False))
        text = encode_mesh(replace(mesh, points=np.concatenate([mesh.points, *parts]), parts=rows))
        write_whole(path, lambda temporary: temporary.write_text(text))
    return text


def _vhacd(surface: str) -> list[Array]:
    """The points of each convex part that V-HACD finds in an OBJ file's text, rounded to what is stored."""
    import pybullet

    with tempfile.TemporaryDirectory(prefix="demorec_") as folder:
        source, target, log = (Path(folder) / name for name in ("mesh.obj", "parts.obj", "log.txt"))
        source.write_text(surface)
        with silence():
            pybullet.vhacd(
                str(source), str(target), str(log), resolution=50_000, concavity=0.0025, maxNumVerticesPerCH=32
            )
        lines = target.read_text().splitlines()
    parts: list[list[list[float]]] = []
    for line in lines:
        if line.startswith("o "):
            parts.append([])
        elif line.startswith("v "):
            parts[-1].append([float(word) for word in line.split()[1:4]])
    return [np.unique(np.round(np.array(part) / UNIT), axis=0) * UNIT for part in parts]


@functools.lru_cache(maxsize=1024)
def at_rest(text: str) -> tuple[str, float]:
    """A solid turned about horizontal axes as it rests, with its centre of mass at the origin, and how high that is.

    Args:
        text: As of `Shape.mesh`, in a pose near to one in which it rests.

    Returns:
        The same kind of text, and the height of its origin above the table, metres.

    Raises:
        SceneError: It is still moving after four seconds.
    """
    mesh = decode_mesh(text).centred()
    pose = _settled(mesh)
    up = pose.rotation[2]
    if math.acos(min(1.0, float(up[2]))) < _UPRIGHT:
        return encode_mesh(mesh), float(pose.position[2])
    yaw = math.atan2(pose.rotation[1, 0], pose.rotation[0, 0])
    turned = mesh.moved((Pose.from_yaw((0.0, 0.0, 0.0), -yaw) @ pose).rotation, np.zeros(3)).centred()
    return encode_mesh(turned), float(pose.position[2])


def _settled(mesh: SolidMesh) -> Pose:
    x, y, z = mesh.extents.tolist()
    floor = Body(
        name="floor",
        role="support",
        shape=Shape(kind="box", size=(2.0, 2.0, 0.2)),
        world_from_body=Pose(position=np.array([0.0, 0.0, -0.1])),
    )
    solid = Body(
        name="solid",
        role="object",
        shape=Shape(kind="mesh", size=(x, y, z), mesh=encode_mesh(mesh)),
        world_from_body=replace(_ASLANT, position=np.array([0.0, 0.0, 2e-3 - mesh.bottom])),
        mass=0.1,
        rolling_friction=ROLLING_FRICTION,
    )
    client, physics = connect(), Physics()
    try:
        set_engine(client, physics)
        add_body(client, floor)
        index = add_body(client, solid)
        still = 0
        for _ in range(round(_SECONDS * physics.hz)):
            client.stepSimulation()
            linear, angular = client.getBaseVelocity(index)
            moves = max(math.hypot(*linear), 0.05 * math.hypot(*angular)) > _STILL
            still = 0 if moves else still + 1
            if still == physics.hz // 4:
                position, quat = client.getBasePositionAndOrientation(index)
                return Pose(position=np.array(position), quat_xyzw=np.array(quat))
    finally:
        client.disconnect()
    raise SceneError(f"A solid of {x:.3f} x {y:.3f} x {z:.3f} m does not come to rest on a table: give it a flat side.")
