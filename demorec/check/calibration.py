"""Do cameras see what their calibration says: K, extrinsics, names, depth units, pictures the right way round."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from demorec.check.base import Measurement, check, worst
from demorec.check.episode import RecordedEpisode
from demorec.check.pictures_summary import Track
from demorec.check.rows import displacement, matrices
from demorec.errors import RecordingError
from demorec.geometry import Array
from demorec.recording import channels
from demorec.scene.scene import Camera

MIN_AREA = 30.0
"""Pixels that a body must cover, at 160 pixels a side, to be located."""


@check(
    group="calibration",
    measures="K of the camera's message against size and field of view",
    unit="px",
    warn=0.01,
    fail=0.5,
)
def intrinsics(episode: RecordedEpisode) -> Measurement | None:
    """The calibration message agrees with the scene's camera and the pictures' size."""
    found = []
    for camera in episode.cameras:
        scan = episode.scan.get(channels.camera_topic(camera.name, "camera_info"))
        if scan is None or not scan.first:
            found.append(Measurement(value=math.inf, detail=f"camera {camera.name} has no calibration"))
            continue
        told = episode.recording.calibration(camera.name)
        settings = episode.recording.video_settings(camera.name)
        off = float(np.abs(told.intrinsics - camera.intrinsics).max())
        off = max(off, abs(told.width - settings.width), abs(told.height - settings.height))
        found.append(Measurement(value=off, detail=f"camera {camera.name}"))
    return worst(*found)


@check(
    group="calibration", measures="extrinsics against the camera's mount on the robot", unit="m", warn=1e-5, fail=1e-3
)
def extrinsics(episode: RecordedEpisode) -> Measurement | None:
    """Recorded camera poses are those of the mount, by forward kinematics (0.1 m per rad of rotation)."""
    found = []
    for camera in episode.cameras:
        off = displacement(matrices(episode.columns.world_from_camera[camera.name]), _expected(episode, camera))
        if len(off):
            frame = int(np.argmax(off))
            found.append(Measurement(value=float(off[frame]), frame=frame, detail=f"camera {camera.name}"))
    return worst(*found)


def _expected(episode: RecordedEpisode, camera: Camera) -> Array:
    mounted = camera.mount_from_camera.matrix()[None]
    if camera.mount == "world":
        return np.broadcast_to(mounted, (episode.num_frames, 4, 4))
    try:
        link = episode.base_from_link(camera.mount, episode.columns.joint_position)
    except RecordingError as error:
        if not isinstance(error.__cause__, KeyError):  # damage is no wrong camera
            raise
        return np.full((episode.num_frames, 4, 4), np.inf)
    return np.asarray(episode.world_from_base @ link @ mounted)


def _located(track: Track, camera: Camera, *, least: float = 0.7) -> NDArray[np.bool_]:
    """(N,) frames in which a body is in full view: as large in colour as drawn, and all of it in the picture.

    A share of `least` must show: what fingers or another body hide moves the middle of the rest.
    """
    ratio = track.seen_area / np.maximum(track.drawn_area, 1.0)
    enough = track.drawn_area > MIN_AREA * _scale(camera) ** 2
    return np.asarray(track.is_whole & enough & (ratio > least) & (ratio < 1.4))


def _scale(camera: Camera) -> float:
    return max(camera.width, camera.height) / 160.0


@check(
    group="calibration",
    measures="distance between where bodies are in the picture and where their poses project to, of its height",
    unit="%",
    warn=3.5,
    fail=5.0,
    needs_pictures=True,
)
def projection(episode: RecordedEpisode) -> Measurement | None:
    """Known poses, projected with K and extrinsics, fall on pixels of the body's colour.

    Catches mirrored and flipped pictures, a wrong K, the pictures or the name of another camera, swapped colour
    channels. Bodies are looked for by hue; the value is the 90th percentile over the frames in full view.
    """
    found = []
    for camera in episode.cameras:
        offsets: list[float] = []
        frames: list[int] = []
        for name, track in episode.pictures(camera).tracks.items():
            rows = np.flatnonzero(_located(track, camera, least=0.88))
            offsets += np.linalg.norm(track.seen[rows] - track.drawn[rows], axis=1).tolist()
            frames += rows.tolist()
            drawn = track.is_whole & (track.drawn_area > MIN_AREA * _scale(camera) ** 2)
            # Nothing hides an object from all of half an episode in which it is in view.
            if drawn.sum() >= max(10, 0.5 * len(drawn)):
                covered = float(np.quantile(track.overlap[drawn] / track.drawn_area[drawn], 0.9))
                if covered < 0.1:
                    frame = int(np.argmax(drawn))
                    detail = f"camera {camera.name}: {name} is not where it must be in any picture"
                    found.append(Measurement(value=math.inf, frame=frame, detail=detail))
        if len(offsets) >= 5:
            order = np.argsort(offsets)
            place = int(order[int(0.9 * (len(order) - 1))])
            value = 100 * offsets[place] / camera.height
            detail = f"camera {camera.name}: {offsets[place]:.1f} px in {len(offsets)} views of a body"
            found.append(Measurement(value=value, frame=frames[place], detail=detail))
    return worst(*found)


@check(
    group="calibration",
    measures="apparent size of bodies in the picture against their projection, off 1",
    warn=0.15,
    fail=0.25,
    needs_pictures=True,
)
def projected_size(episode: RecordedEpisode) -> Measurement | None:
    """Bodies are as large in the picture as their distance and K make them: catches a wrong focal length or scale."""
    found = []
    for camera in episode.cameras:
        for name, track in episode.pictures(camera).tracks.items():
            # Only what is large: at small sizes the coding of colours at half resolution adds or takes an edge.
            rows = np.flatnonzero(track.is_whole & (track.drawn_area > 15 * MIN_AREA * _scale(camera) ** 2))
            if len(rows) < 8:
                continue
            ratio = np.sqrt(track.seen_area[rows] / track.drawn_area[rows])
            # What covers a body partly makes the ratio smaller: too small is what is so in its fullest views too.
            value = float(np.quantile(ratio, 0.75))
            if value < 1.0:
                value = min(1.0, float(np.quantile(ratio, 0.95)))
            frame = int(rows[int(np.argmin(np.abs(ratio - value)))])
            detail = f"camera {camera.name}: {name} appears {value:.2f} times as large"
            found.append(Measurement(value=abs(value - 1.0), frame=frame, detail=detail))
    return worst(*found)


@check(
    group="alignment",
    measures="lag between pictures and poses, frames",
    warn=0.5,
    fail=0.7,
    needs_pictures=True,
)
def picture_lag(episode: RecordedEpisode) -> Measurement | None:
    """Picture t shows state t: bodies that move in the picture are where the poses of the same frame put them.

    A picture that is late by L frames shows a body at drawn - L * velocity. Least squares over all stretches in
    which a body is in full view, each with a constant offset of its own (fingers may cover a part of it).
    """
    found = []
    for camera in episode.cameras:
        along = power = 0.0
        count = 0
        for track in episode.pictures(camera).tracks.values():
            located = _located(track, camera)
            if len(located) < 3:
                continue
            velocity = np.zeros_like(track.drawn)
            velocity[1:-1] = (track.drawn[2:] - track.drawn[:-2]) / 2
            located[1:-1] &= np.isfinite(velocity[1:-1]).all(axis=1)
            located[[0, -1]] = False
            for rows in _stretches(located):
                v = velocity[rows] - velocity[rows].mean(axis=0)
                gap = track.seen[rows] - track.drawn[rows]
                along -= float(((gap - gap.mean(axis=0)) * v).sum())
                power += float((v * v).sum())
                count += len(rows)
        # Enough motion that an edge of a pixel more or less cannot pass for a frame.
        if count < 15 or power < 100.0 * _scale(camera) ** 2:
            continue
        lag = along / power
        detail = f"camera {camera.name}: pictures {lag:+.2f} frames late, from {count} views of bodies"
        found.append(Measurement(value=abs(lag), detail=detail))
    return worst(*found)


def _stretches(flags: NDArray[np.bool_]) -> list[NDArray[np.intp]]:
    """Rows of each run of at least 8 True."""
    rows = np.flatnonzero(flags)
    runs = np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1)
    return [run for run in runs if len(run) >= 8]


_DEPTH_FRAMES, _DEPTH_GRID = 4, 24


@check(
    group="calibration",
    measures="median difference of depth pictures from distances to the scene's boxes",
    unit="m",
    warn=0.01,
    fail=0.03,
    needs_pictures=True,
)
def depth_matches_scene(episode: RecordedEpisode) -> Measurement | None:
    """Depth is metres along the optical axis: catches millimetres, distances along the ray, flipped pictures.

    Rays through a grid of pixels are intersected with the boxes of the scene (table, floor, cubes); the median bears
    that the robot stands in front of some.
    """
    found = []
    for camera in episode.cameras:
        if not episode.recording.has_depth(camera.name):
            continue
        frames = set(np.linspace(0, episode.num_frames - 1, _DEPTH_FRAMES).round().astype(int).tolist())
        for frame, depth in enumerate(episode.recording.depth(camera.name)):
            if frame not in frames:
                continue
            expected, rows, cols = _box_depth(episode, camera, frame)
            seen = depth[rows, cols].astype(np.float64)
            known = np.isfinite(expected) & (expected < camera.far) & (expected > camera.near)
            if known.sum() < 20:
                continue
            off = np.where(seen[known] > 0, np.abs(seen[known] - expected[known]), np.inf)
            found.append(Measurement(value=float(np.median(off)), frame=frame, detail=f"camera {camera.name}"))
    return worst(*found)


def _box_depth(episode: RecordedEpisode, camera: Camera, frame: int) -> tuple[Array, Array, Array]:
    """(N,) depth of the nearest box at pixels of a grid, infinite where there is none; the pixels' rows and columns."""
    rows, cols = (
        grid.reshape(-1)
        for grid in np.meshgrid(
            np.linspace(0, camera.height - 1, _DEPTH_GRID).astype(int),
            np.linspace(0, camera.width - 1, _DEPTH_GRID).astype(int),
            indexing="ij",
        )
    )
    k = episode.recorded_intrinsics(camera.name)
    rays = np.stack([(cols + 0.5 - k[0, 2]) / k[0, 0], (rows + 0.5 - k[1, 2]) / k[1, 1], np.ones(len(rows))], axis=1)
    camera_from_world = episode.camera_from_world(camera.name)[frame]
    nearest: Array = np.full(len(rays), np.inf)
    for body in episode.info.scene.bodies:
        if body.shape.kind != "box":
            continue
        poses = episode.columns.object_poses.get(body.name)
        pose = body.world_from_body.matrix() if poses is None else matrices(poses[frame : frame + 1])[0]
        body_from_camera = np.linalg.inv(camera_from_world @ pose)
        origin, directions = body_from_camera[:3, 3], rays @ body_from_camera[:3, :3].T
        directions = np.where(np.abs(directions) < 1e-12, 1e-12, directions)
        half = np.array(body.shape.size) / 2
        near, far = (-half - origin) / directions, (half - origin) / directions
        enter, leave = np.minimum(near, far).max(axis=1), np.maximum(near, far).min(axis=1)
        hit = (enter < leave) & (enter > 0)
        nearest = np.where(hit, np.minimum(nearest, enter), nearest)
    return nearest, rows, cols


