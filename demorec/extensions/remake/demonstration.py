"""Recordings, and episodes of datasets, opened for replay, and the options of a replay.

Datasets have float32 actions of any kind; their scenes come from the sidecar. A real arm's data has numbers only: the
simulated arm starts in the same state, on an empty table, and receives the same actions. Its distance from the recorded
states shows how well the simulator (or the calibration) matches that arm.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, get_args

import numpy as np

from demorec.core.config import MAX_PHYSICS_HZ, deciding_versions
from demorec.core.errors import ConfigError, ExportError, OptionError, RecordingError, check_option, check_seed
from demorec.core.geometry import Array, Pose
from demorec.episode.episode import Action, Frame, Observation, Outcome, gave_up
from demorec.episode.features import ACTION, STATE, ActionKind, action_names
from demorec.episode.info import EpisodeInfo, Simulation
from demorec.episode.roles import NO_NAMES, NamedRoles
from demorec.episode.scene import Physics, RobotPlacement, Scene
from demorec.episode.simulated import simulated_info
from demorec.mcap import Recording, open_recording, open_simulated
from demorec.mcap.frames import action_at, frames_of, observation_at
from demorec.robots.motors import Motors
from demorec.robots.robot import RobotSpec
from demorec.sim.sensors import SENSORS

if TYPE_CHECKING:
    from demorec.extensions.remake.motion import RobotMotion

JOINTS, OPENING, EE_POSE, POSE_OF = "joint positions", "gripper opening", "the EE pose", "the pose of "
_LEAST_HZ = Physics.hz
"""Minimum physics rate in the replay of a real arm, with a whole number of steps per frame."""


@dataclass(frozen=True, kw_only=True)
class ReplayOptions:
    """Options of a replay.

    Attributes:
        states: Place the recorded states in sequence, without physics, instead of sending actions.
        export_hz: Commands per second; divides the recording's rate. None: the recorded rate.
        noise: Standard deviation of Gaussian noise on every joint target, rad.
        delay: Number of steps by which every command is delayed.
        seed: Seed of the noise.
        allowed: The user's own modules that may be imported for the demonstrations.
        robot: Simulated arm for a real arm's actions; None: the robot of each recorded scene.
        motors: Servos of states and actions in datasets, if the user names them.
        named: Roles that the user names, for features of a real arm.
    """

    states: bool = False
    export_hz: int | None = None
    noise: float = 0.0
    delay: int = 0
    seed: int = 0
    allowed: tuple[str, ...] = ()
    robot: RobotSpec | None = None
    motors: Motors | None = None
    named: NamedRoles = NO_NAMES

    def validate(self) -> None:
        """Raise ConfigError for impossible values and combinations."""
        check_option("noise", self.noise, 0, 1, "rad")
        check_option("delay", self.delay, 0, 1000, "steps")
        check_seed("seed", self.seed)
        check_option("export_hz", self.export_hz, 1, MAX_PHYSICS_HZ, "Hz")
        if self.states and (self.noise or self.delay or self.export_hz):
            raise ConfigError("--states sends no commands: leave out --noise, --delay and --export-hz.")
        if self.robot is not None and (self.states or self.export_hz):
            raise ConfigError("--states and --export-hz are for recordings with a scene: leave them out with --robot.")
        if self.motors is not None and self.robot is None:
            raise ConfigError("--motor-units is for the dataset of a real arm: add --robot so101.")
        if self.named and self.robot is None:
            raise ConfigError("--state, --action and --gripper are for the data of a real arm: add --robot.")

    @property
    def changes(self) -> str:
        """Changes of the commands, for a replay's origin; "" if unchanged."""
        if self.states:
            return " by its states"
        changes = [("noise", self.noise), ("seed", self.noise and self.seed), ("delay", self.delay)]
        return "".join(f", {name} {value}" for name, value in [*changes, ("export_hz", self.export_hz)] if value)

    @property
    def is_plain(self) -> bool:
        """Whether the commands are sent as recorded."""
        return not (self.states or self.noise or self.delay or self.export_hz)


