"""Run a policy in many held-out scenes, in parallel workers, and record every rollout.

    OUT/evaluation.json              settings, one line per rollout
    OUT/episodes/episode_000000.mcap    successes
    OUT/failed/episode_000003.mcap      failures

The recordings are ordinary ones (view, check, replay and export work on them); `action` is the policy's command.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path

from demorec.core.config import EpisodePlan, GenerateConfig
from demorec.core.errors import ConfigError, DemorecError, MissingDependencyError
from demorec.core.tables import ROBOTS, camera_name
from demorec.episode.episode import Outcome
from demorec.episode.features import (
    CONTACT_FORCE,
    EFFORT,
    ENVIRONMENT_STATE,
    IMAGE_PREFIX,
    STATE,
    ActionKind,
    StateKind,
    state_names,
)
from demorec.episode.info import OBSERVATION
from demorec.episode.simulated import with_simulation
from demorec.extensions.policies.evaluation import (
    Evaluation,
    Settings,
    load_evaluation,
    open_evaluation,
    save_evaluation,
    with_rollouts,
)
from demorec.extensions.policies.gym_env import DemorecEnv
from demorec.extensions.policies.policy import (
    Policy,
    check_steps,
    find_checkpoint,
    policy_config,
    policy_digest,
    policy_inputs,
    trained_action,
)
from demorec.extensions.policies.turns import Turns, correcting_behaviour
from demorec.generate.executor import LocalExecutor, Raised
from demorec.loop import make_world
from demorec.mcap import EpisodeWriter
from demorec.robots.robot import RobotSpec
from demorec.runs.recorded import place_recording
from demorec.runs.run_file import EPISODES, FAILED, Attempt
from demorec.sim.sensors import SENSORS
from demorec.sim.world import World

_SENSORS = [OBSERVATION + sensor.quantity for sensor in SENSORS]

MAKE_ROLLOUT = "demorec.extensions.policies.rollouts:make_rollout"


def settings_for(
    policy: Path,
    config: GenerateConfig,
    *,
    action: ActionKind | None = None,
    action_steps: int | None = None,
    episode_length: int | None = None,
    allowed: Sequence[str] = (),
) -> Settings:
    """Read the policy's type, actions, inputs and camera sizes from its folder.

    The cameras of `config` are the user's own that the policy may see; `allowed` modules may be imported if the policy
    names them.

    Raises:
        ConfigError: No policy, missing cameras, or actions of an unknown meaning.
        NotAllowedError: The policy names an object of a module that is not allowed.
    """
    checkpoint = find_checkpoint(policy)
    check_steps(checkpoint, allowed)
    plain, inputs = policy_config(checkpoint), policy_inputs(checkpoint)
    images = {name.removeprefix(IMAGE_PREFIX): inputs[name] for name in inputs if name.startswith(IMAGE_PREFIX)}
    if images:
        (_, height, width), *_ = images.values()
        own = {camera_name(name): name for name in config.cameras}
        of_policy = replace(config, cameras=tuple(own.get(name, name) for name in images), width=width, height=height)
        of_policy.check_names((*config.modules, *allowed))
        config = of_policy
    action = action or trained_action(checkpoint)
    if action is None:
        raise ConfigError(
            "The meaning of the policy's actions is unknown, since its training dataset is gone or in motor units: "
            "give --action joint, joint_increment, ee or ee_delta (none is in motor units)."
        )
    config.validate()
    return Settings(
        policy=str(policy),
        policy_type=str(plain.get("type", "")),
        policy_digest=policy_digest(checkpoint),
        config=config,
        action=action,
        action_steps=action_steps,
        privileged=ENVIRONMENT_STATE in inputs,
        sensed=tuple(name for name in (EFFORT, CONTACT_FORCE, *_SENSORS) if name in inputs),
        state=_state_kind(inputs, ROBOTS.load(config.robot)),
        episode_length=episode_length,
    )


def _state_kind(inputs: Mapping[str, tuple[int, ...]], robot: RobotSpec) -> StateKind:
    """State kind by the size of the policy's observation.state; "joint" for any other size, which LeRobot rejects."""
    if STATE not in inputs:
        return "joint"
    return "joint_ee" if inputs[STATE] == (len(state_names(robot, "joint_ee")),) else "joint"


