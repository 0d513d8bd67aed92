"""What a camera must have seen, drawn anew from the recorded numbers, beside what was recorded.

The renderer that draws a recording needs no simulator: poses follow from the recorded joints and objects. Every picture
is drawn small and compared with the recorded one in cells (means over small areas), in which the coder's error nearly
vanishes while a motion of a tenth of a cell still shows. Depth and labels are compared in the same way: depth as a
brightness, labels as colours of a palette.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from demorec.errors import RenderError, SceneError
from demorec.geometry import Array
from demorec.render import Renderer
from demorec.render.painter import Painter
from demorec.render.recorded import RecordedWorld
from demorec.scene.episode import EpisodeColumns, EpisodeInfo
from demorec.scene.scene import Camera

Cells = NDArray[np.float32]
"""(T, h, w, channels), 0..255."""
Kind = Literal["color", "depth", "labels"]

LONGER_SIDE = 112
"""Pixels that are drawn along the longer side, at most."""
CELLS = 28
"""Cells along the longer side."""
DEPTH_RANGE = 3.0
"""Metres that are brightness 255; what is farther is not told apart."""


class CellGrid:
    """Means over a grid of (nearly) equal areas, for pictures of one size.

    Args:
        width, height: Of the pictures, pixels.
    """

    def __init__(self, width: int, height: int) -> None:
        columns, rows = cell_counts(width, height)
        x, y = (np.arange(count + 1) * size // count for count, size in ((columns, width), (rows, height)))
        self._columns, self._rows = x[:-1], y[:-1]
        self._areas = np.outer(np.diff(y), np.diff(x)).astype(np.float32)

    def means(self, planes: Sequence[NDArray[np.float32]]) -> Cells:
        """(N, h, w, channels) of so many planes (N, H, W)."""
        # No matrix product: its threads wait for each other on a busy machine.
        sums = (np.add.reduceat(np.add.reduceat(p, self._rows, axis=1), self._columns, axis=2) for p in planes)
        return np.stack([part / self._areas for part in sums], axis=-1)


def cell_counts(width: int, height: int) -> tuple[int, int]:
    """(columns, rows) of the grid for pictures of a size."""
    longer = max(width, height)
    count = min(CELLS, longer // 2)
    return max(round(count * width / longer), 2), max(round(count * height / longer), 2)


def planes_of(kind: Kind, pictures: NDArray[Any]) -> list[NDArray[np.float32]]:
    """Pictures (N, H, W[, 3]) as brightnesses 0..255, a plane (N, H, W) each."""
    if kind == "color":
        # Channel by channel: NumPy is slow over a last axis of three.
        return [np.ascontiguousarray(pictures[..., c]).astype(np.float32) for c in range(3)]
    if kind == "depth":
        metres = np.asarray(pictures, dtype=np.float32)
        return [np.where(metres > 0, np.minimum(metres, DEPTH_RANGE), DEPTH_RANGE) * np.float32(255 / DEPTH_RANGE)]
    values = np.asarray(pictures, dtype=np.int64)
    return [_scattered(values, multiplier).astype(np.float32) for multiplier in (2654435761, 2246822519)]


def _scattered(values: NDArray[np.int64], multiplier: int) -> NDArray[np.int64]:
    """A brightness for each label, far apart for neighbours: the upper bits of a product (Knuth's hash)."""
    body_and_link = (values & 0xFFFFFF) + 1009 * (values >> 24)
    return (((body_and_link + 2) * multiplier) >> 16) & 255


def draw_all(
    info: EpisodeInfo, columns: EpisodeColumns, kinds: Mapping[str, Iterable[Kind]]
) -> dict[tuple[str, Kind], Cells]:
    """(camera, kind) -> cells of every frame, as the recorded numbers make them.

    Args:
        info, columns: Of the recording.
        kinds: Camera name -> what is to be drawn of it.

    Raises:
        SceneError, RenderError: A model is not there, or cannot be drawn.
    """
    cameras = tuple(_small(camera) for camera in info.scene.cameras)
    wanted = {kind for of_camera in kinds.values() for kind in of_camera}
    world = RecordedWorld(
        info.robot, info.scene, joint_position=columns.joint_position, object_poses=columns.object_poses
    )
    grids = {camera.name: CellGrid(camera.width, camera.height) for camera in cameras}
    found: dict[tuple[str, Kind], list[Cells]] = {(name, kind): [] for name in kinds for kind in kinds[name]}
    painter = Painter(_renderer(), cameras, depth="depth" in wanted, segmentation="labels" in wanted)
    painter.setup(world)
    for frame in range(columns.num_frames):
        world.frame = frame
        images = painter.images()
        for name, kind in found:
            image = images[name]
            pictures = {"color": image.color, "depth": image.depth, "labels": image.segmentation}[kind]
            assert pictures is not None
            found[name, kind].append(grids[name].means(planes_of(kind, pictures[None]))[0])
    return {key: np.stack(cells) for key, cells in found.items()}


@cache
def _renderer() -> Renderer:
    """Kept warm from one recording to the next: it has read the robot's meshes."""
    from demorec.render.raster import RasterRenderer

    return RasterRenderer()


def _small(camera: Camera) -> Camera:
    share = min(1.0, LONGER_SIDE / max(camera.width, camera.height))
    return replace(camera, width=max(round(camera.width * share), 2), height=max(round(camera.height * share), 2))


@dataclass(frozen=True, kw_only=True, eq=False)
class Comparison:
    """Recorded pictures of a camera against the drawn ones, T frames.

    Attributes:
        shift: (2,) how far the recorded pictures are to the right of and below the drawn ones, of the height.
        scale: Share by which things are larger in the recorded pictures.
        lag: By how many frames the recorded pictures are late; None where too little moves to tell.
        unlike: (T,) root mean square difference of the cells, of 255, but for shift and scale.
        motion: (T,) root mean square change of the drawn cells since the frame before, of 255.
        shown: (T,) which share of that change the recorded picture shows: 1 for good ones, 0 for a repeated one.
    """

    shift: Array
    scale: float
    lag: float | None
    unlike: Array
    motion: Array
    shown: Array


_STRAY = 4.0
"""Of 255: a depth or label that is off by more is another."""
_MAX_LAG = 3
_MOVING = 1.0
_MIN_MOVING = 12
"""A lag is told from this many frames on in which the drawn cells change by so much (root mean square, of 255)."""


def compare(seen: Cells, drawn: Cells) -> Comparison:
    """Least squares over all frames: seen = drawn, but shifted, scaled and turned by one amount each."""
    drawn = drawn[: len(seen)]
    error = seen - drawn
    height, width = drawn.shape[1:3]
    x = (np.arange(width, dtype=np.float32) - (width - 1) / 2)[:, None]
    y = (np.arange(height, dtype=np.float32) - (height - 1) / 2)[:, None, None]
    down, right = np.gradient(drawn, axis=(1, 2))
    # A picture that is shifted to the right by one cell is drawn(x - 1) = drawn - slope; and so on.
    bases = np.stack([-right, -down, -(x * right + y * down), -(x * down - y * right)])
    # Frames that are something else altogether must not decide how far the others are shifted.
    size = _rms(error)
    usual = size <= 3 * np.median(size) + 1e-6 if len(size) else np.zeros(0, dtype=bool)
    a = bases[:, usual].reshape(4, -1).astype(np.float64)
    gram = a @ a.T
    # Enough that a direction in which nothing can be told gets nothing.
    gram += np.eye(4) * max(1e-3 * float(np.trace(gram)) / 4, 1e-9)
    found = np.linalg.solve(gram, a @ error[usual].reshape(-1))
    fitted = drawn + np.tensordot(found.astype(np.float32), bases, axes=1)
    step, observed = np.zeros_like(drawn), np.zeros_like(drawn)
    step[1:], observed[1:] = np.diff(drawn, axis=0), np.diff(seen, axis=0)
    motion = _rms(step)
    return Comparison(
        shift=found[:2] / height,
        scale=float(found[2]),
        lag=_lag(seen, fitted, motion > _MOVING),
        unlike=_rms(seen - fitted),
        motion=motion,
        shown=(observed * step).sum(axis=(1, 2, 3)) / np.maximum((step**2).sum(axis=(1, 2, 3)), 1e-6),
    )


def strays(seen: Cells, drawn: Cells) -> Array:
    """(T,) share of the cells whose value lies outside those of the drawn cell and its eight neighbours.

    For depth and labels, which are coded without loss: edges may lie elsewhere by a cell, nothing else may differ.
    """
    drawn = drawn[: len(seen)]
    padded = np.pad(drawn, ((0, 0), (1, 1), (1, 1), (0, 0)), mode="edge")
    height, width = drawn.shape[1:3]
    around = [padded[:, i : i + height, j : j + width] for i in range(3) for j in range(3)]
    low, high = around[0].copy(), around[0].copy()
    for cells in around[1:]:
        np.minimum(low, cells, out=low)
        np.maximum(high, cells, out=high)
    off = np.maximum(low - seen, seen - high).max(axis=3) > _STRAY
    return np.asarray(off.mean(axis=(1, 2)), dtype=np.float64)


def _rms(cells: Cells) -> Array:
    """(T,) root mean square over each frame's cells."""
    flat = cells.reshape(len(cells), -1)
    return np.asarray(np.sqrt(np.einsum("ti,ti->t", flat, flat) / max(flat.shape[1], 1)), dtype=np.float64)


def _lag(seen: Cells, drawn: Cells, moving: NDArray[np.bool_]) -> float | None:
    """By how many frames `seen` runs behind `drawn`: whole lags, and a parabola through the best and its neighbours."""
    rows = np.flatnonzero(moving[_MAX_LAG : len(seen) - _MAX_LAG]) + _MAX_LAG
    if len(rows) < _MIN_MOVING:
        return None
    lags = range(-_MAX_LAG, _MAX_LAG + 1)
    errors = [float((_rms(seen[rows] - drawn[rows - lag]) ** 2).mean()) for lag in lags]
    best = int(np.argmin(errors))
    if best in (0, len(errors) - 1):
        return float(lags[best])
    low, middle, high = errors[best - 1 : best + 2]
    bend = low - 2 * middle + high
    return lags[best] + (0.5 * (low - high) / bend if bend > 0 else 0.0)


NOT_DRAWABLE = (SceneError, RenderError)
"""Errors of `draw_all` that say nothing about the recording: a model is not installed, or may not be read."""
