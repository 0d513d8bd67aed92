"""What a task is."""

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
    """Something to be demonstrated: a random layout, words, a script and strict conditions of success.

    A task holds no state of an episode: `sample_scene` puts everything into the scene, and the other methods read
    it from there, so that one instance serves many episodes.
    """

    summary: ClassVar[str]
    """One line for `demorec list tasks`."""
    has_fixed_layout: ClassVar[bool] = False
    """Whether `--fixed` gives one exact layout instead of a random one."""
    shelves: ClassVar[tuple[str, ...]] = ()
    """Rows of `OBJECTS` that it draws from unless --objects names others; empty: it has its own things."""
    draws_distractors: ClassVar[bool] = False
    """Whether `sample_scene` itself puts as many distractors among its things as the ranges say."""
    camera_presets: ClassVar[Mapping[str, CameraPreset]] = {}
    """Camera name -> preset in place of the table's, for a scene that the usual view misses."""

    @classmethod
    def refusal(cls, robot: RobotSpec) -> str:
        """Why no arm like this one can do it, in words; "": it may."""
        del robot
        return ""

    @abstractmethod
    def sample_scene(self, robot: RobotSpec, sampler: Sampler) -> Scene:
        """Draw a layout; no cameras. SceneError when none is found."""

    def is_in_reach(self, scene: Scene, robot: RobotSpec, behaviour: Behaviour) -> bool:
        """Whether the arm can do it in this layout; another one is drawn where it cannot.

        Args:
            scene: As it is at the start.
            robot: At the scene's scale.
            behaviour: How the expert does it.
        """
        del scene, robot, behaviour
        return True

    @abstractmethod
    def instruction(self, scene: Scene, rng: np.random.Generator) -> str:
        """What to do, in words."""

    @abstractmethod
    def script(self, expert: Expert) -> Iterator[Step]:
        """Do it, one control step at a time: the world has advanced when the generator resumes."""

    def resume(self, expert: Expert) -> Iterator[Step]:
        """Do what is left of it from whatever state the world is in; `expert` is made for that state.

        This one lets go of everything and follows the script from its beginning, unless the scene's goals are served
        already. Tasks whose goals are the whole aim go on where they are (`demorec.tasks.recovery.finish`).
        """
        yield from begin_again(expert)
        goals = expert.world.scene.goals
        if not goals or not all(is_served(expert.world, goal) for goal in goals):
            yield from self.script(expert)

    @abstractmethod
    def evaluate(self, world: World) -> tuple[SuccessCheck, ...]:
        """The conditions of success, with the values found now."""
