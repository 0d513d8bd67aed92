"""Preparation of an `EpisodePlan`: scene, instruction and behaviour, and the world and renderer to run it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from demorec.core.config import EpisodePlan, GenerateConfig, cpu_type, deciding_versions
from demorec.core.errors import ConfigError
from demorec.core.files import Closing
from demorec.core.geometry import Pose
from demorec.core.plain import digest, to_plain
from demorec.core.registry import is_foreign, modules_of
from demorec.core.seeding import Purpose, generator
from demorec.core.tables import CAMERAS, TASKS, camera_name, load_robot
from demorec.episode.info import EpisodeInfo, Simulation
from demorec.episode.scene import Scene, SceneCamera
from demorec.episode.simulated import simulated_cameras, simulated_features
from demorec.episode.variation import Ranges, error_values, resolve, true_cameras
from demorec.objects.folder import load_shelf
from demorec.render import Renderer
from demorec.render.painter import WarmRenderer
from demorec.robots.assets import allow_models, model_name
from demorec.robots.robot import RobotSpec
from demorec.sim.sensors import SENSORS
from demorec.sim.world import World
from demorec.tasks.base import Task
from demorec.tasks.sampling import Sampler, stratified_point
from demorec.tasks.script import Behaviour
from demorec.tasks.vary import calibration_errors, draw_behaviour, moved_camera, vary_cameras, vary_looks, vary_physics

EVAL_SEED_OFFSET = 2**63
MAX_LAYOUTS = 10
"""Maximum number of layouts drawn until the arm reaches everything that the task requires."""


@dataclass(frozen=True, kw_only=True)
class PreparedEpisode:
    """One attempt at one episode, ready to run.

    Attributes:
        plan: Plan of the attempt.
        info: Recorded description of the episode.
        task: The task.
        behaviour: Variation in how the expert does it.
        cameras: True camera poses; `info.simulated.scene.cameras` has them with the calibration error.
        true_from_recorded: Camera name -> calibration error; only cameras that have one.
    """

    plan: EpisodePlan
    info: EpisodeInfo
    task: Task
    behaviour: Behaviour
    cameras: tuple[SceneCamera, ...] = ()
    true_from_recorded: Mapping[str, Pose] = field(default_factory=dict)

    def rng(self, purpose: Purpose) -> np.random.Generator:
        """Start a fresh random stream of this attempt."""
        return _rng(self.plan, purpose)


def _root_seed(config: GenerateConfig) -> int:
    """Offset the seeds of the eval split beyond all valid user seeds, so that no training episode shares one."""
    return config.seed + (EVAL_SEED_OFFSET if config.split == "eval" else 0)


def _rng(plan: EpisodePlan, purpose: Purpose) -> np.random.Generator:
    return generator(
        root_seed=_root_seed(plan.config), episode_index=plan.episode_index, attempt=plan.attempt, purpose=purpose
    )


def load_task(config: GenerateConfig) -> type[Task]:
    """Load the task that a config names.

    Raises:
        ConfigError: The name is unknown, it cannot be imported, the task lacks a requested feature, or the robot cannot
            do it.
    """
    task: type[Task] = TASKS.load(config.task, config.modules)
    if config.fixed and not task.has_fixed_layout:
        raise ConfigError(f"--fixed was given, but the task {config.task!r} has no fixed layout: leave it out.")
    if (config.objects or config.object_split != "all") and not task.shelves:
        flag = "--objects" if config.objects else "--object-split"
        raise ConfigError(f"{flag} was given, but the task {config.task!r} defines its own objects: leave it out.")
    if why := task.refusal(load_robot(config.robot, config.modules)):
        raise ConfigError(f"The robot {config.robot!r} cannot do the task {config.task!r}: {why}; choose another.")
    return task


def prepare(plan: EpisodePlan) -> PreparedEpisode:
    """Draw an episode's scene, instruction and behaviour; a pure function of the plan, without a simulator.

    Imports the user modules that the plan's config names: a config read from a file must have passed
    `GenerateConfig.check_names` first.

    Raises:
        ConfigError: As `load_task`.
        SceneError: No layout was found within the task's ranges.
    """
    config = plan.config
    allow_models(config.modules)
    robot = load_robot(config.robot, config.modules)
    task = load_task(config)()
    ranges = resolve(config.variation, config.ranges)
    behaviour = draw_behaviour(ranges, _rng(plan, "behaviour"))
    scene = vary_looks(_layout(plan, robot, ranges, task, behaviour), ranges, _rng(plan, "looks"))
    robot = robot.scaled(scene.robot.scale)
    camera_rng = _rng(plan, "cameras")
    cameras = vary_cameras(tuple(_cameras(task, robot, config)), ranges, camera_rng)
    errors = calibration_errors(cameras, ranges, camera_rng)
    scene = replace(scene, cameras=tuple(moved_camera(camera, errors[camera.name]) for camera in cameras))
    drawn = behaviour.as_mapping() | error_values(errors)
    cameras, errors = true_cameras(scene.cameras, drawn)
    simulation = Simulation(
        root_seed=config.seed,
        task=config.task,
        robot=robot,
        scene=scene,
        physics_hz=config.physics_hz,
        cpu=cpu_type(),
        behaviour=drawn,
        config=to_plain(config),
        config_digest=digest(config),
    )
    info = EpisodeInfo(
        episode_index=plan.episode_index,
        attempt=plan.attempt,
        instruction=task.instruction(scene, _rng(plan, "expert")),
        robot_name=robot.name,
        fps=config.fps,
        features=simulated_features(simulation, [sensor.feature(robot) for sensor in SENSORS]),
        cameras=simulated_cameras(scene),
        versions=deciding_versions(config),
        simulation=simulation,
    )
    return PreparedEpisode(
        plan=plan,
        info=info,
        task=task,
        behaviour=behaviour,
        cameras=cameras,
        true_from_recorded=errors,
    )


def _layout(plan: EpisodePlan, robot: RobotSpec, ranges: Ranges, task: Task, behaviour: Behaviour) -> Scene:
    """Draw layouts, with physics, until the arm can serve one; else return the last, where the expert fails."""
    config, sampler = plan.config, _sampler(plan, ranges, task)
    for _ in range(MAX_LAYOUTS):
        scene = task.sample_scene(robot, sampler)
        if not isinstance(scene, Scene):
            raise ConfigError(
                f"sample_scene of the task {config.task!r} returned {type(scene).__name__}; return a Scene at its end."
            )
        for module in filter(is_foreign, modules_of([TASKS.target(config.task)])):
            scene = _with_model_names(scene, module)
        scene = replace(scene, physics=replace(scene.physics, hz=config.physics_hz))
        scene = vary_physics(scene, ranges, _rng(plan, "physics"), distractors=not task.draws_distractors)
        if task.is_in_reach(scene, robot.scaled(scene.robot.scale), behaviour):
            break
        sampler = replace(sampler, unit_point=())
    return scene


def _cameras(task: Task, robot: RobotSpec, config: GenerateConfig) -> Iterator[SceneCamera]:
    """Yield the cameras that the config names, the task's own before the shared ones."""
    for name in config.cameras:
        preset = task.camera_presets.get(name) or CAMERAS.load(name, config.modules)
        yield preset.camera(camera_name(name), robot, width=config.width, height=config.height)


