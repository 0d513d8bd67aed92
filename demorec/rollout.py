"""An `EpisodePlan` becomes an episode: scene and words first, then frames, then how it ended.

    episode = prepare(EpisodePlan(config=GenerateConfig(), episode_index=0))  # info, task, behaviour; no simulator
    with make_world(episode.info) as world, make_renderer(episode.info) as renderer:  # both reusable
        run = Rollout(world, episode, renderer)  # renderer=None for no pictures
        for frame in run:  # world.reset happens here, then one control step a frame
            print(frame.frame_index, frame.phase, frame.observation.gripper_width)
        print(run.outcome)

An episode is a pure function of its plan: whatever ran before in the same world, on any worker, the bits are equal.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace

import numpy as np

from demorec.assets import allow_models, model_name
from demorec.config import EpisodePlan, GenerateConfig, deciding_versions
from demorec.episode import Action, EpisodeInfo, Frame, Outcome, frame_time_ns
from demorec.errors import ConfigError
from demorec.features import NOISE_LETS_GO
from demorec.geometry import Array, Pose
from demorec.motion import angle_between
from demorec.plain import digest, to_plain
from demorec.render import Renderer
from demorec.render.painter import Painter
from demorec.scene import Camera, Scene
from demorec.seeding import Purpose, generator
from demorec.sim.world import World
from demorec.tables import CAMERAS, RENDERERS, TASKS, camera_name, load_robot
from demorec.tasks.base import Behaviour, Step, Task
from demorec.tasks.sampling import Sampler, stratified_point
from demorec.tasks.skills import Expert, GaveUp
from demorec.tasks.vary import calibration_errors, draw_behaviour, vary_cameras, vary_looks, vary_physics
from demorec.user_modules import modules_of
from demorec.variation import Ranges, resolve

EVAL_SEED_OFFSET = 2**63


@dataclass(frozen=True, kw_only=True)
class Episode:
    """One attempt at one episode, ready to run.

    Attributes:
        plan: What it was made from.
        info: What is recorded about it.
        task: The task.
        behaviour: How the expert does it.
        cameras: Where the cameras really are: `info.scene.cameras` holds the same with the calibration error.
        true_from_recorded: Camera name -> calibration error, of the cameras that have one.
    """

    plan: EpisodePlan
    info: EpisodeInfo
    task: Task
    behaviour: Behaviour
    cameras: tuple[Camera, ...] = ()
    true_from_recorded: Mapping[str, Pose] = field(default_factory=dict)

    def rng(self, purpose: Purpose) -> np.random.Generator:
        """A fresh stream of this attempt."""
        return _rng(self.plan, purpose)


def _root_seed(config: GenerateConfig) -> int:
    """Seeds of the eval split lie beyond all that a user can give, so that no training episode shares one."""
    return config.seed + (EVAL_SEED_OFFSET if config.split == "eval" else 0)


def _rng(plan: EpisodePlan, purpose: Purpose) -> np.random.Generator:
    return generator(
        root_seed=_root_seed(plan.config), episode_index=plan.episode_index, attempt=plan.attempt, purpose=purpose
    )


def load_task(config: GenerateConfig) -> type[Task]:
    """The task that a config names.

    Raises:
        ConfigError: There is none of that name, it cannot be imported, or the config asks for what it does not have.
    """
    task: type[Task] = TASKS.load(config.task, config.modules)
    if config.fixed and not task.has_fixed_layout:
        raise ConfigError(f"--fixed was given, but the task {config.task!r} has no fixed layout: leave it out.")
    return task


def prepare(plan: EpisodePlan) -> Episode:
    """Draw an episode's scene, words and behaviour; a pure function of the plan, without a simulator.

    Imports the user's own modules that the plan's config names: one that was read from a file must have passed
    `GenerateConfig.check_names` before.

    Raises:
        ConfigError: As `load_task`.
        SceneError: No layout was found within the task's ranges.
    """
    config = plan.config
    allow_models(config.modules)
    robot = load_robot(config.robot, config.modules)
    task = load_task(config)()
    ranges = resolve(config.variation, config.ranges)
    scene = task.sample_scene(robot, _sampler(plan, ranges))
    for module in modules_of([config.task]):
        scene = _with_model_names(scene, module)
    robot = robot.scaled(scene.robot.scale)
    scene = replace(scene, physics=replace(scene.physics, hz=config.physics_hz))
    scene = vary_looks(vary_physics(scene, ranges, _rng(plan, "physics")), ranges, _rng(plan, "looks"))
    behaviour = draw_behaviour(ranges, _rng(plan, "behaviour"))
    presets = [
        (camera_name(name), task.camera_presets.get(name) or CAMERAS.load(name, config.modules))
        for name in config.cameras
    ]
    camera_rng = _rng(plan, "cameras")
    cameras = vary_cameras(
        tuple(preset.camera(name, robot, width=config.width, height=config.height) for name, preset in presets),
        ranges,
        camera_rng,
    )
    errors = calibration_errors(cameras, ranges, camera_rng)
    scene = replace(scene, cameras=tuple(_miscalibrated(camera, errors[camera.name]) for camera in cameras))
    info = EpisodeInfo(
        episode_index=plan.episode_index,
        attempt=plan.attempt,
        root_seed=config.seed,
        task=config.task,
        instruction=task.instruction(scene, _rng(plan, "expert")),
        robot=robot,
        scene=scene,
        fps=config.fps,
        physics_hz=config.physics_hz,
        behaviour=behaviour.as_mapping() | _calibration_values(errors),
        config=to_plain(config),
        config_digest=digest(config),
        versions=deciding_versions(config),
    )
    return Episode(
        plan=plan,
        info=info,
        task=task,
        behaviour=behaviour,
        cameras=cameras,
        true_from_recorded={name: error for name, error in errors.items() if error != Pose()},
    )


def _with_model_names(scene: Scene, module: str) -> Scene:
    """The scene of a task of the user's own, its models named as recordings name them."""
    shapes = [
        replace(body.shape, file=model_name(body.shape.file, module)) if body.shape.file else body.shape
        for body in scene.bodies
    ]
    return replace(scene, bodies=tuple(replace(b, shape=s) for b, s in zip(scene.bodies, shapes, strict=True)))


