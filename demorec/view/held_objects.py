"""The way of objects in a dataset that does not carry it: what the hand holds moves with the hand.

Known are every object's pose at the start and at the end, the gripper's pose and opening, and what was asked of it.
So an object stands at its start until fingers that are told to close stop around it, then moves with the hand, and when
it is let go for the last time it is at its end. A push, a fall or a slip between the fingers is not in the data.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from demorec.core.geometry import Array, Pose
from demorec.episode.scene import Scene

_STOPPED_BEFORE_TARGET = 1e-3
"""How much wider than asked the opening is at least when something is between the fingers, metres."""
_STANDS_STILL = 0.015
"""Speed of the opening below which closing fingers have met something, m/s."""
_SNAPS_SHUT = 0.06
"""Speed of the opening above which they have lost it, m/s; between the two it gives way."""
_WITHIN_REACH = 0.02
"""How far from the TCP the surface of what is held may be, metres."""


def held(opening: Array, target: Array, fps: int) -> NDArray[np.bool_]:
    """(T,) whether something is between the fingers.

    Args:
        opening: (T,) measured, metres.
        target: (T,) what was asked for, metres.
        fps: Frames per second.
    """
    speed = fps * np.abs(np.diff(opening, prepend=opening[:1]))
    result = np.zeros(len(opening), dtype=np.bool_)
    is_held = False
    for frame, is_stopped in enumerate(opening > target + _STOPPED_BEFORE_TARGET):
        is_held = bool(is_stopped and speed[frame] < (_SNAPS_SHUT if is_held else _STANDS_STILL))
        result[frame] = is_held
    return result


def held_object_poses(
    scene: Scene, end_poses: Mapping[str, Array], base_from_tcp: Array, opening: Array, target: Array, fps: int
) -> dict[str, Array]:
    """Name -> (T, 7) world_from_object of every object with a known end.

    Args:
        scene: At the start.
        end_poses: Name -> (7,) world_from_object at the end.
        base_from_tcp: (T, 7).
        opening: (T,) of the gripper, metres.
        target: (T,) opening that was asked for, metres.
        fps: Frames per second.
    """
    world_from_base = scene.robot.world_from_base
    world_from_tcp = [world_from_base @ Pose(position=row[:3], quat_xyzw=row[3:]) for row in base_from_tcp]
    present = {name: scene.body(name).world_from_body for name in end_poses}
    poses: dict[str, Array] = {name: np.empty((len(base_from_tcp), 7)) for name in end_poses}
    let_go: dict[str, int] = {}
    name, tcp_from_object = "", Pose()
    for frame, (is_held, tcp) in enumerate(zip(held(opening, target, fps), world_from_tcp, strict=True)):
        if is_held and not name:
            name = _within_reach(scene, present, tcp)
            if name:
                tcp_from_object = tcp.inverse() @ present[name]
        elif not is_held and name:
            let_go[name], name = frame, ""
        if name:
            present[name] = tcp @ tcp_from_object
        for other, pose in present.items():
            poses[other][frame] = pose.vector()
    for other, frame in let_go.items():
        poses[other][frame:] = end_poses[other]
    return poses


def _within_reach(scene: Scene, present: Mapping[str, Pose], world_from_tcp: Pose) -> str:
    """The object nearest to the TCP, "" when none is between the fingers."""

    def distance(name: str) -> float:
        centre = np.linalg.norm(present[name].position - world_from_tcp.position)
        return float(centre) - max(scene.body(name).shape.extents) / 2

    nearest = min(present, key=distance, default="")
    return nearest if nearest and distance(nearest) < _WITHIN_REACH else ""
