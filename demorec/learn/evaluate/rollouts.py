"""A policy over many held-out scenes, in parallel workers, every rollout recorded.

    OUT/evaluation.json              settings, one line per rollout
    OUT/episodes/episode_000000.mcap    successes
    OUT/failed/episode_000003.mcap      failures

The recordings are ordinary ones (view, check, replay and export work on them); `action` is what the policy commanded.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field, replace
from importlib.metadata import PackageNotFoundError, version
from itertools import chain
from pathlib import Path
from typing import Any

from demorec.core.config import EpisodePlan, GenerateConfig, deciding_versions
from demorec.core.errors import (
    ConfigError,
    DemorecError,
    GenerationError,
    MissingDependencyError,
    describe_error,
    resource_error,
    write_error,
)
from demorec.core.files import make_folder, read_json_object, replace_text
from demorec.core.own_versions import differences
from demorec.core.plain import from_plain, to_plain
from demorec.core.replacing import (
    ReplaceableKind,
    check_replaceable,
    json_object,
    obstacle,
    replaced_parts,
    settle_parts,
)
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
from demorec.episode.info import sensor_feature
from demorec.episode.simulated import with_simulation
from demorec.generate.contents import foreign_recordings
from demorec.generate.executor import Raised
from demorec.generate.local import LocalExecutor
from demorec.gym_env import DemorecEnv
from demorec.learn.evaluate import TakeOver
from demorec.learn.evaluate.policy import (
    Policy,
    check_steps,
    find_checkpoint,
    policy_config,
    policy_digest,
    policy_inputs,
    trained_action,
)
from demorec.learn.evaluate.statistics import Rate, factors_of
from demorec.learn.evaluate.turns import Turns
from demorec.learn.evaluate.watch import correcting_behaviour
from demorec.loop import make_world, prepare
from demorec.mcap import EpisodeWriter
from demorec.robots.robot import RobotSpec
from demorec.runs.find import EVALUATION_NAME
from demorec.runs.run_file import EPISODES, FAILED, Attempt
from demorec.sim.sensors import SENSORS
from demorec.sim.world import World

_SENSORS = [sensor_feature(sensor.quantity) for sensor in SENSORS]

MAKE_ROLLOUT = "demorec.learn.evaluate.rollouts:make_rollout"


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What decides the result of an evaluation.

    Attributes:
        policy: Folder of the policy; where it lies does not matter, `policy_digest` does.
        policy_type: LeRobot's name of its kind ("act").
        policy_digest: SHA-256 of its config and weights, 16 hex digits.
        config: Task, split, root seed, cameras: which scenes, seen how.
        action: What the policy's actions mean.
        action_steps: Actions executed before it looks again; None: as trained.
        privileged: Whether it sees observation.environment_state.
        sensed: What else it sees of the features that datasets have only when named.
        state: What its observation.state holds.
        episode_length: Time limit; None: the environment's.
        takeover: When the expert takes over from the policy; None: never, as an evaluation of the policy wants it.
    """

    policy: str
    policy_type: str
    policy_digest: str
    config: GenerateConfig
    action: ActionKind
    action_steps: int | None = None
    privileged: bool = False
    sensed: tuple[str, ...] = ()
    state: StateKind = "joint"
    episode_length: int | None = None
    takeover: TakeOver | None = None


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """An evaluation, finished or not.

    Attributes:
        settings: What decides the result.
        rollouts: One line each, in the order of the episodes.
        factors: For each of these, what was randomised in its scene.
        versions: package -> version, of what decides scenes, rollouts and the policy's answers; none in evaluations of
            older versions of demorec.
    """

    settings: Settings
    rollouts: tuple[Attempt, ...] = ()
    factors: tuple[Mapping[str, float], ...] = field(default=())
    versions: Mapping[str, str] = field(default_factory=dict)

    @property
    def rate(self) -> Rate:
        """Of strict successes."""
        return Rate(successes=sum(bool(r.success) for r in self.rollouts), trials=len(self.rollouts))

    @property
    def successes(self) -> dict[int, bool]:
        """Scene (episode index) -> success."""
        return {r.episode_index: bool(r.success) for r in self.rollouts}


