"""Interface of tasks."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from typing import ClassVar

import numpy as np

from demorec.episode.episode import SuccessCheck
from demorec.episode.scene import Scene
from demorec.render.cameras import CameraPreset
from demorec.robots.robot import RobotSpec
from demorec.sim.world import World
from demorec.tasks.recovery import begin_again, is_served
from demorec.tasks.sampling import Sampler
from demorec.tasks.script import Behaviour, Step
from demorec.tasks.skills import Expert


class Task(ABC):
    """A task to demonstrate: a random layout, an instruction, a script and strict success conditions.

    A task is stateless: `sample_scene` puts everything into the scene, and the other methods read it from there, so
    that one instance serves many episodes.
    """

    summary: ClassVar[str]
    """One line for `demorec list tasks`."""
    has_fixed_layout: ClassVar[bool] = False
    """Whether `--fixed` selects one exact layout instead of a random one."""
    shelves: ClassVar[tuple[str, ...]] = ()
    """Rows of `OBJECTS` that it draws from unless --objects names others; empty if it has its own objects."""
    draws_distractors: ClassVar[bool] = False
    """Whether `sample_scene` itself adds the number of distractors given by the ranges."""
    camera_presets: ClassVar[Mapping[str, CameraPreset]] = {}
    """Camera name -> preset that replaces the table's, for scenes outside the usual view."""

    @classmethod
    def refusal(cls, robot: RobotSpec) -> str:
        """Return why a robot cannot do the task, in words; "" if it may."""
        del robot
        return ""

    @abstractmethod
    def sample_scene(self, robot: RobotSpec, sampler: Sampler) -> Scene:
        """Draw a layout without cameras. SceneError if none is found."""

    def is_in_reach(self, scene: Scene, robot: RobotSpec, behaviour: Behaviour) -> bool:
        """Check whether the arm can do the task in this layout; if not, another one is drawn.

        Args:
            scene: Scene at the start.
            robot: Robot at the scene's scale.
            behaviour: Variation in how the expert does it.
        """
        del scene, robot, behaviour
        return True

    @abstractmethod
    def instruction(self, scene: Scene, rng: np.random.Generator) -> str:
        """Return the instruction, in words."""

    @abstractmethod
    def script(self, expert: Expert) -> Iterator[Step]:
        """Yield the control steps of the task; the world has advanced when the generator resumes."""

    def resume(self, expert: Expert) -> Iterator[Step]:
        """Yield the remaining control steps from any state of the world; `expert` is made for that state.

        The default releases everything and runs the script from its beginning, unless the scene's goals are met
        already. Tasks that consist of their goals continue from the current state (`demorec.tasks.recovery.finish`).
        """
        yield from begin_again(expert)
        goals = expert.world.scene.goals
        if not goals or not all(is_served(expert.world, goal) for goal in goals):
            yield from self.script(expert)

    @abstractmethod
    def evaluate(self, world: World) -> tuple[SuccessCheck, ...]:
        """Evaluate the success conditions now."""