def _sampler(plan: EpisodePlan, ranges: Ranges) -> Sampler:
    config = plan.config
    # Another attempt would only fail at the same point again.
    method = config.sampling if plan.attempt == 0 else "random"
    point = stratified_point(
        method, root_seed=_root_seed(config), episode_index=plan.episode_index, block=config.sampling_block
    )
    return Sampler(_rng(plan, "scene"), unit_point=point, ranges=ranges, split=config.split, fixed=config.fixed)


def _miscalibrated(camera: Camera, true_from_recorded: Pose) -> Camera:
    if true_from_recorded == Pose():
        return camera
    return replace(camera, mount_from_camera=camera.mount_from_camera @ true_from_recorded)


def _calibration_values(errors: Mapping[str, Pose]) -> dict[str, float]:
    """The errors as recorded numbers: shift (m) and angle (rad) of each camera that has one."""
    values: dict[str, float] = {}
    for name, error in errors.items():
        if error != Pose():
            values |= {f"calibration_{name}_{axis}": float(v) for axis, v in zip("xyz", error.position, strict=True)}
            values[f"calibration_{name}_angle"] = angle_between(error, Pose())
    return values


def make_world(info: EpisodeInfo) -> World:
    """An empty world for episodes like this one (same robot, rates and joint sampling)."""
    return World(info.robot, fps=info.fps, sample_joints=info.config.get("joint_rate") == "physics")


def make_renderer(info: EpisodeInfo) -> AbstractContextManager[Renderer | None]:
    """The renderer that an episode's config names, or None without cameras; a context manager either way.

    Raises:
        ConfigError: An unknown renderer.
        MissingDependencyError, RenderError: It cannot work on this machine.
    """
    if not info.scene.cameras:
        return nullcontext(None)
    return RENDERERS.load(str(info.config["renderer"]))()


