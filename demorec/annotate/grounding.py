"""Where the things of a scene are in the pictures: pixels that show them, boxes, projected points.

Pixels are counted from 0, x to the right and y down; a point belongs to the pixel that contains it. Boxes are of what
is visible: occluded parts are not in them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from demorec.core.geometry import Array
from demorec.episode.scene import SceneCamera
from demorec.mcap import SimulatedRecording

MIN_PIXELS = 10
"""Pixels below which a thing is too hidden, or too far, to be spoken of."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Seen:
    """One thing in one picture.

    Attributes:
        name: Of the body.
        num_pixels: How many pixels show it.
    """

    name: str
    num_pixels: int
    _label: int
    _labels: NDArray[np.uint16]

    @cached_property
    def pixels(self) -> NDArray[np.intp]:
        """(N,) numbers of the pixels that show it, counted row by row from the upper left, in order."""
        shown = self._labels == self._label
        _, y_min, _, y_max = self.box
        return np.asarray(np.flatnonzero(shown[y_min : y_max + 1]) + y_min * shown.shape[1])

    @cached_property
    def box(self) -> tuple[int, int, int, int]:
        """(x_min, y_min, x_max, y_max), the outermost pixels that show it, both included."""
        shown = self._labels == self._label
        (y_min, y_max), (x_min, x_max) = (np.flatnonzero(shown.any(axis=axis))[[0, -1]].tolist() for axis in (1, 0))
        return x_min, y_min, x_max, y_max

    def is_at(self, x: int, y: int) -> bool:
        """Whether a pixel shows it."""
        return int(self._labels[y, x]) == self._label


def spoken_bodies(recording: SimulatedRecording) -> tuple[str, ...]:
    """Names of the bodies that are spoken of in pictures: all but what only carries the scene."""
    return tuple(body.name for body in recording.info.scene.bodies if body.role in ("object", "target", "distractor"))


def seen_things(labels: NDArray[np.uint16], numbers: dict[str, int]) -> dict[str, Seen]:
    """Name -> what a picture shows of it; things that no pixel shows are left out.

    Args:
        labels: (H, W) as of `SimulatedRecording.segmentation_at`.
        numbers: Name of a body -> its label.
    """
    counts = {name: int(np.count_nonzero(labels == number)) for name, number in numbers.items()}
    return {
        name: Seen(name=name, num_pixels=count, _label=numbers[name], _labels=labels)
        for name, count in counts.items()
        if count
    }


def body_labels(recording: SimulatedRecording) -> dict[str, int]:
    """Name of each body that is spoken of -> its label in the segmentation pictures.

    Raises:
        RecordingError: The recording is damaged.
    """
    spoken = set(spoken_bodies(recording))
    return {name: label for label, name in recording.segment_labels().items() if name in spoken}


def project(camera: SceneCamera, world_from_camera: Array, points: Array) -> Array:
    """(N, 2) where points in the world, (N, 3) metres, are in a picture, px; NaN for those behind the camera.

    Args:
        camera: With its intrinsics.
        world_from_camera: (7,) pose at the moment of the picture.
        points: In the world frame.
    """
    return np.asarray(project_each(camera, world_from_camera[np.newaxis], points[np.newaxis])[0])


def project_each(camera: SceneCamera, world_from_camera: Array, points: Array) -> Array:
    """(T, N, 2) the same of T moments at once: poses (T, 7), points (T, N, 3)."""
    x, y, z, w = (world_from_camera[:, index, np.newaxis] for index in range(3, 7))
    # Of the conjugate quaternion; sums written out, as in demorec.core.geometry, and to the same bit.
    x, y, z = -x, -y, -z
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )
    eye = [world_from_camera[:, index, np.newaxis] for index in range(3)]
    seen = [
        points[..., 0] * a + points[..., 1] * b + points[..., 2] * c - (a * eye[0] + b * eye[1] + c * eye[2])
        for a, b, c in rows
    ]
    depth = np.where(seen[2] > camera.near, seen[2], np.nan)
    k = camera.intrinsics
    return np.stack([k[0, 0] * seen[0] / depth + k[0, 2], k[1, 1] * seen[1] / depth + k[1, 2]], axis=-1)


def pixels_of(camera: SceneCamera, points: Array) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """The pixels that contain points (..., 2) px, and whether they are in the picture at all; (0, 0) where not."""
    x, y = points[..., 0], points[..., 1]
    # NaN is not inside either.
    inside: NDArray[np.bool_] = (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
    return np.where(inside[..., np.newaxis], points, 0).astype(np.int64), inside