@dataclass(frozen=True, kw_only=True, eq=False)
class Demonstration:
    """An episode to replay: a start, commands, and recorded states.

    Attributes:
        name: Name of the file or of the dataset's episode.
        info: The recorded scene and robot.
        fps: Commands per second.
        commands: Recorded commands, one per step; of a recording.
        actions: (T, D) from which the commands are decoded; of a dataset.
        action_kind: Meaning of `actions`; None with `commands`.
        compared: Name in `seen_in` -> (T, D) recorded before each command; for a dataset only the opening and the arm's
        joints.
        outcome: Recorded outcome, without a final state if that is not compared; None if unknown.
        tolerance: Maximum difference of equal states: 0 for float64, rounding for float32.
        source: File of the recording; None for an episode of a dataset.
        digest: Digest of its content.
        recorded: Recorded frames without images, if every one is replayed.
        gave_up: Whether the recording gives the reason of its failure (`gave_up`).
        is_measured: Whether the states are a real arm's, which no simulation reproduces bit-exactly.
    """

    name: str
    info: EpisodeInfo
    fps: int
    compared: Mapping[str, Array]
    outcome: Outcome | None
    commands: tuple[Action, ...] = ()
    actions: Array | None = None
    action_kind: ActionKind | None = None
    tolerance: float = 0.0
    source: Path | None = None
    digest: str = ""
    recorded: tuple[Frame, ...] = ()
    gave_up: bool = False
    is_measured: bool = False

    @property
    def success(self) -> bool | None:
        """Recorded success; None if unknown."""
        return None if self.outcome is None else self.outcome.success

    @property
    def num_steps(self) -> int:
        """Number of steps, T."""
        return len(self.compared[JOINTS])

    @property
    def objects(self) -> tuple[str, ...]:
        """Names of objects with recorded poses."""
        return tuple(name.removeprefix(POSE_OF) for name in self.compared if name.startswith(POSE_OF))


def open_demonstration(recording: Recording, options: ReplayOptions) -> Demonstration:
    """Open a recording for replay.

    Raises:
        RecordingError: It is damaged or empty.
        ConfigError: `export_hz` does not divide its rate.
    """
    info, trajectory = _sensed_here(recording.info), recording.trajectory()
    trajectory = replace(trajectory, sensed={name: trajectory.sensed[name] for name in info.sensors})
    if trajectory.num_frames == 0:
        raise RecordingError(f"The recording has no frames: {recording.path}")
    fps = options.export_hz or info.fps
    if info.fps % fps:
        divisors = ", ".join(str(n) for n in range(1, info.fps + 1) if info.fps % n == 0)
        raise OptionError("export_hz", f"is {fps}, which does not divide the recording's {info.fps}: use {divisors}.")
    stride = info.fps // fps
    rows = np.arange(0, trajectory.num_frames, stride)
    # Same as in the export: the target at the time of the next observation.
    sent = np.minimum(rows + stride - 1, trajectory.num_frames - 1)
    outcome = recording.outcome
    seen = [seen_in(observation_at(trajectory, int(row))) for row in rows]
    # Without physics, only the states that can be set and those that follow from them.
    compared = [n for n in seen[0] if not options.states or n in (JOINTS, OPENING, EE_POSE) or n.startswith(POSE_OF)]
    return Demonstration(
        name=recording.path.name,
        info=info,
        fps=fps,
        commands=tuple(action_at(trajectory, int(row), "command") for row in sent),
        compared={name: np.array([values[name] for values in seen]) for name in compared},
        outcome=outcome if outcome is None or stride == 1 else replace(outcome, final_state_digest=""),
        # Placing a body normalises its quaternion again.
        tolerance=1e-9 if options.states else 0.0,
        digest=recording.digest(),
        recorded=() if stride > 1 else tuple(frames_of(trajectory, recording.events(), recording.joint_samples())),
        gave_up=outcome is not None and gave_up(outcome, [event for _, event in recording.events()], info),
    )