@check(
    group="calibration",
    measures="share of bodies whose centre is labelled as what lies behind them",
    warn=0.1,
    fail=0.3,
    needs_pictures=True,
)
def segmentation_matches_scene(episode: RecordedEpisode) -> Measurement | None:
    """At the pixel of a body's centre the segmentation has the body or something in front of it, never its support."""
    found = []
    for camera in episode.cameras:
        if not episode.recording.has_segmentation(camera.name):
            continue
        names = episode.recording.segment_names()
        behind = {body.name for body in episode.info.scene.bodies if body.role in ("support", "fixture")}
        wrong, total, first = 0, 0, None
        k = episode.recorded_intrinsics(camera.name)
        frames = set(np.linspace(0, episode.num_frames - 1, 12).round().astype(int).tolist())
        for frame, labels in enumerate(episode.recording.segmentation(camera.name)):
            if frame not in frames:
                continue
            for body in episode.info.scene.movable:
                place = np.append(episode.columns.object_poses[body.name][frame, :3], 1.0)
                x, y, z = (episode.camera_from_world(camera.name)[frame] @ place)[:3]
                if z < camera.near:
                    continue
                u, v = math.floor(k[0, 0] * x / z + k[0, 2]), math.floor(k[1, 1] * y / z + k[1, 2])
                if not (0 <= u < camera.width and 0 <= v < camera.height):
                    continue
                total += 1
                value = int(labels[v, u])
                if value == -1 or names.get(value, "") in behind:
                    wrong += 1
                    first = frame if first is None else first
        if total:
            found.append(Measurement(value=wrong / total, frame=first, detail=f"camera {camera.name}, {total} places"))
    return worst(*found)
