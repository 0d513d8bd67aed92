"""What a camera must have seen, drawn anew from the recorded numbers, beside what was recorded.

The renderer that draws a recording needs no simulator: poses follow from the recorded joints and objects. Images are
drawn small and compared with the recorded ones in cells (means over small areas), in which the coder's error nearly
vanishes while a motion of a tenth of a cell still shows. Depth and labels are compared in the same way: depth as a
brightness, labels as colours of a palette.

Not every frame has to be drawn: where both the recorded image and the recorded poses are what lies between those of
the frames around, so is the drawn image.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from demorec.check.base import Found, Measurement, NotMeasured
from demorec.check.cells import CellGrid, Cells, ImageKind, cell_side
from demorec.check.rows import finest_lag
from demorec.core.errors import RenderError, SceneError
from demorec.core.geometry import Array
from demorec.episode.scene import SceneCamera
from demorec.render import Renderer
from demorec.render.painter import Painter
from demorec.render.recorded import RecordedWorld

PIXELS_PER_CELL = 3
"""Pixels that are drawn along the side of a cell, at most. With 2 a check costs a tenth less, and images that are as
they should be are a quarter more unlike the drawn ones; with 4 it is the other way round."""
LOSSLESS_PIXELS_PER_CELL = 4
"""The same where depth or labels are drawn: these have no smooth edges, and every cell of them is compared."""


def draw(
    world: RecordedWorld,
    cameras: Iterable[SceneCamera],
    frames: NDArray[np.int64],
    kinds: Mapping[str, Iterable[ImageKind]],
    counts: Mapping[str, tuple[int, int]],
) -> dict[tuple[str, ImageKind], Cells]:
    """(camera, kind) -> (T, h, w, channels) what it must have seen in the frames of a world, up to the last one drawn.

    Args:
        world: What is drawn.
        cameras: Where from, in full size; those that are not among `kinds` are left out.
        frames: (N,) those that are drawn, in order, from 0 on; the images of the others are means of the drawn ones
            before and after, weighted by time.
        kinds: Camera name -> what is to be drawn of it.
        counts: Camera name -> (columns, rows) of its grid.

    Raises:
        SceneError, RenderError: It cannot be drawn.
    """
    cameras = tuple(camera for camera in cameras if camera.name in kinds)
    wanted = {kind for of_camera in kinds.values() for kind in of_camera}
    most = PIXELS_PER_CELL if wanted == {"color"} else LOSSLESS_PIXELS_PER_CELL
    small = tuple(small_camera(camera, counts[camera.name], most) for camera in cameras)
    grids = {camera.name: CellGrid(camera.width, camera.height, counts[camera.name]) for camera in small}
    cells: dict[tuple[str, ImageKind], Cells] = {
        (name, kind): np.empty((frames[-1] + 1, *grid.shape(kind)), dtype=np.float32)
        for name, grid in grids.items()
        for kind in kinds[name]
    }
    painter = Painter(
        warm_renderer(),
        small,
        depth="depth" in wanted,
        segmentation="labels" in wanted,
        # A hand close before its camera shows edges of another level of detail by several pixels elsewhere.
        detail={
            camera.name: round(few.height * float(camera.intrinsics[1, 1] / few.intrinsics[1, 1]))
            for camera, few in zip(cameras, small, strict=True)
        },
    )
    painter.setup(world)
    for frame in frames.tolist():
        world.frame = frame
        drawn = painter.images()
        for (name, kind), rows in cells.items():
            image = drawn[name]
            images = {"color": image.color, "depth": image.depth, "labels": image.segmentation}[kind]
            assert images is not None
            rows[frame] = grids[name].read(kind, images).cells
    for rows in cells.values():
        fill_between(rows, frames)
    return cells


_STRIDE = 3
"""Every so many frames are drawn in any case; odd, so that both kinds of images of a GOP of 2 are among them."""
_IMAGE_BETWEEN = 2.5
"""Of 255, root mean square over the cells: a recorded image that is farther from what lies between its neighbours is
drawn. Less than half of what makes an image odd or stale (`demorec.check.images`)."""
_POSE_BETWEEN = 0.005
"""Metres, or of a quaternion: the same for the poses."""


def frames_to_draw(seen: Iterable[Cells], poses: Array) -> NDArray[np.int64]:
    """(N,) frames whose drawn images tell those of the others, in order.

    Args:
        seen: Images of each camera, T frames, or fewer where the rest cannot be read.
        poses: (T, n, 7) of everything that can be seen: position, quaternion.
    """
    rows = [np.ascontiguousarray(cells).reshape(len(cells), -1) for cells in seen]
    chosen = np.arange(len(poses)) % _STRIDE == 0
    chosen[-1:] = True
    while True:
        # With other neighbours, frames may be placed less well than before.
        more = chosen | _not_between(rows, poses, *_neighbours(np.flatnonzero(chosen), len(poses)))
        if np.array_equal(more, chosen):
            return np.flatnonzero(chosen)
        chosen = more


def _not_between(
    seen: Iterable[NDArray[np.float32]],
    poses: Array,
    before: NDArray[np.int64],
    after: NDArray[np.int64],
    share: Array,
) -> NDArray[np.bool_]:
    """(T,) frames whose images or poses are not what lies between those of the frames before and after."""
    from demorec.check import kernels

    weight = share[:, None, None]
    off = np.abs(poses - (1 - weight) * poses[before] - weight * poses[after]).max(axis=(1, 2)) > _POSE_BETWEEN
    for rows in seen:
        there = np.flatnonzero(after[: len(rows)] < len(rows))
        off[len(there) : len(rows)] = True
        sums = np.zeros(len(there))
        kernels.squares_between(rows, before, after, share, sums)
        off[there] |= sums > _IMAGE_BETWEEN**2 * max(rows.shape[1], 1)
    return np.asarray(off)


def _neighbours(frames: NDArray[np.int64], count: int) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    """(count,) the chosen frame before each frame, the one after, and how far it is on the way; itself where chosen."""
    number = np.searchsorted(frames, np.arange(count))
    after = frames[number]
    before = np.where(after == np.arange(count), after, frames[np.maximum(number - 1, 0)])
    return before, after, (np.arange(count) - before) / np.maximum(after - before, 1)


def fill_between(cells: Cells, frames: NDArray[np.int64]) -> None:
    """Fill the frames of (T, h, w, c) that are not among the drawn ones."""
    before, after, share = _neighbours(frames, len(cells))
    for frame in np.flatnonzero(share).tolist():
        weight = np.float32(share[frame])
        cells[frame] = (1 - weight) * cells[before[frame]] + weight * cells[after[frame]]


@cache
def warm_renderer() -> Renderer:
    """Kept warm from one recording to the next: it has read the robot's meshes."""
    from demorec.render.raster import RasterRenderer

    return RasterRenderer()


