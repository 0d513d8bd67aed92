"""Recorded actions back into the simulator: the proof that a recording is what it says.

The world is rebuilt from the recording's own scene, the recorded float64 commands are sent again, and every state on
the way is compared with the recorded one, bit by bit. On one type of machine nothing may differ. The same driver
answers how robust a demonstration is (a lower command rate, noise, delay) and whether an exported dataset, with its
float32 actions of any kind, still does the task.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from demorec.config import VideoConfig
from demorec.episode import Action, Check, EpisodeInfo, Frame, Outcome, frame_time_ns
from demorec.errors import ConfigError, RecordingError
from demorec.features import ACTION, STATE, ActionKind, joint_target_from_increment, pose_from_delta
from demorec.geometry import Array, Pose
from demorec.plain import from_plain
from demorec.recording import EpisodeWriter, Recording
from demorec.recording.frames import command_at, frames_of, pose_of
from demorec.rerender import Painter, recorded_view
from demorec.seeding import generator
from demorec.sim.world import World
from demorec.tables import TASKS

FrameSink = Callable[[Frame], None]


@dataclass(frozen=True, kw_only=True)
class ReplayOptions:
    """How actions are sent.

    Attributes:
        states: Place the recorded states one after the other, without physics, instead of sending actions.
        export_hz: Commands a second; divides the recording's rate. None: the recorded rate.
        noise: Standard deviation of Gaussian noise on every joint target, rad.
        delay: Steps by which every command comes late.
        seed: Of the noise.
    """

    states: bool = False
    export_hz: int | None = None
    noise: float = 0.0
    delay: int = 0
    seed: int = 0

    def validate(self) -> None:
        """Raise ConfigError for impossible values and combinations."""
        if not 0.0 <= self.noise <= 1.0:
            raise ConfigError(f"noise is {self.noise}, allowed are 0 to 1 rad.")
        if not 0 <= self.delay <= 1000:
            raise ConfigError(f"delay is {self.delay}, allowed are 0 to 1000 steps.")
        if self.states and (self.noise or self.delay or self.export_hz):
            raise ConfigError("--states sends no commands: leave out --noise, --delay and --export-hz.")

    @property
    def is_plain(self) -> bool:
        """Whether the commands are sent as recorded."""
        return not (self.states or self.noise or self.delay or self.export_hz)


@dataclass(frozen=True, kw_only=True, eq=False)
class Demonstration:
    """What is replayed: a start, commands, and what the recorded states were.

    Attributes:
        name: Of the file or of the dataset's episode.
        info: The recorded scene and robot.
        fps: Commands a second.
        commands: (world at its start) -> what to send, one a step; built late, since IK needs the start.
        joint_position: (T, n) recorded before each command; n = n_joints, or n_arm of a dataset.
        joint_velocity: (T, n_joints), or None.
        gripper_width: (T,) m.
        object_poses: name -> (T, 7); empty for a dataset.
        recorded_success: Whether the episode succeeded when it was recorded; None if that is not known.
        final_state_digest: Of the recording, or "".
        tolerance: Difference up to which a state counts as the same: 0 for float64, rounding for float32.
        source: The recording's file; None for an episode of a dataset.
        digest: Of its content.
        recorded: The recorded frames, without pictures, where every one of them is replayed.
        recorded_checks: Conditions of the task as recorded.
    """

    name: str
    info: EpisodeInfo
    fps: int
    commands: Callable[[World], Iterator[Action]]
    joint_position: Array
    joint_velocity: Array | None
    gripper_width: Array
    object_poses: Mapping[str, Array]
    recorded_success: bool | None
    final_state_digest: str = ""
    tolerance: float = 0.0
    source: Path | None = None
    digest: str = ""
    recorded: tuple[Frame, ...] = ()
    recorded_checks: tuple[Check, ...] = ()

    def labelled(self, frame: Frame) -> Frame:
        """A frame of the replay with the recorded label, phase and events of the same frame, if there is one."""
        if frame.frame_index >= len(self.recorded):
            return frame
        then = self.recorded[frame.frame_index]
        return replace(
            frame,
            action=then.action,
            phase=then.phase,
            events=then.events,
            is_deliberate_miss=then.is_deliberate_miss,
        )

    @property
    def num_steps(self) -> int:
        """T."""
        return len(self.joint_position)


@dataclass(frozen=True, kw_only=True)
class ReplayReport:
    """How a replay compares with the recording.

    Attributes:
        name: What was replayed.
        num_steps: Commands sent.
        is_bitwise: Whether full float64 states were compared, so that nothing may differ.
        is_identical: No bit of any compared state differs, the final state's digest included (float32 datasets: no
            more than rounding).
        first_difference: First step with another state, and what differed there; None when none does.
        joint_error, joint_error_step: Largest difference of an arm joint, rad, and where.
        gripper_error: Largest difference of the opening, m.
        object_error, object_error_step, object_error_name: Largest distance of an object from its recorded place, m.
        recorded_success, success: Of the task, then and now; None where that is not known or not judged.
        failed_checks: Conditions that do not hold now.
        unreachable: Steps whose pose inverse kinematics did not reach (the arm held its last target).
    """

    name: str
    num_steps: int
    is_bitwise: bool
    is_identical: bool
    first_difference: tuple[int, str] | None
    joint_error: float
    joint_error_step: int
    gripper_error: float
    object_error: float
    object_error_step: int
    object_error_name: str
    recorded_success: bool | None
    success: bool | None
    failed_checks: tuple[str, ...] = ()
    unreachable: int = 0


def open_demonstration(recording: Recording, options: ReplayOptions) -> Demonstration:
    """A recording to be replayed.

    Raises:
        RecordingError: It is damaged or empty.
        ConfigError: `export_hz` does not divide its rate.
    """
    info, columns = recording.info, recording.columns()
    if columns.num_frames == 0:
        raise RecordingError(f"The recording has no frames: {recording.path}")
    fps = options.export_hz or info.fps
    if info.fps % fps:
        divisors = ", ".join(str(n) for n in range(1, info.fps + 1) if info.fps % n == 0)
        raise ConfigError(f"export-hz is {fps}, which does not divide the recording's {info.fps}: use {divisors}.")
    stride = info.fps // fps
    rows = np.arange(0, columns.num_frames, stride)
    # As the export does: where the arm shall be when the next observation is taken.
    sent = np.minimum(rows + stride - 1, columns.num_frames - 1)
    outcome = recording.outcome
    return Demonstration(
        name=recording.path.name,
        info=info,
        fps=fps,
        commands=lambda world: (command_at(columns, int(row)) for row in sent),
        joint_position=columns.joint_position[rows],
        joint_velocity=None if options.states else columns.joint_velocity[rows],
        gripper_width=columns.gripper_width[rows],
        object_poses={name: poses[rows] for name, poses in columns.object_poses.items()},
        recorded_success=None if outcome is None else outcome.success,
        final_state_digest="" if outcome is None or stride > 1 else outcome.final_state_digest,
        # Placing a body normalises its quaternion once more.
        tolerance=1e-9 if options.states else 0.0,
        digest=recording.digest(),
        recorded=tuple(frames_of(recording, columns)) if stride == 1 else (),
        recorded_checks=() if outcome is None else outcome.checks,
    )


@dataclass(kw_only=True)
class _Comparison:
    """What is kept of the comparison while the steps go by."""

    demonstration: Demonstration
    first: tuple[int, str] | None = None
    joint: tuple[float, int] = (0.0, 0)
    gripper: float = 0.0
    object: tuple[float, int, str] = (0.0, 0, "")
    unreachable: int = 0

    def take(self, step: int, world: World) -> None:
        """Compare the world's present state with the recorded one of a step."""
        d, seen = self.demonstration, world.observe()
        num_arm = len(d.info.robot.arm_joints)
        recorded = d.joint_position[step]
        differences = [
            ("joint positions", float(np.abs(seen.joint_position[: len(recorded)] - recorded).max())),
            ("gripper opening", abs(seen.gripper_width - float(d.gripper_width[step]))),
        ]
        if d.joint_velocity is not None:
            off = np.abs(seen.joint_velocity - d.joint_velocity[step])
            differences.append(("joint velocities", float(off.max())))
        for name, poses in d.object_poses.items():
            off = np.abs(seen.object_poses[name].vector() - poses[step])
            differences.append((f"the pose of {name}", float(off.max())))
            distance = math.dist(seen.object_poses[name].position, poses[step, :3])
            if distance > self.object[0] or not math.isfinite(distance):
                self.object = (distance, step, name)
        if self.first is None:
            # Written so that what is no number differs.
            what = next((name for name, off in differences if not off <= d.tolerance), None)
            self.first = None if what is None else (step, what)
        arm = float(np.abs(seen.joint_position[:num_arm] - recorded[:num_arm]).max())
        if arm > self.joint[0] or not math.isfinite(arm):
            self.joint = (arm, step)
        self.gripper = max(self.gripper, differences[1][1])


