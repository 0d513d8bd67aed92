"""What a camera must have seen, drawn anew from the recorded numbers, beside what was recorded.

The renderer that draws a recording needs no simulator: poses follow from the recorded joints and objects. Every picture
is drawn small and compared with the recorded one in cells (means over small areas), in which the coder's error nearly
vanishes while a motion of a tenth of a cell still shows. Depth and labels are compared in the same way: depth as a
brightness, labels as colours of a palette.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from demorec.check.cells import CellGrid, Cells, Kind, cell_counts
from demorec.errors import RenderError, SceneError
from demorec.geometry import Array
from demorec.render import Renderer
from demorec.render.painter import Painter
from demorec.render.recorded import RecordedWorld
from demorec.scene.episode import EpisodeColumns, EpisodeInfo
from demorec.scene.scene import Camera

LONGER_SIDE = 112
"""Pixels that are drawn along the longer side, at most."""


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
    world = RecordedWorld(
        info.robot, info.scene, joint_position=columns.joint_position, object_poses=columns.object_poses
    )
    # The recorded pictures' grid: the small ones' own may have a row more or less.
    counts = {camera.name: cell_counts(camera.width, camera.height) for camera in info.scene.cameras}
    return draw(world, columns.num_frames, kinds, counts)


def draw(
    world: RecordedWorld,
    num_frames: int,
    kinds: Mapping[str, Iterable[Kind]],
    counts: Mapping[str, tuple[int, int]],
) -> dict[tuple[str, Kind], Cells]:
    """(camera, kind) -> cells of the first frames of a world, in a grid of (columns, rows) for each camera.

    Raises:
        SceneError, RenderError: It cannot be drawn.
    """
    cameras = tuple(_small(camera) for camera in world.scene.cameras if camera.name in kinds)
    wanted = {kind for of_camera in kinds.values() for kind in of_camera}
    grids = {camera.name: CellGrid(camera.width, camera.height, counts[camera.name]) for camera in cameras}
    found: dict[tuple[str, Kind], list[Cells]] = {(name, kind): [] for name in grids for kind in kinds[name]}
    painter = Painter(_renderer(), cameras, depth="depth" in wanted, segmentation="labels" in wanted)
    painter.setup(world)
    for frame in range(num_frames):
        world.frame = frame
        images = painter.images()
        for name, kind in found:
            image = images[name]
            pictures = {"color": image.color, "depth": image.depth, "labels": image.segmentation}[kind]
            assert pictures is not None
            found[name, kind].append(grids[name].read(kind, pictures).cells)
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
    from demorec.check import kernels

    drawn = drawn[: len(seen)]
    # Frames that are something else altogether must not decide how far the others are shifted.
    size = _rms(seen - drawn)
    usual = np.flatnonzero(size <= 3 * np.median(size) + 1e-6)
    gram, right = np.zeros((4, 4)), np.zeros(4)
    kernels.normal_equations(seen, drawn, usual, gram, right)
    # Enough that a direction in which nothing can be told gets nothing.
    gram += np.eye(4) * max(1e-3 * float(np.trace(gram)) / 4, 1e-9)
    found = np.linalg.solve(gram, right)
    fitted = np.empty_like(drawn)
    kernels.add_bases(drawn, found, fitted)
    step, observed = np.zeros_like(drawn), np.zeros_like(drawn)
    np.subtract(drawn[1:], drawn[:-1], out=step[1:])
    np.subtract(seen[1:], seen[:-1], out=observed[1:])
    motion = _rms(step)
    return Comparison(
        shift=found[:2] / drawn.shape[1],
        scale=float(found[2]),
        lag=_lag(seen, fitted, motion > _MOVING),
        unlike=_rms(seen - fitted),
        motion=motion,
        shown=_products(observed, step) / np.maximum(_products(step, step), 1e-6),
    )


def strays(seen: Cells, drawn: Cells) -> Array:
    """(T,) share of the cells whose value lies outside those of the drawn cell and its eight neighbours.

    For depth and labels, which are coded without loss: edges may lie elsewhere by a cell, nothing else may differ.
    Cells at the picture's border, some of whose neighbours are not in it, are left out.
    """
    drawn = drawn[: len(seen)]
    height, width = (max(size - 2, 0) for size in drawn.shape[1:3])
    around = [drawn[:, i : i + height, j : j + width] for i in range(3) for j in range(3)]
    low, high = around[0].copy(), around[0].copy()
    for cells in around[1:]:
        np.minimum(low, cells, out=low)
        np.maximum(high, cells, out=high)
    inner = seen[:, 1 : 1 + height, 1 : 1 + width]
    off = np.maximum(low - inner, inner - high).max(axis=3) > _STRAY
    return np.asarray(off.sum(axis=(1, 2)) / max(height * width, 1), dtype=np.float64)


def _rms(cells: Cells) -> Array:
    """(T,) root mean square over each frame's cells."""
    return np.asarray(np.sqrt(_products(cells, cells) / max(cells[0].size, 1)), dtype=np.float64)


def _products(a: Cells, b: Cells) -> Array:
    """(T,) sum of the products of each frame's cells."""
    return np.asarray(np.einsum("ti,ti->t", a.reshape(len(a), -1), b.reshape(len(b), -1)), dtype=np.float64)


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
