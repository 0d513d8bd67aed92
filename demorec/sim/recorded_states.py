"""Recorded states posed by the simulator, so that renderers draw them exactly as during the simulation."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from demorec.core.geometry import Array, Pose
from demorec.episode.episode import Trajectory
from demorec.episode.scene import Scene
from demorec.render import Mount, VisualBody, first_rows
from demorec.robots.robot import RobotSpec
from demorec.sim.world import World


class RecordedStates:
    """Recorded states of a scene, one at a time, for `demorec.render.painter.Painter`.

    The simulator poses all states at once and is freed before the first image is drawn, since it takes 50 MB.

    Args:
        robot: The recorded robot.
        scene: The recorded scene, or the same with other cameras and appearance.
        trajectory: The recorded states.

    Attributes:
        scene: The scene argument.
        frame: Index of the current state, 0 to T - 1.

    Raises:
        SceneError: A model file is missing or broken.
    """

    def __init__(self, robot: RobotSpec, scene: Scene, trajectory: Trajectory) -> None:
        self.scene = scene
        self.frame = 0
        with World(robot, fps=scene.physics.hz) as world:
            world.reset(scene)
            self._visuals = world.visuals()
            self._mounts = world.mounts()
            rows = first_rows(self._visuals)[len(self._visuals) - len(scene.movable) :]
            row_of = {body.name: row for body, row in zip(scene.movable, rows, strict=True)}
            self._poses = np.stack([_posed(world, row_of, trajectory, frame) for frame in range(trajectory.num_frames)])

    def visuals(self) -> tuple[VisualBody, ...]:
        """Return the visible bodies."""
        return self._visuals

    def mounts(self) -> Mapping[str, Mount]:
        """Return the links that can carry cameras, by name."""
        return self._mounts

    def poses(self) -> Array:
        """Return the (n, 7) poses of all bodies and links at the present frame, as `Renderer.render` takes them."""
        return np.asarray(self._poses[self.frame])


def _posed(world: World, row_of: Mapping[str, int], trajectory: Trajectory, frame: int) -> Array:
    """Put a recorded state into a world and return the poses of all bodies and links."""
    recorded = {name: poses[frame] for name, poses in trajectory.object_poses.items()}
    world.set_state(
        joint_position=trajectory.joint_position[frame],
        object_poses={name: Pose(position=vector[:3], quat_xyzw=vector[3:]) for name, vector in recorded.items()},
    )
    poses = world.poses()
    for name, vector in recorded.items():
        if world.inertial_poses[name] == Pose():
            poses[row_of[name]] = vector  # PyBullet has rounded the quaternion once more
    return poses