def _sensed_here(info: EpisodeInfo) -> EpisodeInfo:
    """Leave out the sensors of a recording that this version does not simulate."""
    here = {sensor.quantity for sensor in SENSORS}
    unknown = [feature for quantity, feature in info.sensors.items() if quantity not in here]
    return replace(info, features=tuple(feature for feature in info.features if feature not in unknown))


def seen_in(observation: Observation) -> dict[str, Array]:
    """All sensed quantities: name -> (D,)."""
    return {
        JOINTS: observation.joint_position,
        OPENING: np.array([observation.gripper_width]),
        "joint velocities": observation.joint_velocity,
        "joint efforts": observation.joint_effort,
        "the contact force": np.array([observation.contact_force]),
        EE_POSE: observation.base_from_tcp.vector(),
        **{f"the {name}": values for name, values in observation.sensed.items()},
        **{f"{POSE_OF}{name}": pose.vector() for name, pose in observation.object_poses.items()},
    }


def open_file(path: Path, options: ReplayOptions) -> Demonstration:
    """Open a recording's file for replay; errors as in `open_demonstration` or, with a robot, `demonstration_of`."""
    if options.robot is not None:
        from demorec.extensions.remake.motion import motion_of_features

        with open_recording(path) as recording:
            if options.motors is not None:
                raise ConfigError(f"--motor-units is for datasets, recordings have units: {path}")
            if recording.info.simulation is not None:
                raise ConfigError(f"The recording has its own arm and scene: leave out --robot: {path}")
            info, table = recording.info, recording.table()
            motion = motion_of_features(table.features, info.features, info.fps, info.urdf, named=options.named)
        return demonstration_of(motion, options.robot, name=path.name, where=path, episode_index=info.episode_index)
    with open_simulated(path) as recording:
        return replace(open_demonstration(recording, options), source=path)


def dataset_demonstrations(
    path: Path, wanted: Callable[[int], bool], options: ReplayOptions
) -> Iterator[Demonstration]:
    """Yield the episodes of an exported dataset, with the scenes from its sidecar.

    Args:
        path: The dataset.
        wanted: Whether to yield the episode with a number.
        options: Options of the replay.

    Raises:
        ConfigError: The dataset has no sidecar of demorec or unknown actions, or the options do not apply to it; with a
        robot, as in `demonstration_of`.
        ExportError: It is damaged.
    """
    from demorec.check.dataset import CheckedDataset
    from demorec.extensions.remake.motion import motions_of_dataset

    if options.states or options.export_hz:
        raise ConfigError(
            "--states and --export-hz are for recordings: a dataset has no full states and a single rate."
        )
    dataset = CheckedDataset(path, motors=options.motors, named=options.named)
    if missing := dataset.missing:
        raise ExportError(missing)
    if bad := [problem for number, problem in dataset.unreadable.items() if wanted(number)]:
        raise ExportError(f"{bad[0]}, in {path}")
    if options.robot is not None:
        for number, motion in zip(dataset.numbers, motions_of_dataset(dataset), strict=False):
            if not wanted(number):
                continue
            name = f"{path.name}_episode_{number:06d}"
            yield demonstration_of(motion, options.robot, name=name, where=path, episode_index=number)
        return
    if not dataset.records:
        raise ConfigError(
            f"The dataset does not record its scenes (no demorec/episodes): --robot replays a real arm's actions: "
            f"{path}"
        )
    dataset.check_simulated()
    names = dataset.info.features[ACTION].names if ACTION in dataset.info.features else None
    for each in dataset.described():
        if not wanted(each.number):
            continue
        number, rows, row, info = each.number, each.rows, each.kept, each.info
        kind = next((kind for kind in get_args(ActionKind) if action_names(info.simulated.robot, kind) == names), None)
        if kind is None:
            raise ConfigError(f"The dataset's actions were not written by demorec and cannot be replayed: {path}")
        state, arm = rows[STATE].astype(np.float64), len(info.simulated.robot.arm_joints)
        yield Demonstration(
            name=f"{path.name}_episode_{number:06d}",
            info=info,
            fps=dataset.info.fps,
            actions=rows[ACTION].astype(np.float64),
            action_kind=kind,
            compared={JOINTS: state[:, :arm], OPENING: state[:, arm : arm + 1]},
            outcome=Outcome(success=bool(row["success"]), num_frames=len(state)),
            tolerance=1e-6,
            digest=str(row["content_digest"]),
        )


