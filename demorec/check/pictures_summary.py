"""One pass over a camera's pictures: all that any check needs of them, so that they are decoded once.

Where things are in a picture is found by colour: a body whose hue no other body of the scene has is looked for in
the picture, and drawn where its recorded pose, the extrinsics and K say it must be. No renderer is needed.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from demorec.check.rows import inverse, matrices
from demorec.errors import RecordingError
from demorec.geometry import Array
from demorec.recording import Recording
from demorec.scene.episode import EpisodeColumns
from demorec.scene.scene import Body, Camera, Rgba, Scene

LONGER_SIDE = 160
"""Colour is looked for on every n-th pixel of every n-th row, n such that no more than this many are left."""
HUE_TOLERANCE = math.radians(16.0)
MIN_SATURATION = 0.5
"""Of a body that is looked for."""
BLOCK = 8
_BATCH = 16


@dataclass(frozen=True, kw_only=True, eq=False)
class Track:
    """Where a body is in the pictures of a camera, and where it must be; areas and places in pixels.

    Attributes:
        seen_area: (T,) pixels of the body's colour.
        seen: (T, 2) their centre (u, v); NaN where there are none.
        drawn_area: (T,) pixels that the body covers by pose, extrinsics and K, if nothing is in front of it.
        drawn: (T, 2) their centre; NaN where there are none.
        overlap: (T,) pixels that are both.
        is_whole: (T,) whether all of the body is within the picture.
    """

    seen_area: Array
    seen: Array
    drawn_area: Array
    drawn: Array
    overlap: Array
    is_whole: NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True, eq=False)
class PictureSummary:
    """What is known of a camera's pictures after decoding them.

    Attributes:
        num_pictures: How many could be decoded.
        error: Why decoding ended early, or "".
        mean: (N, 3) mean colour, 0..255.
        dark, bright: (N,) share of pixels that are nearly black or nearly white.
        change: (N - 1,) largest change, from one picture to the next, of the mean of a block of 8 x 8 pixels.
        thumbnails: (N, h, w) grey, block means.
        tracks: body name -> Track, of bodies that can be told by their colour.
    """

    num_pictures: int
    error: str
    mean: Array
    dark: Array
    bright: Array
    change: Array
    thumbnails: NDArray[np.float32]
    tracks: Mapping[str, Track] = field(default_factory=dict)


def summarise(recording: Recording, columns: EpisodeColumns, camera: Camera) -> PictureSummary:
    """Decode all pictures of a camera once."""
    scene = recording.info.scene
    bodies = tracked_bodies(scene)
    finder = _Finder(camera, [_expected_color(body, scene) for body in bodies])
    drawer = _Drawer(columns, camera, recording.calibration(camera.name).intrinsics, bodies, finder)
    means, dark, bright, thumbnails = [], [], [], []
    rows: list[list[tuple[float, ...]]] = [[] for _ in bodies]
    error = ""
    try:
        for start, batch in _batches(recording.images(camera.name)):
            # Channel by channel: NumPy is slow over a last axis of three.
            planes = [np.ascontiguousarray(batch[..., c]).astype(np.float32) for c in range(3)]
            means.append(np.stack([plane.mean(axis=(1, 2)) for plane in planes], axis=1))
            grey = (planes[0] + planes[1] + planes[2]) * np.float32(1 / 3)
            dark.append((grey < 12).mean(axis=(1, 2)))
            bright.append((grey > 250).mean(axis=(1, 2)))
            thumbnails.append(_block_means(grey))
            for number, masks in enumerate(finder.find(planes)):
                rows[number] += [drawer.row(number, start + t, mask) for t, mask in enumerate(masks)]
    except RecordingError as problem:
        error = str(problem)
    thumbs = np.concatenate(thumbnails) if thumbnails else np.empty((0, 1, 1), dtype=np.float32)
    return PictureSummary(
        num_pictures=len(thumbs),
        error=error,
        mean=np.concatenate(means) if means else np.empty((0, 3)),
        dark=np.concatenate(dark) if dark else np.empty(0),
        bright=np.concatenate(bright) if bright else np.empty(0),
        change=np.abs(np.diff(thumbs, axis=0)).max(axis=(1, 2)) if len(thumbs) > 1 else np.empty(0),
        thumbnails=thumbs,
        tracks={body.name: _track(rows[number]) for number, body in enumerate(bodies)},
    )


def _batches(pictures: Iterable[NDArray[np.uint8]]) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    batch: list[NDArray[np.uint8]] = []
    start = 0
    try:
        for picture in pictures:
            batch.append(picture)
            if len(batch) == _BATCH:
                yield start, np.stack(batch)
                start, batch = start + len(batch), []
    except Exception:
        if batch:  # what came before the damage counts
            yield start, np.stack(batch)
        raise
    if batch:
        yield start, np.stack(batch)


def _block_means(grey: NDArray[np.float32]) -> NDArray[np.float32]:
    height, width = grey.shape[1:]
    h, w = max(height // BLOCK, 1), max(width // BLOCK, 1)
    rows, cols = min(BLOCK, height), min(BLOCK, width)
    columns = np.add.reduceat(grey[:, :, : w * cols], np.arange(0, w * cols, cols), axis=2)
    sums = np.add.reduceat(columns[:, : h * rows], np.arange(0, h * rows, rows), axis=1)
    return np.asarray(sums / np.float32(rows * cols), dtype=np.float32)


def _track(rows: list[tuple[float, ...]]) -> Track:
    table = np.array(rows, dtype=np.float64).reshape(-1, 8)
    return Track(
        seen_area=table[:, 0],
        seen=table[:, 1:3],
        drawn_area=table[:, 3],
        drawn=table[:, 4:6],
        overlap=table[:, 6],
        is_whole=table[:, 7] > 0,
    )


# ---------------------------------------------------------------------------------------------------- colours


def tracked_bodies(scene: Scene) -> list[Body]:
    """The objects and targets that can be told by their hue from everything else in the scene."""
    candidates = [
        body
        for body in scene.bodies
        if body.role in ("object", "target", "distractor")
        and body.texture is None
        and body.shape.kind not in ("mesh", "urdf")
    ]
    return [body for body in candidates if _is_distinct(body, scene)]


def _is_distinct(body: Body, scene: Scene) -> bool:
    hue, saturation = _hue_saturation(body.rgba)
    if saturation < MIN_SATURATION:
        return False
    for other in scene.bodies:
        if other.name == body.name:
            continue
        if other.shape.kind in ("mesh", "urdf") and other.rgba == (1.0, 1.0, 1.0, 1.0):
            return False  # its own colours are not known here
        colors = [(*c, 1.0) for c in other.texture.colors] if other.texture else [other.rgba]
        for color in colors:
            other_hue, other_saturation = _hue_saturation(color)
            if other_saturation > 0.35 * saturation and _turn(hue, other_hue) < 2 * HUE_TOLERANCE:
                return False
    return True


def _expected_color(body: Body, scene: Scene) -> Rgba:
    r, g, b, a = body.rgba
    light = scene.light.color
    return (r * light[0], g * light[1], b * light[2], a)


def _hue_saturation(color: Rgba) -> tuple[float, float]:
    """Hue, rad, and saturation (chroma over value, 0..1)."""
    r, g, b = color[:3]
    value = max(r, g, b)
    hue = math.atan2(math.sqrt(0.75) * (g - b), r - (g + b) / 2)
    return hue, (value - min(r, g, b)) / value if value > 0 else 0.0


def _turn(a: float, b: float) -> float:
    return abs((a - b + math.pi) % (2 * math.pi) - math.pi)


class _Finder:
    """Looks for colours in pictures, on a grid of every n-th pixel."""

    def __init__(self, camera: Camera, colors: list[Rgba]) -> None:
        self.step = -(-max(camera.width, camera.height) // LONGER_SIDE)
        self.offset = self.step // 2
        self.u: Array = np.arange(self.offset, camera.width, self.step, dtype=np.float64) + 0.5  # pixel centres
        self.v: Array = np.arange(self.offset, camera.height, self.step, dtype=np.float64) + 0.5
        self._colors = [_hue_saturation(color) for color in colors]

    def find(self, planes: list[NDArray[np.float32]]) -> list[NDArray[np.bool_]]:
        """For each colour (N, h, w): whether a pixel of the grid has its hue; planes are red, green, blue (N, H, W)."""
        if not self._colors:
            return []
        r, g, b = (np.ascontiguousarray(p[:, self.offset :: self.step, self.offset :: self.step]) for p in planes)
        alpha, beta = r - np.float32(0.5) * (g + b), np.float32(math.sqrt(0.75)) * (g - b)
        strength = np.sqrt(alpha * alpha + beta * beta)
        value = np.maximum(np.maximum(r, g), b)
        chroma = value - np.minimum(np.minimum(r, g), b)
        masks = []
        for hue, saturation in self._colors:
            along = alpha * np.float32(math.cos(hue)) + beta * np.float32(math.sin(hue))
            masks.append(
                (along > np.float32(math.cos(HUE_TOLERANCE)) * strength)
                & (chroma > np.float32(0.5 * saturation) * value)
                & (value > 30)
            )
        return masks


class _Drawer:
    """Draws the outlines of bodies on the finder's grid, from recorded poses, extrinsics and K."""

    def __init__(self, columns: EpisodeColumns, camera: Camera, k: Array, bodies: list[Body], finder: _Finder) -> None:
        self._camera = camera
        self._u, self._v = finder.u, finder.v
        self._pixels = float(finder.step**2)
        camera_from_world = inverse(matrices(columns.world_from_camera[camera.name]))
        self._points: list[Array] = []  # per body (T, P, 3): u, v, depth
        for body in bodies:
            poses = columns.object_poses.get(body.name)
            pose = body.world_from_body.matrix()[None] if poses is None else matrices(poses)
            corners = _outline_points(body)
            relative = camera_from_world @ pose
            points = np.einsum("tij,pj->tpi", relative[:, :3, :3], corners) + relative[:, None, :3, 3]
            depth = np.where(np.abs(points[..., 2]) < 1e-9, 1e-9, points[..., 2])
            u = k[0, 0] * points[..., 0] / depth + k[0, 2]
            v = k[1, 1] * points[..., 1] / depth + k[1, 2]
            self._points.append(np.stack([u, v, points[..., 2]], axis=2))

    def row(self, number: int, frame: int, mask: NDArray[np.bool_]) -> tuple[float, ...]:
        """A row of `Track`: seen area, u, v, drawn area, u, v, overlap, is_whole."""
        nan = float("nan")
        seen = self._centre(np.nonzero(mask))
        points = self._points[number]
        if frame >= len(points):
            return (*seen, 0.0, nan, nan, 0.0, 0.0)
        uvz = points[frame]
        if uvz[:, 2].min() < self._camera.near:
            return (*seen, 0.0, nan, nan, 0.0, 0.0)
        hull = _convex_hull(uvz[:, :2])
        low, high = uvz[:, :2].min(axis=0), uvz[:, :2].max(axis=0)
        cols = slice(*np.searchsorted(self._u, [low[0], high[0]]))
        rows = slice(*np.searchsorted(self._v, [low[1], high[1]]))
        inside = _inside(hull, self._u[cols], self._v[rows])
        overlap = float((inside & mask[rows, cols]).sum()) * self._pixels
        v, u = np.nonzero(inside)
        drawn = self._centre((v + rows.start, u + cols.start))
        whole = low.min() >= 0 and high[0] <= self._camera.width and high[1] <= self._camera.height
        return (*seen, *drawn, overlap, float(whole))

    def _centre(self, index: tuple[NDArray[np.intp], ...]) -> tuple[float, float, float]:
        v, u = index
        if not len(u):
            return 0.0, float("nan"), float("nan")
        return len(u) * self._pixels, float(self._u[u].mean()), float(self._v[v].mean())


