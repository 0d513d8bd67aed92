"""A solid stored in the recording: a closed surface, and its convex collision parts.

`Shape.mesh` is its text: base64 of a header (three counts), coordinates in hundredths of a millimetre, the corners of
triangles, and the points of each convex part. So a recording is drawn and replayed without further files.
"""

from __future__ import annotations

import base64
import binascii
import functools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from demorec.core.errors import SceneError
from demorec.core.geometry import Array

UNIT = 1e-5
"""Unit of the stored coordinates, metres."""
MAX_EXTENT = 0.3
"""Maximum extent of a solid, metres."""
MAX_POINTS = 5_000
_END_OF_PART = 0xFFFF


@dataclass(frozen=True, kw_only=True, eq=False)
class SolidMesh:
    """A closed surface in the body's frame."""

    points: Array  # (V, 3) metres
    faces: NDArray[np.int64]  # (F, 3) rows of `points`, counter-clockwise from outside
    # Rows of `points`; the hull of each is one convex part of the solid in physics. Empty for a mesh just read from a
    # file.
    parts: tuple[NDArray[np.int64], ...]

    @property
    def extents(self) -> Array:
        """Extents (3,) of the surface's bounding box, metres."""
        used = self.points[self.faces]
        return np.asarray(used.max(axis=(0, 1)) - used.min(axis=(0, 1)))

    @property
    def bottom(self) -> float:
        """Lowest z of the surface, metres."""
        return float(self.points[self.faces][:, :, 2].min())

    def moved(self, rotation: Array, offset: Array) -> SolidMesh:
        """Move each point p to `rotation` (3, 3) p + `offset` (3,), rounded to the stored precision."""
        points = np.stack([sum(row[axis] * self.points[:, axis] for axis in range(3)) for row in rotation], axis=1)
        return SolidMesh(points=np.round((points + offset) / UNIT) * UNIT, faces=self.faces, parts=self.parts)

    def mass_properties(self) -> tuple[float, Array, Array]:
        """Compute volume, m^3, centre (3,), m, and (3,) m^2: the moments of inertia about the centre's axes over the
        mass.
        """
        corners = self.points[self.faces]  # (F, 3, 3)
        six = (corners[:, 0] * np.cross(corners[:, 1], corners[:, 2])).sum(axis=1)
        volume = float(six.sum()) / 6
        total = corners.sum(axis=1)
        centre = (six[:, np.newaxis] * total).sum(axis=0) / (24 * volume)
        squares = (six[:, np.newaxis] * ((corners**2).sum(axis=1) + total**2)).sum(axis=0) / (120 * volume) - centre**2
        return volume, centre, np.asarray(squares.sum() - squares)

    def is_closed(self) -> bool:
        """Check that each edge has two faces that run along it in opposite directions."""
        rows = np.unique(np.round(self.points / UNIT).astype(np.int64), axis=0, return_inverse=True)[1].reshape(-1)
        edges = np.concatenate([rows[self.faces][:, [a, b]] for a, b in ((0, 1), (1, 2), (2, 0))])
        edges = edges[edges[:, 0] != edges[:, 1]]
        there, back = (np.unique(pairs, axis=0, return_counts=True) for pairs in (edges, edges[:, ::-1]))
        return len(edges) > 0 and all(np.array_equal(a, b) for a, b in zip(there, back, strict=True))

    def centred(self) -> SolidMesh:
        """Move the solid's centre of mass to the origin."""
        return self.moved(np.eye(3), -self.mass_properties()[1])

    def surface_obj(self) -> str:
        """Write the surface as an OBJ file, with the texture coordinates of `box_projection`."""
        coordinates, corners = np.unique(self.box_projection().reshape(-1, 2), axis=0, return_inverse=True)
        corners = np.stack([self.faces, corners.reshape(self.faces.shape)], axis=2).reshape(-1, 6) + 1
        lines = [*_vertices(self.points), *(f"vt {u:.4f} {v:.4f}" for u, v in coordinates.tolist())]
        lines += ["o surface", *("f {}/{} {}/{} {}/{}".format(*row) for row in corners.tolist())]
        return "\n".join(lines) + "\n"

    def box_projection(self) -> Array:
        """Compute (F, 3, 2) texture coordinates 0..1 of the faces' corners, each face projected along its dominant
        axis.

        The texture is as wide as the solid's longest side and, on sideways faces, upright.
        """
        corners = self.points[self.faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        facing = np.argmax(np.abs(normals) * (1.001, 1.0, 1.0), axis=1)  # at 45 degrees all to the same side
        low = corners.min(axis=(0, 1))
        across = np.array([[1, 2], [0, 2], [0, 1]])[facing]  # (F, 2)
        seen = np.take_along_axis(corners - low, across[:, np.newaxis], axis=2)
        return np.asarray(np.round(seen / self.extents.max(), 4))

    def parts_obj(self) -> str:
        """Write the convex parts as an OBJ file of one object each; only the points matter."""
        lines = _vertices(self.points)
        for number, part in enumerate(self.parts):
            fan = np.stack([np.roll(part, -shift) for shift in range(3)], axis=1)
            lines += [f"o part_{number}", *(f"f {a} {b} {c}" for a, b, c in (fan + 1).tolist())]
        return "\n".join(lines) + "\n"


def _vertices(points: Array) -> list[str]:
    return [f"v {x:.5f} {y:.5f} {z:.5f}" for x, y, z in points.tolist()]


def encode_mesh(mesh: SolidMesh) -> str:
    """Encode a solid as the text of `Shape.mesh`; SceneError if it is too wide or has too many points."""
    if len(mesh.points) > MAX_POINTS or len(mesh.faces) > 2 * MAX_POINTS:
        raise SceneError(f"A mesh has {len(mesh.points)} points, but the maximum is {MAX_POINTS}: simplify it.")
    if float(np.abs(mesh.points).max()) > MAX_EXTENT:
        raise SceneError(
            f"A mesh reaches {np.abs(mesh.points).max():.3g} m from its middle, the maximum is {MAX_EXTENT}."
        )
    ends = [np.append(part, _END_OF_PART) for part in mesh.parts]
    parts = np.concatenate(ends) if ends else np.zeros(0, dtype=np.int64)
    data = np.array([len(mesh.points), len(mesh.faces), len(parts)], dtype="<u4").tobytes()
    data += np.round(mesh.points / UNIT).astype("<i2").tobytes()
    data += mesh.faces.astype("<u2").tobytes() + parts.astype("<u2").tobytes()
    return base64.b64encode(data).decode()


@functools.lru_cache(maxsize=64)
def decode_mesh(text: str) -> SolidMesh:
    """Decode the text of `encode_mesh`; SceneError if it is invalid."""
    try:
        data = base64.b64decode(text, validate=True)
        if len(data) < 12:
            raise ValueError("it is cut off")
        num_points, num_faces, num_rows = np.frombuffer(data, "<u4", 3).tolist()
        if not 4 <= num_points <= MAX_POINTS or num_faces > 2 * MAX_POINTS or num_rows > 4 * MAX_POINTS:
            raise ValueError(f"it has {num_points} points and {num_faces} faces, allowed are {MAX_POINTS} points")
        if len(data) != 12 + 6 * num_points + 6 * num_faces + 2 * num_rows:
            raise ValueError("its length contradicts its header")
        points = np.frombuffer(data, "<i2", 3 * num_points, 12).reshape(-1, 3) * UNIT
        faces = np.frombuffer(data, "<u2", 3 * num_faces, 12 + 6 * num_points).reshape(-1, 3).astype(np.int64)
        rows = np.frombuffer(data, "<u2", num_rows, 12 + 6 * num_points + 6 * num_faces).astype(np.int64)
        ends = np.flatnonzero(rows == _END_OF_PART)
        parts = tuple(part[part != _END_OF_PART] for part in np.split(rows, ends + 1)[:-1])
        named = np.concatenate([faces.reshape(-1), *parts])
        if not num_faces or not parts or named.max() >= num_points or min(map(len, parts)) < 4:
            raise ValueError("it refers to missing points, or has no faces or parts")
    except (ValueError, binascii.Error) as error:
        raise SceneError(f"A mesh of the scene is broken ({error}).") from error
    return SolidMesh(points=points, faces=faces, parts=parts)
