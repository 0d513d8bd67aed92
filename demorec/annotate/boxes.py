"""Bounding boxes of the objects in segmentation images.

Pixels are counted from 0, x to the right and y down. Boxes enclose visible pixels only, not occluded parts.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from demorec.annotate import BoxEntry
from demorec.core.geometry import Array, Pose
from demorec.episode.scene import SceneCamera, Shape
from demorec.episode.words import nouns_of
from demorec.mcap import Recording

_RIM_POINTS = 48
"""Number of points on the rim of a cylinder."""


def seen_objects(recording: Recording, rows: NDArray[np.intp], camera: SceneCamera) -> Iterator[BoxEntry]:
    """Yield every object that a camera with segmentation sees in the given frames, row by row.

    Raises:
        RecordingError: The recording is damaged.
    """
    trajectory = recording.trajectory()
    row_of = {int(frame): row for row, frame in enumerate(rows.tolist())}
    bodies = {
        body.name: body
        for body in recording.info.simulated.scene.bodies
        if body.role in ("object", "target", "distractor")
    }
    value_of = {name: value for value, name in recording.segment_names().items() if name in bodies}
    for frame, image in enumerate(recording.segmentation(camera.name)):
        if frame not in row_of:
            continue
        world_from_camera = trajectory.world_from_camera[camera.name][frame]
        for name, value in value_of.items():
            shown = image == value
            area = int(np.count_nonzero(shown))
            if not area:
                continue
            body = bodies[name]
            pose = (
                trajectory.object_poses[name][frame]
                if name in trajectory.object_poses
                else body.world_from_body.vector()
            )
            outline = outline_area(camera, world_from_camera, body.shape, pose)
            values = {
                "bbox": _box(shown),
                "area": area,
                "iscrowd": 0,
                "object": name,
                "color": body.color_name,
                "visible_fraction": None if outline is None else round(min(1.0, area / max(outline, 1e-9)), 4),
            }
            yield row_of[frame], nouns_of(body)[0], values


def _box(shown: NDArray[np.bool_]) -> list[int]:
    """Return (x, y, width, height) of the true pixels of an image (H, W)."""
    rows = np.flatnonzero(shown.any(axis=1))
    columns = np.flatnonzero(shown.any(axis=0))
    x, y = int(columns[0]), int(rows[0])
    return [x, y, int(columns[-1]) - x + 1, int(rows[-1]) - y + 1]


def outline_area(camera: SceneCamera, world_from_camera: Array, shape: Shape, world_from_body: Array) -> float | None:
    """Return the area, px, of a convex body's whole outline, ignoring occlusion and the image's edges.

    None for a mesh or a URDF, and for a body not completely in front of the camera.
    """
    points = _rim(shape)
    if points is None:
        return None
    pose = Pose(position=world_from_body[:3], quat_xyzw=world_from_body[3:])
    pixels = _project(camera, world_from_camera, pose.apply(points))
    if not bool(np.isfinite(pixels).all()):
        return None
    from scipy.spatial import ConvexHull, QhullError  # slow to import

    try:
        return float(ConvexHull(pixels).volume)  # in 2D, the volume is the area
    except QhullError:  # all points on one line
        return 0.0


def _project(camera: SceneCamera, world_from_camera: Array, points: Array) -> Array:
    """Return the pixels (N, 2) of points (N, 3), metres, in the world; NaN for those behind the camera."""
    camera_from_world = Pose(position=world_from_camera[:3], quat_xyzw=world_from_camera[3:]).inverse()
    seen = camera_from_world.apply(points)
    depth = np.where(seen[:, 2] > camera.near, seen[:, 2], np.nan)
    k = camera.intrinsics
    return np.stack([k[0, 0] * seen[:, 0] / depth + k[0, 2], k[1, 1] * seen[:, 1] / depth + k[1, 2]], axis=-1)


def _rim(shape: Shape) -> Array | None:
    """Return points (N, 3) in the body's frame with the body as their convex hull; None for other shapes."""
    if shape.kind == "box":
        signs = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
        return np.asarray(signs * np.array(shape.size))
    if shape.kind == "cylinder":
        angles = np.arange(_RIM_POINTS) * 2 * math.pi / _RIM_POINTS
        # The polygon gets the circle's area; an inscribed one would be smaller.
        radius = shape.size[0] * math.sqrt((2 * math.pi / _RIM_POINTS) / math.sin(2 * math.pi / _RIM_POINTS))
        half = shape.size[1] / 2
        rim = np.stack([radius * np.cos(angles), radius * np.sin(angles)], axis=1)
        ends = [np.column_stack([rim, np.full(_RIM_POINTS, z)]) for z in (-half, half)]
        return np.asarray(np.concatenate(ends), dtype=np.float64)
    return None
