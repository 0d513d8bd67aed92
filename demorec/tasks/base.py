"""What a task is, and what the expert is told about an episode."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from demorec.render.cameras import CameraPreset
from demorec.scene.episode import Action, Event, SuccessCheck
from demorec.scene.robot import RobotSpec
from demorec.scene.scene import Scene
from demorec.sim.world import World
from demorec.tasks.sampling import Sampler

if TYPE_CHECKING:
    from demorec.tasks.skills import Expert


@dataclass(frozen=True, kw_only=True)
class Behaviour:
    """How the expert does it in one episode; recorded as `EpisodeInfo.behaviour`.

    Attributes:
        speed: Factor on the speeds of all motions; touching down with an object is never faster than at 1.
        approach_height, lift_height: Above the grasp, metres.
        grasp_offset: Shift of the grasp along the fingers' faces, metres.
        action_noise: Standard deviation of the exploration noise on the executed joint targets, rad.
        miss_x, miss_y: Deliberate error of the first grasp in the hand's frame, metres, x along the fingers' faces; 0
            for none. What is done may be farther, to the other side or left out, so that nothing is touched.
        perception_x, perception_y: Error of every perceived object position, metres.
        perception_yaw: Error of every perceived object yaw, rad.
    """

    speed: float = 1.0
    approach_height: float = 0.12
    lift_height: float = 0.15
    grasp_offset: float = 0.0
    action_noise: float = 0.02
    miss_x: float = 0.0
    miss_y: float = 0.0
    perception_x: float = 0.0
    perception_y: float = 0.0
    perception_yaw: float = 0.0

    @property
    def misses(self) -> bool:
        """Whether the first grasp is missed on purpose."""
        return self.miss_x != 0.0 or self.miss_y != 0.0

    def as_mapping(self) -> dict[str, float]:
        """name -> value."""
        return {name: float(value) for name, value in asdict(self).items()}


@dataclass(frozen=True, kw_only=True)
class Step:
    """One control step of a script.

    Attributes:
        action: What the expert wants.
        phase: "approach", "lift", ...
        noise_allowed: Whether exploration noise does no harm now (free motion, away from objects).
        events: What happened since the step before.
        is_deliberate_miss: Whether this belongs to a deliberate miss.
    """

    action: Action
    phase: str
    noise_allowed: bool = False
    events: tuple[Event, ...] = ()
    is_deliberate_miss: bool = False


class Task(ABC):
    """Something to be demonstrated: a random layout, words, a script and strict conditions of success.

    A task holds no state of an episode: `sample_scene` puts everything into the scene, and the other methods read
    it from there, so that one instance serves many episodes.
    """

    summary: ClassVar[str]
    """One line for `demorec list tasks`."""
    has_fixed_layout: ClassVar[bool] = False
    """Whether `--fixed` gives one exact layout instead of a random one."""
    camera_presets: ClassVar[Mapping[str, CameraPreset]] = {}
    """Camera name -> preset in place of the table's, for a scene that the usual view misses."""

    @abstractmethod
    def sample_scene(self, robot: RobotSpec, sampler: Sampler) -> Scene:
        """Draw a layout; no cameras. SceneError when none is found."""

    @abstractmethod
    def instruction(self, scene: Scene, rng: np.random.Generator) -> str:
        """What to do, in words."""

    @abstractmethod
    def script(self, expert: Expert) -> Iterator[Step]:
        """Do it, one control step at a time: the world has advanced when the generator resumes."""

    @abstractmethod
    def evaluate(self, world: World) -> tuple[SuccessCheck, ...]:
        """The conditions of success, with the values found now."""
