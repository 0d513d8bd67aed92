"""What a PyBullet client shows, as plain data for renderers: shapes and poses, body by body."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from demorec.core.errors import RenderError
from demorec.core.geometry import Array, Pose
from demorec.episode.scene import Texture
from demorec.render import Visual, VisualBody, VisualKind
from demorec.robots.assets import asset_path

ShapeRows = tuple[tuple[Any, ...], ...]
"""Of every visual shape what PyBullet tells: body, link, kind, dimensions, file, position, orientation, colour."""


def shape_rows(client: Any) -> ShapeRows:
    """The visual shapes of a client; equal rows look equal."""
    return tuple(shape for body in range(client.getNumBodies()) for shape in client.getVisualShapeData(body))


def visual_bodies(
    client: Any, rows: ShapeRows, *, names: Mapping[int, str], textures: Mapping[int, Texture]
) -> tuple[VisualBody, ...]:
    """The bodies of a client.

    Args:
        client: Its bodies are numbered without a gap.
        rows: Its `shape_rows`.
        names: Body -> name; others are called as PyBullet calls them.
        textures: Body -> procedural texture: PyBullet cannot be asked for the pixels of one.

    Raises:
        RenderError: A shape of a kind that no renderer draws.
    """
    bodies = []
    for body in range(client.getNumBodies()):
        dynamics = client.getDynamicsInfo(body, -1)
        name = names.get(body) or client.getBodyInfo(body)[1].decode()
        inertial_from_base = base_from_inertial(client, body).inverse()
        bodies.append(
            VisualBody(
                name=name,
                num_links=client.getNumJoints(body),
                is_fixed=dynamics[0] == 0,
                visuals=tuple(_visual(client, row, name, inertial_from_base) for row in rows if row[0] == body),
                texture=textures.get(body),
            )
        )
    return tuple(bodies)


def base_from_inertial(client: Any, body: int) -> Pose:
    """Pose of the base's centre of mass, whose pose PyBullet tells as that of the body."""
    dynamics = client.getDynamicsInfo(body, -1)
    return Pose(position=np.array(dynamics[3]), quat_xyzw=np.array(dynamics[4]))


def body_poses(client: Any) -> Array:
    """(n, 7) poses as `Renderer.render` takes them: of each body the base's centre of mass, then its links' frames."""
    rows: list[tuple[float, ...]] = []
    for body in range(client.getNumBodies()):
        position, quat = client.getBasePositionAndOrientation(body)
        rows.append(position + quat)
        links = range(client.getNumJoints(body))
        if links:
            states = client.getLinkStates(body, list(links), computeForwardKinematics=1)
            rows += [state[4] + state[5] for state in states]
    return np.array(rows).reshape(-1, 7)


def _visual(client: Any, row: tuple[Any, ...], name: str, inertial_from_base: Pose) -> Visual:
    body, link, kind, dimensions, file, position, quat, rgba = row[:8]
    known: dict[int, tuple[VisualKind, tuple[float, ...]]] = {
        client.GEOM_MESH: ("mesh", dimensions),
        client.GEOM_BOX: ("box", dimensions),
        client.GEOM_SPHERE: ("sphere", dimensions[:1]),
        client.GEOM_CYLINDER: ("cylinder", (dimensions[1], dimensions[0])),
        client.GEOM_CAPSULE: ("capsule", (dimensions[1], dimensions[0])),
        client.GEOM_PLANE: ("plane", ()),
    }
    if kind not in known:
        raise RenderError(
            f"Body {body} ({name!r}), link {link}: a visual shape of PyBullet's kind {kind} cannot be drawn: "
            "use a mesh, box, sphere, cylinder, capsule or plane."
        )
    kind_name, size = known[kind]
    link_from_shape = Pose(position=np.array(position), quat_xyzw=np.array(quat))
    return Visual(
        link=link,
        kind=kind_name,
        size=tuple(size),
        file=_mesh_file(file.decode()) if kind_name == "mesh" else "",
        link_from_shape=inertial_from_base @ link_from_shape if link == -1 else link_from_shape,
        rgba=rgba,
    )


def _mesh_file(name: str) -> str:
    """PyBullet searches pybullet_data too, and tells names as it was given them."""
    path = Path(name)
    return name if path.is_absolute() or path.exists() else str(asset_path(name))