def demonstration_of(
    motion: RobotMotion | None, robot: RobotSpec, *, name: str, where: Path, episode_index: int
) -> Demonstration:
    """Prepare the actions of a real arm in an episode for a simulated arm of its kind.

    Args:
        motion: Motion in the episode; None without a state.
        robot: The simulated arm.
        name: Name of the demonstration.
        where: Its file or dataset, for messages.
        episode_index: Number of the episode.

    Raises:
        ConfigError: The joints of its state are not known to be the robot's, or some have no action.
    """
    from demorec.tasks.furniture import table_and_floor

    if motion is None or motion.action is None:
        raise ConfigError(
            f"No state and action with the same elements to replay (--state, --action name them): {where}"
        )
    state, action = (_of_robot(values, motion, robot, where) for values in (motion.state, motion.action))
    if np.isnan(action).any():
        raise ConfigError(f"Not every joint of {robot.name} has an action, so it cannot be replayed: {where}")
    count, fps = len(robot.arm_joints), round(motion.fps)
    hz = fps * math.ceil(_LEAST_HZ / fps)
    start = RobotPlacement(
        name=robot.name,
        world_from_base=Pose(),
        joint_position=tuple(state[0, :count].tolist()),
        gripper_width=float(state[0, count]),
    )
    physics = Physics(hz=hz)
    simulation = Simulation(
        root_seed=0,
        task="",
        robot=robot,
        scene=Scene(robot=start, bodies=table_and_floor(), physics=physics),
        physics_hz=hz,
    )
    info = simulated_info(
        simulation, episode_index=episode_index, instruction="", fps=fps, versions=deciding_versions()
    )
    return Demonstration(
        name=name,
        info=info,
        fps=fps,
        actions=action,
        action_kind="joint",
        compared={JOINTS: state[:, :count], OPENING: state[:, count:]},
        outcome=None,
        is_measured=True,
        digest=hashlib.sha256(state.tobytes() + action.tobytes()).hexdigest(),
    )


def _of_robot(values: Array, motion: RobotMotion, robot: RobotSpec, where: Path) -> Array:
    """Convert (T, D) of a motion to (T, n_arm + 1): positions of the arm's joints, rad, and opening of the
    gripper, m.
    """
    from demorec.datasets.lerobot.robots import IN_MOTOR_UNITS
    from demorec.extensions.remake.motion import GRIPPER

    fingers = robot.gripper.joints
    wanted = [*robot.arm_joints, *(() if GRIPPER in motion.names else fingers)]
    if missing := [joint for joint in wanted if joint not in motion.joints]:
        motors = ", or --motor-units is missing" if robot.name in IN_MOTOR_UNITS else ""
        raise ConfigError(
            f"The elements of the state ({', '.join(motion.names)}) are not known to be the joints "
            f"{', '.join(missing)} of {robot.name}: they belong to another robot{motors}: {where}"
        )
    arm = values[:, [motion.joints.index(joint) for joint in robot.arm_joints]]
    if GRIPPER in motion.names:
        return np.column_stack([arm, values[:, motion.names.index(GRIPPER)]])
    return np.column_stack([arm, robot.gripper.width(values[:, [motion.joints.index(joint) for joint in fingers]])])