def replay(
    demonstration: Demonstration, world: World, options: ReplayOptions, *, sink: FrameSink | None = None
) -> tuple[ReplayReport, tuple[Check, ...]]:
    """Send the actions of a demonstration and compare.

    Args:
        demonstration: What to do.
        world: Of its robot and rate (`World(info.robot, fps=demonstration.fps)`); is reset.
        options: How.
        sink: Is given every frame of the replay, without pictures, before its command is sent.

    Returns:
        The report, and the task's conditions at the end (empty with `states`).
    """
    d = demonstration
    world.reset(d.info.scene)
    comparison = _Comparison(demonstration=d)
    if options.states:
        for step in range(d.num_steps):
            place_state(world, d, step)
            comparison.take(step, world)
            if sink is not None:
                command = d.recorded[step].command if step < len(d.recorded) else _hold(world)
                sink(_frame(world, step, d.fps, command))
        return _report(comparison, checks=(), digest=None), ()
    num_steps = 0
    for step, command in enumerate(_sent(d, world, options, comparison)):
        if step < d.num_steps:
            comparison.take(step, world)
        if sink is not None:
            sink(_frame(world, step, d.fps, command))
        world.apply(command)
        num_steps = step + 1
    checks = TASKS.load(d.info.task)().evaluate(world)
    digest = world.state_digest() if d.final_state_digest else None
    report = _report(comparison, checks=checks, digest=digest)
    return replace(report, num_steps=num_steps), checks