def settings_for(
    policy: Path,
    config: GenerateConfig,
    *,
    action: ActionKind | None = None,
    action_steps: int | None = None,
    episode_length: int | None = None,
    allowed: Sequence[str] = (),
) -> Settings:
    """Fill in what the policy's folder states: its kind, its actions, its inputs, its cameras' sizes.

    Args:
        policy: Folder of the policy.
        config: The caller's own words: which scenes; its cameras are those of their own that the policy may see.
        action, action_steps, episode_length: As of `Settings`; None: as trained, or the environment's.
        allowed: The user's own modules that may be imported for what the policy names.

    Raises:
        ConfigError: No policy, cameras that it needs and did not get, or actions of an unknown meaning.
        NotAllowedError: The policy names something of a module that is not allowed.
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
            "What the policy's actions mean is unknown, since the dataset it was trained on is gone or in motor units: "
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
    """By how many numbers of observation.state the policy takes; "joint" for what is neither, which LeRobot refuses."""
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
    """Run the policy in episodes 0 .. num_episodes - 1; goes on where an evaluation in `out` stopped.

    Raises:
        ConfigError: Another evaluation, or something else, is in the folder; or what is to be overwritten is not an
            evaluation alone.
        DemorecError: A rollout could not be carried out.
    """
    evaluation = _open(settings, out, overwrite=overwrite)
    done = evaluation.successes
    due = [
        EpisodePlan(config=settings.config, episode_index=index) for index in range(num_episodes) if index not in done
    ]
    with LocalExecutor(MAKE_ROLLOUT, out, workers=workers, recycle_after=1000) as executor:
        for report in chain.from_iterable(executor.carry_out(functools.partial(next, iter(due), None))):
            if isinstance(report, Raised):
                if report.kind == MissingDependencyError.__name__:
                    raise DemorecError(report.message)
                raise DemorecError(
                    f"Episode {report.plan.episode_index}: {report.kind}: {report.message.rstrip('.')}; the same "
                    "command goes on."
                )
            evaluation = _with(evaluation, [*evaluation.rollouts, report.attempt])
            _save(evaluation, out)
            progress(evaluation)
    return _with(evaluation, [r for r in evaluation.rollouts if r.episode_index < num_episodes])


def load_evaluation(folder: Path) -> Evaluation:
    """Read evaluation.json; ConfigError where there is none, DemorecError where it is damaged."""
    path = folder / EVALUATION_NAME
    try:
        return from_plain(read_json_object(path), Evaluation)
    except FileNotFoundError as error:
        raise ConfigError(f"No {EVALUATION_NAME}, so this is no output of demorec evaluate: {folder}") from error
    except (OSError, ValueError) as error:
        raise DemorecError(f"{EVALUATION_NAME} is damaged ({describe_error(error)}): {path}") from error


def make_rollout(plan: EpisodePlan, folder: Path) -> Attempt:
    """Run the policy once and record it; the work of a worker (see `demorec.generate.executor.Maker`)."""
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
    path.replace(folder / file)
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


@functools.lru_cache(maxsize=1)  # a worker is of one evaluation
def _stage(folder: Path) -> tuple[Settings, DemorecEnv, Policy, World | None]:
    """What decides, the environment, the policy and the world for rehearsals, kept from one rollout to the next."""
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


def _open(settings: Settings, out: Path, *, overwrite: bool) -> Evaluation:
    """The evaluation that is in the folder already, or a new one."""
    ours = out / EVALUATION_NAME
    if out.is_dir():
        settle_parts(out, _PARTS)
    if out.exists() and (not out.is_dir() or any(out.iterdir())) and not ours.is_file():
        raise ConfigError(f"The folder holds something that is no evaluation, choose another --out: {out}")
    if overwrite:
        check_replaceable(out, EVALUATION, overwrite=True)
    with replaced_parts(out, _PARTS) if overwrite and ours.is_file() else nullcontext():
        return _begin_or_continue(settings, out)


def _begin_or_continue(settings: Settings, out: Path) -> Evaluation:
    """Bring the folder and its evaluation.json to what is known now."""
    versions = _versions(settings.config)
    evaluation = Evaluation(settings=settings, versions=versions)
    if (out / EVALUATION_NAME).is_file():
        evaluation = load_evaluation(out)
        here_versions = versions if evaluation.versions else {}
        there, here = _deciding(evaluation.settings), _deciding(settings)
        if lines := differences(there, evaluation.versions, here, here_versions):
            advice = "choose another --out" + ("" if obstacle(out, EVALUATION) else " or --overwrite")
            raise ConfigError(f"Another evaluation is in this folder ({'; '.join(lines)}): {advice}: {out}")
        kept = [r for r in evaluation.rollouts if (out / r.file).is_file()]
        evaluation = _with(replace(evaluation, settings=settings), kept)
    for place in (EPISODES, FAILED):
        make_folder(out / place)
    _save(evaluation, out)
    return evaluation


_PARTS = (EVALUATION_NAME, EPISODES, FAILED)


def _is_evaluation(folder: Path) -> bool:
    found = json_object(folder / EVALUATION_NAME)
    return isinstance(found.get("settings"), dict) and isinstance(found.get("rollouts"), list)


EVALUATION = ReplaceableKind(
    name="an evaluation",
    is_folder=True,
    recognises=_is_evaluation,
    strangers=lambda folder: [name for place in (EPISODES, FAILED) for name in foreign_recordings(folder, place)],
)
"""What else is in its folder is never touched."""


def _deciding(settings: Settings) -> dict[str, Any]:
    return {key: value for key, value in to_plain(settings).items() if key != "policy"}


def _versions(config: GenerateConfig) -> dict[str, str]:
    """Of what decides the scenes, and of what the policy runs with."""
    versions = deciding_versions(config)
    for package in ("lerobot", "torch"):
        with suppress(PackageNotFoundError):
            versions[package] = version(package)
    return versions


def _with(evaluation: Evaluation, rollouts: list[Attempt]) -> Evaluation:
    ordered = sorted(rollouts, key=lambda r: r.episode_index)
    return replace(
        evaluation,
        rollouts=tuple(ordered),
        factors=tuple(_factors(evaluation.settings.config, r.episode_index, r.attempt) for r in ordered),
    )


@functools.lru_cache(maxsize=100_000)
def _factors(config: GenerateConfig, episode_index: int, attempt: int) -> dict[str, float]:
    plan = EpisodePlan(config=config, episode_index=episode_index, attempt=attempt)
    return factors_of(prepare(plan).info.simulated.scene)


def _save(evaluation: Evaluation, folder: Path) -> None:
    try:
        replace_text(folder / EVALUATION_NAME, json.dumps(to_plain(evaluation), indent=1, allow_nan=False))
    except OSError as error:
        raise resource_error(error) or write_error("The evaluation", error, folder, GenerationError) from error