def small_camera(camera: SceneCamera, counts: tuple[int, int], most: int) -> SceneCamera:
    """A camera that sees what the grid of the camera's cells covers, and no more, with few pixels."""
    side = cell_side(camera.width, camera.height, counts)
    share = counts[1] * side / camera.height
    return replace(
        camera,
        width=counts[0] * min(most, side),
        height=counts[1] * min(most, side),
        fov_y=camera.fov_y if share == 1 else 2 * math.atan(share * math.tan(camera.fov_y / 2)),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class ImageComparison:
    """Recorded images of a camera against the drawn ones, T frames.

    Attributes:
        shift: (2,) how far the recorded images are to the right of and below the drawn ones, of the height.
        scale: Share by which things are larger in the recorded images.
        lag: By how many frames the recorded images are late; None where too little moves to tell.
        unlike: (T,) root mean square difference of the cells, of 255, but for shift and scale.
        motion: (T,) root mean square change of the drawn cells since the frame before, of 255.
        shown: (T,) which share of that change the recorded image shows: 1 for good ones, 0 for a repeated one.
    """

    shift: Array
    scale: float
    lag: float | None
    unlike: Array
    motion: Array
    shown: Array


def judge_unlike(compared: ImageComparison | NotMeasured, what: str) -> Found:
    """By how much the usual image of a camera (`what`) is unlike the drawn one."""
    if isinstance(compared, NotMeasured):
        return compared
    return Measurement(value=float(np.median(compared.unlike)), detail=what)


def judge_lag(compared: ImageComparison | NotMeasured, what: str, view: str) -> Found:
    """By how many frames images (`what`) run behind the numbers, or before them; `view` names their camera."""
    if isinstance(compared, NotMeasured):
        return compared
    if compared.lag is None:
        return NotMeasured(why=f"too little moves before {view}")
    return Measurement(value=abs(compared.lag), detail=f"{what}: {compared.lag:+.2f} frames late")


_STRAY: dict[ImageKind, float] = {"depth": 1.0, "labels": 4.0}
"""Of 255: what is off by more is another depth (12 mm) or label."""
_TURNED_STRAY = 16.0
"""The same where a camera's turn was found in its images: what is left of it moves edges by a twentieth of a cell."""
_MAX_LAG = 3
_MOVING = 1.0
_MIN_MOVING = 12
"""A lag is measured from this many frames on in which the drawn cells change by so much (root mean square, of 255)."""


def fit(seen: Cells, drawn: Cells, frames: NDArray[np.int64]) -> Array:
    """(4,) by how much the recorded images are to the right, below (cells), larger (share) and turned (rad)."""
    from demorec.check import kernels

    # Frames that are something else altogether must not decide how far the others are shifted.
    size = _rms(seen, drawn, frames)
    usual = frames[size <= 3 * np.median(size) + 1e-6]
    gram, right = np.zeros((4, 4)), np.zeros(4)
    kernels.normal_equations(seen, drawn, usual, gram, right)
    # Enough that a direction in which nothing can be measured gets nothing.
    gram += np.eye(4) * max(1e-3 * float(np.trace(gram)) / 4, 1e-9)
    return np.asarray(np.linalg.solve(gram, right))


def compare(seen: Cells, drawn: Cells, frames: NDArray[np.int64]) -> ImageComparison:
    """Least squares over the drawn frames: seen = drawn, but shifted, scaled and turned by one amount each.

    Args:
        seen: (T, h, w, channels) as recorded.
        drawn: The same of at least T frames, as of `draw`.
        frames: Those that were drawn.
    """
    from demorec.check import kernels

    drawn, frames = drawn[: len(seen)], frames[frames < len(seen)]
    found = fit(seen, drawn, frames)
    fitted = np.empty_like(drawn)
    kernels.add_bases(drawn, found, fitted)
    moved, shown = np.zeros(len(seen)), np.zeros(len(seen))
    kernels.compare_steps(_flat(seen), _flat(drawn), moved, shown)
    motion = np.sqrt(moved / max(drawn[0].size, 1))
    return ImageComparison(
        shift=found[:2] / drawn.shape[1],
        scale=float(found[2]),
        lag=_lag(seen, fitted, frames[motion[frames] > _MOVING]),
        unlike=_rms(seen, fitted, np.arange(len(seen))),
        motion=motion,
        shown=shown / np.maximum(moved, 1e-6),
    )


def strays(seen: Cells, drawn: Cells, kind: ImageKind, *, is_turned: bool = False) -> Array:
    """(T,) share of the cells whose value lies outside those of the drawn cell and its eight neighbours.

    For depth and labels, which are coded without loss: edges may lie elsewhere by a cell, nothing else may differ.
    Cells at the image's border, some of whose neighbours are not in it, are left out.
    """
    drawn = drawn[: len(seen)]
    height, width = (max(size - 2, 0) for size in drawn.shape[1:3])
    around = [drawn[:, i : i + height, j : j + width] for i in range(3) for j in range(3)]
    low, high = around[0].copy(), around[0].copy()
    for cells in around[1:]:
        np.minimum(low, cells, out=low)
        np.maximum(high, cells, out=high)
    inner = seen[:, 1 : 1 + height, 1 : 1 + width]
    off = np.maximum(low - inner, inner - high).max(axis=3) > (_TURNED_STRAY if is_turned else _STRAY[kind])
    return np.asarray(off.sum(axis=(1, 2)) / max(height * width, 1), dtype=np.float64)


def _rms(a: Cells, b: Cells, frames: NDArray[np.int64], late: int = 0) -> Array:
    """Root mean square difference over the cells, of some frames of b from those `late` frames later in a."""
    from demorec.check import kernels

    squares = np.zeros(len(frames))
    kernels.squares(_flat(a), _flat(b), frames, late, squares)
    return np.asarray(np.sqrt(squares / max(b[0].size, 1)), dtype=np.float64)


def _flat(cells: Cells) -> Cells:
    """(T, K) all numbers of each frame."""
    return np.ascontiguousarray(cells).reshape(len(cells), -1)


def _lag(seen: Cells, drawn: Cells, moving: NDArray[np.int64]) -> float | None:
    """By how many frames `seen` runs behind `drawn`: whole lags, and a parabola through the best and its neighbours."""
    rows = moving[(moving >= _MAX_LAG) & (moving < len(seen) - _MAX_LAG)]
    if len(rows) < _MIN_MOVING:
        return None
    lags = range(-_MAX_LAG, _MAX_LAG + 1)
    errors = [float((_rms(seen, drawn, rows, lag) ** 2).mean()) for lag in lags]
    return finest_lag(lags, errors)


NOT_DRAWABLE = (SceneError, RenderError)
"""Errors of `draw` that say nothing about the recording: a model is not installed, or may not be read."""