class Rollout:
    """Runs the expert in the world; iterate for the frames, then read `outcome`.

    Args:
        world: Of the episode's robot and frame rate; is reset when the iteration starts.
        episode: What to do.
        renderer: For the pictures, or None.

    Attributes:
        outcome: How it ended; None until the last frame has been taken.
    """

    def __init__(self, world: World, episode: Episode, renderer: Renderer | None = None) -> None:
        self.world = world
        self.episode = episode
        self.renderer = renderer
        self.outcome: Outcome | None = None

    def __iter__(self) -> Iterator[Frame]:
        """Yield one frame per control step; SceneError or RenderError when the scene cannot be built or drawn."""
        world, info, config = self.world, self.episode.info, self.episode.plan.config
        world.reset(info.scene)
        painter = None if self.renderer is None else Painter(self.renderer)
        if painter is not None:
            painter.setup(
                world,
                self.episode.cameras,
                true_from_recorded=self.episode.true_from_recorded,
                depth=config.depth,
                segmentation=config.segmentation,
                antialias=config.antialias,
            )
        expert = Expert(world, self.episode.behaviour)
        noise = ActionNoise(
            world, sigma=self.episode.behaviour.action_noise, rng=self.episode.rng("noise"), fps=info.fps
        )
        max_frames = math.floor(config.max_episode_seconds * info.fps)
        gave_up: list[GaveUp] = []
        timed_out = ""
        num_frames = 0
        for step in self._steps(expert, gave_up):
            if num_frames == max_frames:
                timed_out = step.phase
                break
            frame = Frame(
                frame_index=num_frames,
                time_ns=frame_time_ns(num_frames, info.fps),
                observation=world.observe(),
                action=step.action,
                command=noise.command(step),
                phase=step.phase,
                events=step.events,
                images={} if painter is None else painter.images(),
                joint_samples=world.joint_samples,
                is_deliberate_miss=step.is_deliberate_miss,
            )
            yield frame
            world.apply(frame.command)
            num_frames += 1
        stopped = ("", "")
        if timed_out:
            stopped = (timed_out, "time_limit")
        elif gave_up:
            stopped = (gave_up[0].phase, gave_up[0].reason)
        self.outcome = self._judge(expert, num_frames, stopped)

    def _steps(self, expert: Expert, gave_up: list[GaveUp]) -> Iterator[Step]:
        """The script; when the expert gives up, one step more, which carries the events that say why."""
        try:
            yield from self.episode.task.script(expert)
        except GaveUp as error:
            gave_up.append(error)
            yield expert.step()

    def _judge(self, expert: Expert, num_frames: int, stopped: tuple[str, str]) -> Outcome:
        checks = self.episode.task.evaluate(self.world)
        failed = [check.name for check in checks if not check.passed]
        phase, reason = stopped
        if not reason and failed:
            phase, reason = (expert.trouble[0] or expert.phase, failed[0])
        return Outcome(
            success=not reason,
            checks=checks,
            failure_phase=phase,
            failure_reason=reason,
            num_frames=num_frames,
            num_retries=expert.num_retries,
            final_state_digest=self.world.state_digest(),
        )


class ActionNoise:
    """Ornstein-Uhlenbeck noise on the executed joint targets; nothing is added except in free motion.

    The label stays clean, so that a policy learns how to come back (DART, Laskey et al. 2017,
    https://arxiv.org/abs/1703.09327). The noise lets go at the same rate whether more is added or not
    (`demorec.features.NOISE_LETS_GO`), so that there is one way back from it, which increments of the command can
    hold. Every command stays within the joint limits in position and velocity.
    """

    def __init__(self, world: World, *, sigma: float, rng: np.random.Generator, fps: int) -> None:
        self._kinematics = world.arm.kinematics
        self._sigma, self._rng = sigma, rng
        self._decay = (1.0 - NOISE_LETS_GO) ** (30 / fps)
        self._max_step = np.array(world.robot.velocity_limit) / fps
        self._noise: Array = np.zeros(len(self._max_step))
        self._last: Array = world.arm.target.copy()

    def command(self, step: Step) -> Action:
        """What is sent to the motors for a step: its clean action plus the noise."""
        if self._sigma == 0.0:
            return step.action
        drawn = self._rng.normal(0.0, self._sigma, len(self._noise))
        self._noise = self._decay * self._noise
        if step.noise_allowed:
            self._noise = self._noise + math.sqrt(1 - self._decay**2) * drawn
        target = step.action.joint_target + self._noise
        target = np.clip(target, self._kinematics.lower, self._kinematics.upper)
        target = np.clip(target, self._last - self._max_step, self._last + self._max_step)
        self._last = target
        return Action(
            joint_target=target,
            gripper_target=step.action.gripper_target,
            base_from_tcp_target=self._kinematics.forward(target),
        )
