"""Where the things of a scene are in the images: pixels that show them, boxes, masks, projected points.

Pixels are counted from 0, x to the right and y down; a point belongs to the pixel that contains it. Boxes are of what
is visible: occluded parts are not in them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from demorec.annotate.situation import nouns_of
from demorec.core.geometry import Array, Pose, rotation_rows
from demorec.episode.episode import Columns
from demorec.episode.scene import SceneCamera, Shape
from demorec.mcap import Recording

MIN_PIXELS = 10
"""Pixels below which a thing is too hidden, or too far, to be spoken of."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Seen:
    """One thing in one image.

    Attributes:
        name: Of the body.
        num_pixels: How many pixels show it.
    """

    name: str
    num_pixels: int
    _label: int
    _labels: NDArray[np.uint16]

    @property
    def pixels(self) -> NDArray[np.intp]:
        """(N,) numbers of the pixels that show it, counted as COCO does, column by column from the upper left."""
        x_min, _, x_max, _ = self.box
        shown = self._labels[:, x_min : x_max + 1] == self._label
        return np.asarray(np.flatnonzero(shown.T) + x_min * len(shown))

    @cached_property
    def box(self) -> tuple[int, int, int, int]:
        """(x_min, y_min, x_max, y_max), the outermost pixels that show it, both included."""
        shown = self._labels == self._label
        (y_min, y_max), (x_min, x_max) = (np.flatnonzero(shown.any(axis=axis))[[0, -1]].tolist() for axis in (1, 0))
        return x_min, y_min, x_max, y_max

    def is_at(self, x: int, y: int) -> bool:
        """Whether a pixel shows it."""
        return int(self._labels[y, x]) == self._label


def seen_things(labels: NDArray[np.uint16], numbers: dict[str, int]) -> dict[str, Seen]:
    """Name -> what an image shows of it; things that no pixel shows are left out.

    Args:
        labels: (H, W) as of `Recording.segmentation_at`.
        numbers: Name of a body -> its label.
    """
    counts = {name: int(np.count_nonzero(labels == number)) for name, number in numbers.items()}
    return {
        name: Seen(name=name, num_pixels=count, _label=numbers[name], _labels=labels)
        for name, count in counts.items()
        if count
    }


def body_labels(recording: Recording) -> dict[str, int]:
    """Name of each body that is spoken of, all but what only carries the scene -> its label in segmentation images.

    Raises:
        RecordingError: The recording is damaged.
    """
    spoken = {body.name for body in recording.info.scene.bodies if body.role in ("object", "target", "distractor")}
    return {name: label for label, name in recording.segment_labels().items() if name in spoken}


def project(camera: SceneCamera, world_from_camera: Array, points: Array) -> Array:
    """(T, N, 2) where points in the world are in the images of T moments, px; NaN for those behind the camera.

    Args:
        camera: With its intrinsics.
        world_from_camera: (T, 7) poses at the moments of the images.
        points: (T, N, 3) metres, in the world frame.
    """
    x, y, z, w = (world_from_camera[:, index, np.newaxis] for index in range(3, 7))
    rows = rotation_rows(-x, -y, -z, w)  # of the conjugate quaternion
    eye = [world_from_camera[:, index, np.newaxis] for index in range(3)]
    seen = [
        points[..., 0] * a + points[..., 1] * b + points[..., 2] * c - (a * eye[0] + b * eye[1] + c * eye[2])
        for a, b, c in rows
    ]
    depth = np.where(seen[2] > camera.near, seen[2], np.nan)
    k = camera.intrinsics
    return np.stack([k[0, 0] * seen[0] / depth + k[0, 2], k[1, 1] * seen[1] / depth + k[1, 2]], axis=-1)