def _sent(d: Demonstration, world: World, options: ReplayOptions, comparison: _Comparison) -> Iterator[Action]:
    rng = generator(root_seed=options.seed, episode_index=d.info.episode_index, attempt=d.info.attempt, purpose="noise")
    for _ in range(options.delay):
        yield _hold(world)
    for command in d.commands(world):
        if not np.isfinite(command.joint_target).all():  # IK's way to say that it found nothing
            comparison.unreachable += 1
            command = replace(_hold(world), gripper_target=command.gripper_target)
        if options.noise > 0.0:
            command = _noisy(command, world, rng.normal(0.0, options.noise, len(command.joint_target)))
        yield command


def _noisy(command: Action, world: World, noise: Array) -> Action:
    low, high = np.array(world.robot.position_lower), np.array(world.robot.position_upper)
    target = np.clip(command.joint_target + noise, low, high)
    return Action(
        joint_target=target,
        gripper_target=command.gripper_target,
        base_from_tcp_target=world.arm.kinematics.forward(target),
    )


def _hold(world: World) -> Action:
    target = world.arm.target.copy()
    return Action(
        joint_target=target,
        gripper_target=world.arm.gripper_target,
        base_from_tcp_target=world.arm.kinematics.forward(target),
    )


def place_state(world: World, demonstration: Demonstration, step: int) -> None:
    """Put joints and objects where they were recorded at a step, without physics."""
    world.set_state(
        joint_position=demonstration.joint_position[step],
        object_poses={name: pose_of(poses[step]) for name, poses in demonstration.object_poses.items()},
    )


def _frame(world: World, step: int, fps: int, command: Action) -> Frame:
    return Frame(
        frame_index=step,
        time_ns=frame_time_ns(step, fps),
        observation=world.observe(),
        action=command,
        command=command,
        phase="",
        joint_samples=world.joint_samples,
    )


