"""Recorded states put back into a simulated world, so that renderers draw them as they drew the simulation."""

from __future__ import annotations

from collections.abc import Mapping

from demorec.core.geometry import Array, Pose
from demorec.episode.episode import Trajectory
from demorec.episode.scene import Scene
from demorec.render import Mount, VisualBody, first_rows
from demorec.sim.world import World


class RecordedStates:
    """A world at recorded states, one at a time, without physics; for `demorec.render.painter.Painter`.

    Args:
        world: World of the recording's robot; is reset.
        scene: The recorded scene, or the same with other cameras and appearance.
        trajectory: The recorded states.

    Attributes:
        scene: As given.
        frame: Index of the state that is shown, 0 to T - 1.

    Raises:
        SceneError: A model file is missing or broken.
    """

    def __init__(self, world: World, scene: Scene, trajectory: Trajectory) -> None:
        self.scene = scene
        self.frame = 0
        self._world, self._trajectory = world, trajectory
        world.reset(scene)
        self._visuals = world.visuals()
        rows = first_rows(self._visuals)[len(self._visuals) - len(scene.movable) :]
        self._row = {body.name: row for body, row in zip(scene.movable, rows, strict=True)}

    def visuals(self) -> tuple[VisualBody, ...]:
        """Return the visible bodies."""
        return self._visuals

    def mounts(self) -> Mapping[str, Mount]:
        """Return the links that can carry cameras, by name."""
        return self._world.mounts()

    def poses(self) -> Array:
        """Return the (n, 7) poses of all bodies and links at the present frame, as `Renderer.render` takes them."""
        recorded = {name: poses[self.frame] for name, poses in self._trajectory.object_poses.items()}
        self._world.set_state(
            joint_position=self._trajectory.joint_position[self.frame],
            object_poses={name: Pose(position=vector[:3], quat_xyzw=vector[3:]) for name, vector in recorded.items()},
        )
        poses = self._world.poses()
        for name, vector in recorded.items():
            if self._world.inertial_poses[name] == Pose():
                poses[self._row[name]] = vector  # PyBullet has rounded the quaternion once more
        return poses
