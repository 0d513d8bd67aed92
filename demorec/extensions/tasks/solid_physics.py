"""Preparation of a solid for a scene: its convex collision parts and its resting pose.

If no parts are given, they are its hull or V-HACD's decomposition. The resting pose on a table is found by dropping the
solid in the simulator.
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
"""Maximum ratio of the hull's volume to the solid's at which the hull is used."""
ROLLING_FRICTION = 0.001
"""Rolling friction of objects that can roll: it slows them down as felt on a table would."""
_SECONDS = 4.0
"""Maximum simulated time until a solid is at rest, s."""
_ASLANT = Pose(quat_xyzw=np.array([0.012, 0.009, 0.0, math.sqrt(1 - 0.015**2)]))
"""Release pose turned by 1.7 degrees, so that the solid does not stay balanced on an edge."""
_STILL = 2e-3
"""Maximum speed at rest: m/s, and rad/s times 0.05 m."""
_UPRIGHT = math.radians(2.0)
"""Maximum tilt at rest, rad, at which a solid keeps its original axes."""


def with_parts(mesh: SolidMesh) -> SolidMesh:
    """Add convex parts to a solid, computed once for each content and kept in the user's cache folder."""
    return mesh if mesh.parts else decode_mesh(_text_with_parts(mesh))


@functools.lru_cache(maxsize=1024)
def _text_with_parts(mesh: SolidMesh) -> str:
    """Return the solid as text (`Shape.mesh`), with its hull or the cached decomposition as parts."""
    from scipy.spatial import ConvexHull  # slow import

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
    """Find V-HACD's convex parts of an OBJ text; returns the points of each, rounded to the stored precision."""
    with tempfile.TemporaryDirectory(prefix="demorec_") as folder:
        source, target, log = (Path(folder) / name for name in ("mesh.obj", "parts.obj", "log.txt"))
        source.write_text(surface)
        client = connect()
        with silence():
            client.vhacd(
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
    """Turn a solid about horizontal axes into its resting pose, with the centre of mass at the origin.

    Args:
        text: Solid as in `Shape.mesh`, near one of its resting poses.

    Returns:
        The turned solid as text, and the height of its origin above the table, metres.

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
