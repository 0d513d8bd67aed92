"""The pictures of a dataset against its states: the beginning of each episode, drawn anew from its rows.

A dataset tells where the robot is, and its sidecar where the objects stood before the first frame. Until the fingers
close nothing but the robot moves, so that everything before the cameras is known.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from demorec.check.base import NotMeasured
from demorec.check.cells import Cells
from demorec.check.drawn import NOT_DRAWABLE, PictureComparison, compare, draw, frames_to_draw
from demorec.check.episode_drawn import drawable_scene
from demorec.geometry import Array
from demorec.render.recorded import RecordedWorld
from demorec.scene.episode import EpisodeInfo

SECONDS = 3.0
"""Of an episode that are drawn, at most."""
CLOSING = 1e-3
"""Metres that the opening shrinks by from frame to frame when the fingers begin to close."""
MIN_FRAMES = 3


def compare_beginning(
    info: EpisodeInfo, state: Array, fps: int, seen: Mapping[str, Cells]
) -> Mapping[str, PictureComparison] | NotMeasured:
    """Camera -> its pictures until the fingers first close against what states and scene make of them.

    Args:
        info: Of the episode, from the sidecar.
        state: (T, n_arm + 1) joint positions (rad) and opening (m) of each row.
        fps: Rows a second.
        seen: Camera -> its pictures in cells.
    """
    if (renderer := info.config.get("renderer", "raster")) != "raster":
        return NotMeasured(why=f"colours of the renderer {renderer!r} are others than those that are drawn here")
    if not seen:
        return {}
    num_arm = len(info.robot.arm_joints)
    opening = state[:, num_arm]
    closing = np.flatnonzero(np.diff(opening) < -CLOSING)
    count = min([len(state), round(SECONDS * fps), *(closing[:1] + 1).tolist()])
    if count < MIN_FRAMES:
        return NotMeasured(why="the fingers close at once")
    joints = np.concatenate([state[:count, :num_arm], info.robot.gripper.joint_position(opening[:count])], axis=1)
    objects = {body.name: np.tile(body.world_from_body.vector(), (count, 1)) for body in info.scene.movable}
    try:
        scene = drawable_scene(info)
        world = RecordedWorld(info.robot, scene, joint_position=joints, object_poses=objects)
        grids = {name: (cells.shape[2], cells.shape[1]) for name, cells in seen.items()}
        beginning = {name: cells[:count] for name, cells in seen.items()}
        frames = frames_to_draw(beginning.values(), world.all_poses[:count])
        drawn = draw(world, scene.cameras, frames, dict.fromkeys(seen, ("color",)), grids)
    except NOT_DRAWABLE as error:
        return NotMeasured(why=f"the scene cannot be drawn here: {error}")
    return {name: compare(cells, drawn.cells[name, "color"], drawn.frames) for name, cells in beginning.items()}