def _outline_points(body: Body) -> Array:
    """(P, 3) points whose projection has the body's outline as its convex hull, in the body's frame."""
    half = np.array(body.shape.extents) / 2
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float64)
    if body.shape.kind == "box":
        return np.asarray(corners * half)
    angles = np.arange(24) * (2 * math.pi / 24)
    ring = np.stack([np.cos(angles), np.sin(angles), np.zeros(24)], axis=1) * half[0]
    if body.shape.kind == "cylinder":
        up = np.array([0.0, 0.0, half[2]])
        return np.concatenate([ring + up, ring - up])
    middle = 0.0 if body.shape.kind == "sphere" else body.shape.size[1] / 2
    latitudes = np.linspace(-math.pi / 2, math.pi / 2, 9)
    rows = [ring * math.cos(a) + [0, 0, half[0] * math.sin(a) + math.copysign(middle, a)] for a in latitudes]
    return np.concatenate(rows)


def _convex_hull(points: Array) -> Array:
    """(H, 2) counter-clockwise corners (Andrew's monotone chain)."""
    ordered = sorted(set(map(tuple, points.tolist())))
    if len(ordered) < 3:
        return np.array(ordered)

    def half(sequence: list[tuple[float, float]]) -> list[tuple[float, float]]:
        chain: list[tuple[float, float]] = []
        for x, y in sequence:
            while len(chain) > 1:
                (ax, ay), (bx, by) = chain[-2], chain[-1]
                if (bx - ax) * (y - ay) - (by - ay) * (x - ax) > 0:
                    break
                chain.pop()
            chain.append((x, y))
        return chain[:-1]

    return np.array(half(ordered) + half(ordered[::-1]))


def _inside(hull: Array, u: Array, v: Array) -> NDArray[np.bool_]:
    """(V, U) whether the points of a grid are in a convex polygon."""
    inside = np.ones((len(v), len(u)), dtype=bool)
    if len(hull) < 3:
        return ~inside
    for (ax, ay), (bx, by) in zip(hull, np.roll(hull, -1, axis=0), strict=True):
        inside &= (bx - ax) * (v[:, None] - ay) - (by - ay) * (u[None, :] - ax) >= 0
    return inside
