"""Where the things of a scene are in the pictures: pixels that show them, boxes, projected points.

Pixels are counted from 0, x to the right and y down; a point belongs to the pixel that contains it. Boxes are of what
is visible: occluded parts are not in them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from demorec.geometry import Array, Pose
from demorec.recording import Recording
from demorec.scene.scene import Camera

MIN_PIXELS = 10
"""Pixels below which a thing is too hidden, or too far, to be spoken of."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Seen:
    """One thing in one picture.

    Attributes:
        name: Of the body.
        pixels: (N,) numbers of the pixels that show it, counted column by column from the upper left, in order.
        height: Of the picture, px.
    """

    name: str
    pixels: NDArray[np.intp]
    height: int

    @property
    def num_pixels(self) -> int:
        """How many pixels show it."""
        return len(self.pixels)

    @cached_property
    def box(self) -> tuple[int, int, int, int]:
        """(x_min, y_min, x_max, y_max), the outermost pixels that show it, both included."""
        rows = self.pixels % self.height
        x_min, x_max = int(self.pixels[0]) // self.height, int(self.pixels[-1]) // self.height
        return x_min, int(rows.min()), x_max, int(rows.max())

    def is_at(self, x: int, y: int) -> bool:
        """Whether a pixel shows it."""
        number = x * self.height + y
        place = int(np.searchsorted(self.pixels, number))
        return place < len(self.pixels) and int(self.pixels[place]) == number


def spoken_bodies(recording: Recording) -> tuple[str, ...]:
    """Names of the bodies that are spoken of in pictures: all but what only carries the scene."""
    return tuple(body.name for body in recording.info.scene.bodies if body.role in ("object", "target", "distractor"))


def seen_things(labels: NDArray[np.int32], values: dict[str, int]) -> dict[str, Seen]:
    """Name -> what a picture shows of it; things that no pixel shows are left out.

    Args:
        labels: (H, W) segmentation as in `CameraImages`.
        values: Name of a body -> its number in the segmentation.
    """
    # Bodies that are spoken of have no links, so that their numbers are the labels themselves.
    known = {value: name for name, value in values.items()}
    flat, (height, width) = labels.ravel(), labels.shape
    pixels = np.flatnonzero((flat >= min(known, default=0)) & (flat <= max(known, default=-1)))
    shown = flat[pixels]
    rows, columns = np.divmod(pixels, width)
    by_column = columns * height + rows  # few pixels are put in order, not all of the picture
    found = {
        known[value]: np.sort(by_column[shown == value])
        for value in np.flatnonzero(np.bincount(shown))
        if value in known
    }
    return {name: Seen(name=name, pixels=found[name], height=height) for name in values if name in found}


def body_values(recording: Recording) -> dict[str, int]:
    """Name of each body that is spoken of -> its number in the segmentation pictures.

    Raises:
        RecordingError: The recording is damaged.
    """
    spoken = set(spoken_bodies(recording))
    return {name: value for value, name in recording.segment_names().items() if name in spoken}


def project(camera: Camera, world_from_camera: Array, points: Array) -> Array:
    """(N, 2) where points in the world, (N, 3) metres, are in a picture, px; NaN for those behind the camera.

    Args:
        camera: With its intrinsics.
        world_from_camera: (7,) pose at the moment of the picture.
        points: In the world frame.
    """
    pose = Pose(position=world_from_camera[:3], quat_xyzw=world_from_camera[3:])
    seen = pose.inverse().apply(points)
    depth = np.where(seen[:, 2] > camera.near, seen[:, 2], np.nan)
    k = camera.intrinsics
    return np.stack([k[0, 0] * seen[:, 0] / depth + k[0, 2], k[1, 1] * seen[:, 1] / depth + k[1, 2]], axis=1)


def pixel_of(camera: Camera, point: Array) -> tuple[int, int] | None:
    """The pixel that contains a point (2,) px; None outside of the picture."""
    x, y = point.tolist()
    if not (0 <= x < camera.width and 0 <= y < camera.height):  # which NaN is not either
        return None
    return int(x), int(y)