def _with_model_names(scene: Scene, module: str) -> Scene:
    """Rename the models in the scene of a user's task to the names that recordings use."""
    shapes = [
        replace(body.shape, file=model_name(body.shape.file, module)) if body.shape.file else body.shape
        for body in scene.bodies
    ]
    return replace(scene, bodies=tuple(replace(b, shape=s) for b, s in zip(scene.bodies, shapes, strict=True)))


def _sampler(plan: EpisodePlan, ranges: Ranges, task: Task) -> Sampler:
    config = plan.config
    # A later attempt with the same method would fail at the same point again.
    method = config.sampling if plan.attempt == 0 else "random"
    point = stratified_point(
        method, root_seed=_root_seed(config), episode_index=plan.episode_index, block=config.sampling_block
    )
    return Sampler(
        _rng(plan, "scene"),
        unit_point=point,
        ranges=ranges,
        split=config.split,
        fixed=config.fixed,
        shelves=[load_shelf(name, config.modules) for name in config.objects or task.shelves],
        object_split=config.object_split,
    )


def make_world(info: EpisodeInfo) -> World:
    """Create an empty world for episodes like this one (same robot, rates and joint sampling)."""
    return World(info.simulated.robot, fps=info.fps, sample_joints=info.simulated.config.get("joint_rate") == "physics")


class SimulatorCache(Closing):
    """World and renderer reused across episodes, remade only for one that needs different ones; a context manager."""

    def __init__(self) -> None:
        self._world: World | None = None
        self._renderers = WarmRenderer()
        self._key: object = None

    def acquire(self, info: EpisodeInfo) -> tuple[World, Renderer | None]:
        """Return a world and a renderer (None without cameras) for this kind of episode, reusing the current ones.

        Raises:
            ConfigError: Unknown renderer.
            MissingDependencyError, RenderError: It does not work on this machine.
        """
        key = (info.simulated.robot, info.fps, info.simulated.config.get("joint_rate"))
        if self._world is None or key != self._key:
            self.close()
            self._world, self._key = make_world(info), key
        name = str(info.simulated.config.get("renderer", "raster"))
        renderer = self._renderers.of(name) if info.simulated.scene.cameras else None
        return self._world, renderer

    def close(self) -> None:
        """Free both; safe to call twice."""
        self._renderers.close()
        if self._world is not None:
            self._world.close()
        self._world = self._key = None
