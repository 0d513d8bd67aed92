"""The images of an episode as its recorded numbers make them.

Recorded camera poses may be off on purpose, as those of a real camera are (`--variation full`). The recording tells by
how much, so that the images are drawn from where the camera was. Older recordings tell the error's offset, and how
far but not about which axis it turns: there the turn is found in the images, as far as it is no larger than stated.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demorec.check.cells import Cells, ImageKind, cell_counts, cell_side
from demorec.check.drawn import draw, fit, frames_to_draw, warm_renderer
from demorec.core.geometry import Array, Pose
from demorec.episode.camera_error import stated_error, true_camera
from demorec.episode.episode import Columns
from demorec.episode.info import EpisodeInfo
from demorec.episode.scene import Scene, SceneCamera
from demorec.render.painter import Painter
from demorec.render.recorded import RecordedWorld

_NUM_FITTED = 9
"""Frames that are drawn to find how far a camera is turned."""
_NUM_STEPS = 2
"""Fits, each from where the last one led: the first comes out too large by a tenth or two, since cells blur edges."""
_TURN_MARGIN = 1.3
"""A turn that comes out larger than what is stated, by this factor, is no calibration error."""


@dataclass(frozen=True, kw_only=True, eq=False)
class DrawnEpisode:
    """What the cameras of an episode must have seen.

    Attributes:
        frames: (N,) that were drawn, in order, the first and the last among them.
        cells: (camera, kind) -> (T, h, w, channels) as by `draw`, but for the cameras' calibration errors.
        shift: Camera name -> (2,) by how much the errors' turn moves its images to the right and down, of the height.
    """

    frames: NDArray[np.int64]
    cells: Mapping[tuple[str, ImageKind], Cells]
    shift: Mapping[str, Array]


def drawable_world(info: EpisodeInfo, columns: Columns) -> RecordedWorld:
    """An episode as its recorded numbers make it, its cameras as in `drawable_scene`.

    Raises:
        SceneError: A model is not there.
    """
    joints, objects = columns.joint_position, columns.object_poses
    return RecordedWorld(info.robot, drawable_scene(info), joint_position=joints, object_poses=objects)


def draw_episode(
    info: EpisodeInfo,
    world: RecordedWorld,
    kinds: Mapping[str, Iterable[ImageKind]],
    colors: Mapping[str, Cells] | None = None,
    *,
    draw_each: bool = True,
) -> DrawnEpisode:
    """The images of an episode, as the recorded numbers make them.

    Args:
        info: Of the recording.
        world: Its `drawable_world`.
        kinds: Camera name -> what is to be drawn of it.
        colors: Camera name -> its recorded colour images, by which turns are found and frames chosen.
        draw_each: Whether every frame is drawn, also those that can be told from their neighbours.

    Raises:
        SceneError, RenderError: A model is not there, or cannot be drawn.
    """
    # The recorded images' grid: the small ones' own may have a row more or less.
    counts = {camera.name: cell_counts(camera.width, camera.height) for camera in info.scene.cameras}
    turns = {} if colors is None else _turns(info, world, counts, colors)
    cameras = tuple(_turned_back(camera, turns.get(camera.name)) for camera in world.scene.cameras)
    if draw_each or colors is None:
        frames: NDArray[np.int64] = np.arange(len(world.all_poses))
    else:
        frames = frames_to_draw(colors.values(), world.all_poses)
    return DrawnEpisode(
        frames=frames,
        cells=draw(world, cameras, frames, kinds, counts),
        shift={
            camera.name: np.array([turns[camera.name][1], -turns[camera.name][0]]) / _height(camera)
            for camera in cameras
            if camera.name in turns
        },
    )


def draw_full_size(
    world: RecordedWorld,
    kinds: Mapping[str, Iterable[ImageKind]],
    frames: Mapping[str, NDArray[np.int64]],
) -> dict[tuple[str, ImageKind], dict[int, NDArray[Any]]]:
    """(camera, kind) -> frame -> its image before it was encoded, of some frames of each camera of a `drawable_world`.

    Raises:
        SceneError, RenderError: A model cannot be drawn.
    """
    wanted = {kind for of_camera in kinds.values() for kind in of_camera}
    found: dict[tuple[str, ImageKind], dict[int, NDArray[Any]]] = {
        (name, kind): {} for name in kinds for kind in kinds[name]
    }
    painter = Painter(warm_renderer(), world.scene.cameras, depth="depth" in wanted, segmentation="labels" in wanted)
    painter.setup(world)
    for world.frame in sorted({int(frame) for of_camera in frames.values() for frame in of_camera}):
        for name, image in painter.images().items():
            for kind in kinds[name] if world.frame in frames[name] else ():
                drawn = {"color": image.color, "depth": image.depth, "labels": image.segmentation}[kind]
                assert drawn is not None
                found[name, kind][world.frame] = drawn.copy()
    return found


def drawable_scene(info: EpisodeInfo) -> Scene:
    """The recorded scene, its cameras without their calibration error; in older recordings without its offset.

    One shift of all images makes up for most of a turn, but not for an offset: what is near moves farther by it than
    what is far.
    """
    return replace(info.scene, cameras=tuple(_moved_back(camera, info.behaviour) for camera in info.scene.cameras))


def _moved_back(camera: SceneCamera, behaviour: Mapping[str, float]) -> SceneCamera:
    error = stated_error(camera.name, behaviour)
    if error is not None:
        return true_camera(camera, error)
    offset = np.array([behaviour.get(f"calibration_{camera.name}_{axis}", 0.0) for axis in "xyz"])
    if not offset.any():
        return camera
    # recorded = true @ error: so but for the error's turn, which is small, true = recorded @ Pose(-offset).
    return replace(camera, mount_from_camera=camera.mount_from_camera @ Pose(position=-offset))


def _turned_back(camera: SceneCamera, turn: Array | None) -> SceneCamera:
    """The camera before it was turned by a small rotation vector, rad in its own axes."""
    if turn is None:
        return camera
    quat = np.array([*(-turn / 2), 1.0])
    return replace(camera, mount_from_camera=camera.mount_from_camera @ Pose(quat_xyzw=quat / np.linalg.norm(quat)))


def _turns(
    info: EpisodeInfo, world: RecordedWorld, counts: Mapping[str, tuple[int, int]], colors: Mapping[str, Cells]
) -> dict[str, Array]:
    """Camera name -> (3,) rotation vector of its calibration error, rad in its own axes, where images show one."""
    stated = {
        camera.name: info.behaviour.get(f"calibration_{camera.name}_angle", 0.0)
        for camera in world.scene.cameras
        if stated_error(camera.name, info.behaviour) is None
    }
    cameras = [camera for camera in world.scene.cameras if stated.get(camera.name) and len(colors[camera.name])]
    if not cameras:
        return {}
    count = min(len(colors[camera.name]) for camera in cameras)
    frames = np.unique(np.linspace(0, count - 1, _NUM_FITTED).round().astype(np.int64))
    turns: dict[str, Array] = {camera.name: np.zeros(3) for camera in cameras}
    for _ in range(_NUM_STEPS):
        now = [_turned_back(camera, turns[camera.name]) for camera in cameras]
        drawn = draw(world, now, frames, dict.fromkeys(turns, ("color",)), counts)
        for camera in cameras:
            right, down, _, about = fit(colors[camera.name][:count], drawn[camera.name, "color"], frames)
            # What is seen in the direction (x, y, 1) moves by the turn's cross product with it.
            size = cell_side(camera.width, camera.height, counts[camera.name]) / camera.height * _height(camera)
            turns[camera.name] = turns[camera.name] + np.array([-size * down, size * right, about])
    return {name: turn for name, turn in turns.items() if np.linalg.norm(turn) <= _TURN_MARGIN * stated[name]}


def _height(camera: SceneCamera) -> float:
    """Of the image, at a distance of 1."""
    return float(2 * np.tan(camera.fov_y / 2))