def _report(comparison: _Comparison, *, checks: Sequence[Check], digest: str | None) -> ReplayReport:
    d = comparison.demonstration
    first = comparison.first
    if first is None and digest is not None and digest != d.final_state_digest:
        first = (d.num_steps, "the final state")
    failed = tuple(check.name for check in checks if not check.passed)
    return ReplayReport(
        name=d.name,
        num_steps=d.num_steps,
        is_bitwise=bool(d.object_poses) or d.joint_velocity is not None,
        is_identical=first is None,
        first_difference=first,
        joint_error=comparison.joint[0],
        joint_error_step=comparison.joint[1],
        gripper_error=comparison.gripper,
        object_error=comparison.object[0],
        object_error_step=comparison.object[1],
        object_error_name=comparison.object[2],
        recorded_success=d.recorded_success,
        success=not failed if checks else None,
        failed_checks=failed,
        unreachable=comparison.unreachable,
    )


def is_as_recorded(report: ReplayReport, *, tolerance: float = 0.0, bitwise: bool = True) -> bool:
    """Whether a replay is what the recording says.

    Args:
        report: Of the replay.
        tolerance: Differences (m, rad) up to which states count as the same.
        bitwise: Whether the states must be the same; otherwise (changed commands) the outcome alone counts.
    """
    if not report.is_bitwise or not bitwise:
        return report.success is None or report.recorded_success is None or report.success == report.recorded_success
    return report.is_identical or (
        tolerance > 0.0
        and max(report.joint_error, report.gripper_error, report.object_error) <= tolerance
        and report.success == report.recorded_success
    )


def open_file(path: Path, options: ReplayOptions) -> Demonstration:
    """A recording's file to be replayed; errors as `open_demonstration`."""
    with Recording(path) as recording:
        return replace(open_demonstration(recording, options), source=path)


def replay_all(
    demonstrations: Iterable[Demonstration], options: ReplayOptions, *, out: Path | None = None, overwrite: bool = False
) -> Iterator[tuple[ReplayReport, tuple[Path, Path] | None]]:
    """Replay one after the other, in one world as long as robot and rate stay the same.

    Args:
        demonstrations: What to replay.
        options: How.
        out: Folder for recordings of the replays; None records nothing.
        overwrite: Whether recordings there may be replaced.

    Yields:
        The report, and (recording, recording of its replay) where one was made.
    """
    world: World | None = None
    key: object = None
    try:
        for demonstration in demonstrations:
            info = demonstration.info
            sample_joints = out is not None and info.config.get("joint_rate") == "physics"
            if world is None or key != (info.robot, demonstration.fps, sample_joints):
                if world is not None:
                    world.close()
                world = World(info.robot, fps=demonstration.fps, sample_joints=sample_joints)
                key = (info.robot, demonstration.fps, sample_joints)
            if out is None:
                yield replay(demonstration, world, options)[0], None
            else:
                report, path = record_replay(demonstration, world, options, out, overwrite=overwrite)
                yield report, None if demonstration.source is None else (demonstration.source, path)
    finally:
        if world is not None:
            world.close()


def record_replay(
    demonstration: Demonstration, world: World, options: ReplayOptions, out: Path, *, overwrite: bool
) -> tuple[ReplayReport, Path]:
    """Replay and record it, with pictures of the recording's cameras, into a file of the same name in `out`.

    Raises:
        ConfigError: The new recording would replace the one that is replayed.
        RecordingError: A recording of that name is there already.
    """
    d = demonstration
    path = out / (d.name if d.source is not None else f"{d.name}.mcap")
    if d.source is not None and path.resolve() == d.source.resolve():
        raise ConfigError(f"The replay would replace the recording itself, choose another --out: {out}")
    out.mkdir(parents=True, exist_ok=True)
    config = d.info.config
    view = recorded_view(d.info)
    info = replace(d.info, fps=d.fps, origin=f"replay of {d.digest[:16]}")
    video = from_plain(config.get("video", {}), VideoConfig)
    num_frames = 0
    with ExitStack() as stack:
        painter = None
        if info.scene.cameras:
            painter = stack.enter_context(Painter(str(config.get("renderer", "raster"))))
        writer = stack.enter_context(EpisodeWriter(path, info, video=video, overwrite=overwrite))

        def sink(frame: Frame) -> None:
            nonlocal num_frames
            if painter is not None and num_frames == 0:
                painter.setup(
                    world,
                    view,
                    depth=bool(config.get("depth", False)),
                    segmentation=bool(config.get("segmentation", False)),
                    antialias=bool(config.get("antialias", True)),
                )
            num_frames += 1
            images = {} if painter is None else painter.images()
            writer.write(replace(d.labelled(frame), images=images))

        report, checks = replay(d, world, options, sink=sink)
        success = bool(report.success) if checks else bool(report.recorded_success)
        writer.finish(
            Outcome(
                success=success,
                checks=checks if checks else d.recorded_checks,
                failure_phase="" if success else "replay",
                failure_reason="" if success else (report.failed_checks or ("unknown",))[0],
                num_frames=num_frames,
                final_state_digest=world.state_digest(),
            )
        )
    return report, path