def evaluate(
    settings: Settings,
    out: Path,
    *,
    num_episodes: int,
    workers: int,
    overwrite: bool = False,
    progress: Callable[[Evaluation], None] = lambda evaluation: None,
) -> Evaluation:
    """Run the policy in episodes 0 .. num_episodes - 1; continues an evaluation in `out`.

    Raises:
        ConfigError: Another evaluation or other files are in the folder, another command writes there, or the folder to
        overwrite holds more than an evaluation.
        DemorecError: A rollout failed to run.
    """
    with open_evaluation(settings, out, overwrite=overwrite) as evaluation:
        done = {rollout.episode_index for rollout in evaluation.rollouts}
        due = iter(
            EpisodePlan(config=settings.config, episode_index=index)
            for index in range(num_episodes)
            if index not in done
        )
        with LocalExecutor(MAKE_ROLLOUT, out, workers=workers, recycle_after=1000) as executor:
            for report in chain.from_iterable(executor.carry_out(lambda: next(due, None))):
                if isinstance(report, Raised):
                    if report.kind == MissingDependencyError.__name__:
                        raise DemorecError(report.message)
                    why = report.message.rstrip(".")
                    raise report.error(f"Episode {report.plan.episode_index}: {why}; the same command continues.")
                evaluation = with_rollouts(evaluation, [*evaluation.rollouts, report.attempt])
                save_evaluation(evaluation, out)
                progress(evaluation)
        return with_rollouts(evaluation, [r for r in evaluation.rollouts if r.episode_index < num_episodes])


def make_rollout(plan: EpisodePlan, folder: Path) -> Attempt:
    """Run the policy once and record it, in a worker (see `demorec.generate.executor.Maker`)."""
    settings, env, policy, world = _stage(folder)
    observation, _ = env.reset(seed=plan.episode_index)
    info, kind = env.info, "rollout"
    if settings.takeover is not None:
        behaviour = {
            **info.simulated.behaviour,
            **correcting_behaviour(env.episode, noise=settings.takeover.noise).as_mapping(),
        }
        info, kind = with_simulation(info, behaviour=behaviour), "correction"
    info = replace(info, origin=f"{kind} of {settings.policy_type} {settings.policy_digest}")
    turns = Turns(env, policy, observation, seed=plan.episode_index, rules=settings.takeover, rehearsal_world=world)
    name = f"episode_{plan.episode_index:06d}.mcap"
    path = folder / name
    with EpisodeWriter(path, info, video=plan.config.video, overwrite=True) as recording:
        for frame in turns.frames():
            recording.write(frame)
        after = env.situation
        phase, reason = turns.failure()
        outcome = Outcome(
            success=turns.success,
            checks=after.checks,
            failure_phase=phase,
            failure_reason=reason,
            num_frames=after.frame_index,
            num_retries=turns.num_retries,
            final_state_digest=env.world.state_digest(),
        )
        num_bytes = recording.finish(outcome).stat().st_size
    file = f"{EPISODES if turns.success else FAILED}/{name}"
    place_recording(path, folder / file)
    return Attempt(
        episode_index=plan.episode_index,
        attempt=info.attempt,
        seed=plan.config.seed,
        success=turns.success,
        file=file,
        sha256="",
        digest=outcome.final_state_digest[:16],
        num_frames=outcome.num_frames,
        num_bytes=num_bytes,
        phase=phase,
        reason=reason,
    )


@functools.lru_cache(maxsize=1)  # a worker serves one evaluation
def _stage(folder: Path) -> tuple[Settings, DemorecEnv, Policy, World | None]:
    """Load what is kept between rollouts; the world is for simulating the expert."""
    settings = load_evaluation(folder).settings
    env = DemorecEnv(
        config=settings.config,
        action=settings.action,
        privileged=settings.privileged,
        sensed=settings.sensed,
        state=settings.state,
        episode_length=settings.episode_length,
    )
    policy = Policy(find_checkpoint(Path(settings.policy)), action_steps=settings.action_steps)
    return settings, env, policy, None if settings.takeover is None else make_world(env.info)