def pixels_of(camera: SceneCamera, points: Array) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """The pixels that contain points (..., 2) px, and whether they are in the image at all; (0, 0) where not."""
    x, y = points[..., 0], points[..., 1]
    # NaN is not inside either.
    inside: NDArray[np.bool_] = (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
    return np.where(inside[..., np.newaxis], points, 0).astype(np.int64), inside


_ROUND = 48
"""Points on the rim of what is round."""


@dataclass(frozen=True, kw_only=True)
class SeenObject:
    """What one image shows of one thing, in COCO's terms.

    Attributes:
        row: Of the dataset's episode.
        name: Of the body.
        noun: Its kind, the category.
        color: The word for its colour, or "".
        box: (x, y, width, height) of the pixels that show it.
        area: How many pixels show it.
        visible_fraction: That number over the area, px, of its whole outline, hidden parts and those beyond the
            image's edge included; None for a shape whose outline is not known (meshes, URDFs), or behind the camera.
        counts: Run lengths of the mask, column by column, the first of pixels that do not show it.
    """

    row: int
    name: str
    noun: str
    color: str
    box: tuple[int, int, int, int]
    area: int
    visible_fraction: float | None
    counts: tuple[int, ...]


def seen_objects(
    recording: Recording, columns: Columns, rows: NDArray[np.intp], camera: SceneCamera
) -> Iterator[SeenObject]:
    """Everything that a camera with segmentation sees in the given frames, row by row.

    Raises:
        RecordingError: The recording is damaged.
    """
    row_of = {int(frame): row for row, frame in enumerate(rows.tolist())}
    numbers = body_labels(recording)
    bodies = {body.name: body for body in recording.info.scene.bodies}
    for _, frame, labels in recording.segmentation_at([camera.name], row_of):
        extrinsics = columns.world_from_camera[camera.name][frame]
        for name, seen in seen_things(labels, numbers).items():
            body = bodies[name]
            pose = columns.object_poses[name][frame] if name in columns.object_poses else body.world_from_body.vector()
            x_min, y_min, x_max, y_max = seen.box
            whole = outline_area(camera, extrinsics, body.shape, pose)
            yield SeenObject(
                row=row_of[frame],
                name=name,
                noun=nouns_of(body)[0],
                color=body.color_name,
                box=(x_min, y_min, x_max - x_min + 1, y_max - y_min + 1),
                area=seen.num_pixels,
                visible_fraction=None if whole is None else round(min(1.0, seen.num_pixels / max(whole, 1e-9)), 4),
                counts=run_lengths(seen.pixels, labels.size),
            )


def run_lengths(pixels: NDArray[np.intp], size: int) -> tuple[int, ...]:
    """Lengths of the runs of pixels that are not among the given ones, that are, that are not, and so on.

    Args:
        pixels: (N,) numbers in order, as COCO counts them.
        size: How many pixels there are.
    """
    if not len(pixels):
        return (size,)
    gaps = np.flatnonzero(np.diff(pixels) > 1)
    starts = np.concatenate([pixels[:1], pixels[gaps + 1]])
    ends = np.concatenate([pixels[gaps], pixels[-1:]]) + 1
    lengths = np.diff(np.stack([starts, ends], axis=1).ravel(), prepend=0).tolist()
    return tuple([*lengths, size - int(ends[-1])] if ends[-1] < size else lengths)


def outline_area(camera: SceneCamera, world_from_camera: Array, shape: Shape, world_from_body: Array) -> float | None:
    """Area, px, of the whole outline of a convex body, as if nothing hid it and the image went on for ever.

    None for a mesh or a URDF, and for a body that is not wholly before the camera.
    """
    points = _rim(shape)
    if points is None:
        return None
    pose = Pose(position=world_from_body[:3], quat_xyzw=world_from_body[3:])
    seen = project(camera, world_from_camera[np.newaxis], pose.apply(points)[np.newaxis])[0]
    if not bool(np.isfinite(seen).all()):
        return None
    from scipy.spatial import ConvexHull, QhullError  # takes a while to load

    try:
        return float(ConvexHull(seen).volume)  # in the plane, that is its area
    except QhullError:  # all points on one line
        return 0.0


def _rim(shape: Shape) -> Array | None:
    """(N, 3) points on a body, in its own frame, whose convex hull it is."""
    if shape.kind == "box":
        signs = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
        return np.asarray(signs * np.array(shape.size))
    if shape.kind == "cylinder":
        angles = np.arange(_ROUND) * 2 * math.pi / _ROUND
        # As large as the circle, which a polygon within it is not.
        radius, half = (
            shape.size[0] * math.sqrt((2 * math.pi / _ROUND) / math.sin(2 * math.pi / _ROUND)),
            shape.size[1] / 2,
        )
        rim = np.stack([radius * np.cos(angles), radius * np.sin(angles)], axis=1)
        ends = [np.column_stack([rim, np.full(_ROUND, z)]) for z in (-half, half)]
        return np.asarray(np.concatenate(ends), dtype=np.float64)
    return None