# ------------------------------------------------------------------------------------------------------- datasets


def dataset_demonstrations(
    path: Path, wanted: Callable[[int], bool], options: ReplayOptions, *, limit: int | None = None
) -> Iterator[Demonstration]:
    """The episodes of an exported dataset, by what its sidecar keeps of their scenes.

    Args:
        path: The dataset.
        wanted: Whether an episode, by its number in the dataset, is wanted.
        options: How it will be replayed.
        limit: No more than this many, spread evenly.

    Raises:
        ConfigError: The dataset has no sidecar of ours, other actions, or the options make no sense for it.
        ExportError: It is damaged.
    """
    from demorec.check.dataset import Dataset

    if options.states or options.export_hz:
        raise ConfigError("--states and --export-hz are for recordings: a dataset has no full states and one rate.")
    dataset = Dataset(path)
    if not dataset.sidecar:
        raise ConfigError(f"The dataset does not say how its scenes were (no demorec/episodes): {path}")
    numbers = [number for number in range(len(dataset.rows)) if wanted(number)]
    if limit is not None and len(numbers) > limit:
        numbers = [numbers[k * len(numbers) // limit] for k in range(limit)]
    for number in numbers:
        rows, row, info = dataset.rows[number], dataset.sidecar[number], dataset.infos[number]
        kind = dataset.action_kind(info)
        if kind is None:
            raise ConfigError(f"The dataset's actions are none that demorec writes, so they cannot be replayed: {path}")
        state = rows[STATE].astype(np.float64)
        actions = rows[ACTION].astype(np.float64)
        yield Demonstration(
            name=f"{path.name}_episode_{number:06d}",
            info=info,
            fps=dataset.info.fps,
            commands=partial(dataset_commands, actions, kind),
            joint_position=state[:, :-1],
            joint_velocity=None,
            gripper_width=state[:, -1],
            object_poses={},
            recorded_success=bool(row["success"]),
            tolerance=1e-6,
            digest=str(row["content_digest"]),
        )


def dataset_commands(actions: Array, kind: ActionKind, world: World) -> Iterator[Action]:
    """What to send for the rows of a dataset's action column; a NaN target where IK finds nothing.

    Args:
        actions: (T, D).
        kind: What they are (`demorec.features.action_vectors`).
        world: At the episode's start.
    """
    kinematics = world.arm.kinematics
    num_arm = len(world.robot.arm_joints)
    target = world.arm.target.copy()
    pose = world.observe().base_from_tcp
    for row in actions:
        gripper = float(row[-1])
        if kind == "joint":
            target = row[:num_arm].copy()
        elif kind == "joint_increment":
            target = joint_target_from_increment(target, row)
        else:
            if kind == "ee":
                quat = row[3:7] / math.sqrt(float((row[3:7] * row[3:7]).sum()))
                pose = Pose(position=row[:3], quat_xyzw=quat)
            else:
                pose = pose_from_delta(pose, row)
            found = kinematics.inverse(pose, start=target)
            if found is None:
                nothing = np.full(num_arm, np.nan)
                yield Action(joint_target=nothing, gripper_target=gripper, base_from_tcp_target=pose)
                continue
            target = found
        yield Action(joint_target=target, gripper_target=gripper, base_from_tcp_target=kinematics.forward(target))
