"""Datasets in the forms of LeRobot's recorder and other tools, made without demorec."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from support.doctor_motion import ArmModel, Array, Motion, demonstrate
from support.doctor_render import Shot, front_camera, wrist_camera

Images = Callable[[], NDArray[np.uint8]]
"""Draws the (T, H, W, 3) images of one episode by one camera."""
Columns = dict[str, Array]


@dataclass(frozen=True, kw_only=True)
class DatasetBase:
    """A convention of third-party recordings.

    Attributes:
        name: Key in `BASES`.
        version: Version of LeRobot's format, "v2.1" or "v3.0".
        state, action: Names of the features.
        robot: `robot_type` in info.json.
        arms: Arms of the robot; the second one rests.
        columns: Maps the motions of all arms to features, (T, D) each.
        features: Feature -> element names.
        grippers: Elements of the state and of the action that are grippers.
        is_delta: Whether the action is a displacement.
        pace: Factor on the operator's durations.
    """

    name: str
    version: str
    fps: int
    robot: str
    arms: tuple[ArmModel, ...]
    columns: Callable[[list[Motion]], Columns]
    features: Mapping[str, tuple[str, ...]]
    cameras: tuple[str, ...] = ()
    state: str = "observation.state"
    action: str = "action"
    grippers: tuple[int, int] = (-1, -1)
    is_delta: bool = False
    pace: float = 1.0
    tasks: tuple[str, ...] = ("Put the red cube on the plate", "Put the red cube into the left tray")

    def feature(self, name: str) -> str:
        """Name of the feature; "state" and "action" stand for those of the base."""
        return {"state": self.state, "action": self.action}.get(name, name)


@dataclass(kw_only=True)
class DemoEpisode:
    """One episode before it is written.

    Attributes:
        columns: Feature -> (T, D).
        time_s: (T,) timestamps.
        images: Camera -> how its images are drawn.
    """

    columns: Columns
    time_s: Array
    task: str
    images: dict[str, Images] = field(default_factory=dict)


@dataclass(kw_only=True)
class DemoDataset:
    """A dataset before it is written; `seed` is that of its recording."""

    base: DatasetBase
    episodes: list[DemoEpisode]
    seed: int


def record(
    base: DatasetBase,
    seed: int,
    episodes: int,
    *,
    spoilt: Mapping[int, str] | None = None,
    cameras: bool = True,
) -> DemoDataset:
    """Record a dataset; `spoilt` has the kinds of faulty episodes; the others are sound."""
    shared = np.random.default_rng((seed, len(base.name)))
    pace, table = base.pace * shared.uniform(0.85, 1.2), int(shared.integers(2**31))
    found = []
    for number in range(episodes):
        rng = np.random.default_rng((seed, len(base.name), number))
        motions = [demonstrate(rng, base.arms[0], base.fps, pace, spoilt=(spoilt or {}).get(number, ""))]
        motions += [_resting(rng, arm, len(motions[0].state)) for arm in base.arms[1:]]
        shot = Shot(motion=motions[0], arm=base.arms[0], table=table, seed=int(rng.integers(2**31)))
        images = {camera: _drawn(camera, shot) for camera in (base.cameras if cameras else ())}
        found.append(
            DemoEpisode(
                columns=base.columns(motions),
                time_s=np.arange(len(motions[0].state)) / base.fps,
                task=base.tasks[number % len(base.tasks)],
                images=images,
            )
        )
    return DemoDataset(base=base, episodes=found, seed=seed)


def _drawn(camera: str, shot: Shot) -> Images:
    return lambda: wrist_camera(shot) if "wrist" in camera else front_camera(shot)


def _resting(rng: np.random.Generator, arm: ArmModel, length: int) -> Motion:
    """Motion of a parked arm: its encoders sometimes flicker by a tick, and its leader is parked a few ticks away."""
    home = np.array(arm.home)
    ticks = np.array([arm.tick[0]] * (len(home) - 1) + [arm.tick[1]])
    flicker = (rng.random((length, len(home))) < 0.02 * (rng.random(len(home)) < 0.5)) * ticks
    command = arm.readings(np.tile(home, (length, 1)) + rng.normal(0, 4, len(home)) * ticks)
    state = arm.readings(np.tile(home, (length, 1))) + flicker
    return Motion(command=command, state=state, true=state, thing=np.zeros((length, 3)))


def _absolute(state: str, action: str) -> Callable[[list[Motion]], Columns]:
    def columns(motions: list[Motion]) -> Columns:
        return {
            state: np.concatenate([motion.state for motion in motions], axis=1),
            action: np.concatenate([motion.command for motion in motions], axis=1),
        }

    return columns


def _delta_columns(motions: list[Motion]) -> Columns:
    """A pose with a quaternion (x, y, z, w), and a 3-D mouse's displacement: 1 is 5 cm or 0.25 rad a frame."""
    (motion,) = motions
    steps = np.diff(motion.command[:, :6], axis=0, append=motion.command[-1:, :6]) / ([0.05] * 3 + [0.25] * 3)
    steps = np.clip(np.round(steps * 350) / 350, -1, 1)
    grip = np.where(motion.command[:, 6:] < 0.06, 1.0, -1.0)
    pose = np.concatenate(
        [motion.state[:, :3], Rotation.from_euler("xyz", motion.state[:, 3:6]).as_quat(), motion.state[:, 6:]], axis=1
    )
    return {"observation.state": pose, "action": np.concatenate([steps, grip], axis=1)}


def _panda_columns(motions: list[Motion]) -> Columns:
    """Joint positions, velocities and the flange's pose; the commands of a planner's smooth trajectory."""
    (motion,) = motions
    velocity = np.gradient(motion.true[:, :7], axis=0) * 50
    velocity += np.random.default_rng(len(velocity)).normal(0, 2e-3, velocity.shape)
    return {
        "observation.state": motion.state,
        "observation.velocity": velocity,
        "observation.ee_pose": panda_poses(motion.state[:, :7]),
        "action": motion.command,
    }


def panda_poses(joints: Array) -> Array:
    """(T, 7) positions and quaternions (x, y, z, w) of a Panda's flange, by the vendor's table of link parameters."""
    links = ((0, 0.333, 0), (0, 0, -1), (0, 0.316, 1), (0.0825, 0, 1), (-0.0825, 0.384, -1), (0, 0, 1), (0.088, 0, 1))
    pose = np.tile(np.eye(4), (len(joints), 1, 1))
    for (a, d, quarter), angle in zip(links, joints.T, strict=True):
        c, s, zero = np.cos(angle), np.sin(angle), np.zeros(len(joints))
        flat, side, one = zero + (quarter == 0), zero + quarter, zero + 1
        link = [
            [c, -s, zero, zero + a],
            [s * flat, c * flat, -side, -d * side],
            [s * side, c * side, flat, d * flat],
            [zero, zero, zero, one],
        ]
        pose = pose @ np.moveaxis(np.array(link), -1, 0)
    flange = pose[:, :3, 3] + 0.107 * pose[:, :3, 2]
    found = Rotation.from_matrix(pose[:, :3, :3]).as_quat()
    turned = np.cumprod(np.sign((found[1:] * found[:-1]).sum(1)))
    found[1:] *= turned[:, None]
    return np.concatenate([flange, found], axis=1)


_SO101 = ("shoulder_pan.pos", "shoulder_lift.pos", "elbow_flex.pos", "wrist_flex.pos", "wrist_roll.pos", "gripper.pos")
_SO101_REACH = np.array([[-22, 10, 4, 5, 14], [4, 45, -30, 24, 9], [2, -35, 10, -22, 3]], float)
_TICK_DEG = 360 / 4096
_VIPERX = ("waist", "shoulder", "elbow", "forearm_roll", "wrist_angle", "wrist_rotate", "gripper")
_TICK_RAD = 2 * np.pi / 4096
_PANDA = (*(f"panda_joint{number}" for number in range(1, 8)), "gripper")


def _rows(array: Array) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(float(value) for value in row) for row in array)


def _so101(scale: Array, home: tuple[float, ...], **more: Any) -> ArmModel:
    """An SO-101 with elements in degrees times `scale`."""
    return ArmModel(
        names=_SO101, home=home, reach=_rows(_SO101_REACH * scale), grip=(40.0, 2.0, 18.0), tick=(0.088, 0.067),
        delay_s=0.06, lag_s=0.07, dead_band=0.9, sag=4.0, noise=0.02, tremor=0.12, **more,
    )  # fmt: skip


_DEGREES = _so101(np.ones(5), (0, -60, 60, 30, -50, 2.0))
_NORMALISED = _so101(np.array([0.9, 1.0, 1.05, 1.0, 0.6]), (-4, -55, 62, 35, -58, 2.0), limits=(-100, 100))
_ALOHA_REACH = np.array(
    [[-0.4, 0.1, 0.05, 0.15, 0.05, 0.1], [0.05, 0.55, -0.5, 0.02, 0.2, 0.05], [0.02, -0.4, 0.3, 0.03, -0.25, 0.04]]
)
_LEFT = ArmModel(
    names=tuple(f"left_{name}" for name in _VIPERX), home=(0.0, -0.9, 1.1, 0.0, -0.3, 0.0, 0.05),
    reach=_rows(_ALOHA_REACH), grip=(0.95, 0.05, 0.45), tick=(_TICK_RAD, 0.002), delay_s=0.04, lag_s=0.04,
    dead_band=0.004, sag=0.03, noise=4e-4, tremor=2e-3,
)  # fmt: skip
_RIGHT = replace(_LEFT, names=tuple(f"right_{name}" for name in _VIPERX), home=(0.0, -1.8, 1.6, 0.0, -0.3, 0.0, 0.05))
_HAND = ArmModel(
    names=("x", "y", "z", "roll", "pitch", "yaw", "gripper"), home=(0.45, 0.0, 0.12, 3.05, 0.05, 0.0, 0.0),
    reach=((0.02, -0.16, 0.0, 0.03, 0.02, 0.35), (0.12, 0.02, 0.0, 0.04, 0.06, 0.1), (0.0, 0.0, 0.2, 0.02, 0.03, 0.05)),
    grip=(0.08, 0.0, 0.045), delay_s=0.1, lag_s=0.1, noise=2e-4, tremor=5e-4,
)  # fmt: skip
_KOCH = replace(_DEGREES, home=(5, 100, 120, -20, 8, 5.0), reach=_rows(-1.2 * _SO101_REACH), grip=(60.0, 3.0, 25.0))
_PANDA_ARM = ArmModel(
    names=_PANDA, home=(0.0, -0.5, 0.0, -2.3, 0.0, 1.8, 0.78, 0.0), delay_s=0.02, lag_s=0.04, noise=2e-5,
    reach=((-0.5, 0.08, -0.1, 0.05, 0.06, 0.04, -0.3), (0.05, 0.35, 0.04, 0.35, 0.02, 0.1, 0.05),
           (0.02, -0.25, 0.03, 0.15, 0.02, -0.3, 0.03)),
    grip=(0.08, 0.0, 0.045), tremor=4e-4,
)  # fmt: skip
FRONT, WRIST = "observation.images.front", "observation.images.wrist"
_TWO_ARMS = (*_LEFT.names, *_RIGHT.names)
_POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")

BASES = {
    base.name: base
    for base in (
        DatasetBase(
            name="degrees", version="v3.0", fps=30, robot="so101_follower", arms=(_DEGREES,),
            columns=_absolute("observation.state", "action"), cameras=(FRONT, WRIST),
            features={"observation.state": _SO101, "action": _SO101},
        ),
        DatasetBase(
            name="normalised", version="v2.1", fps=30, robot="so100", arms=(_NORMALISED,),
            columns=_absolute("observation.state", "action"), cameras=(FRONT,),
            features={"observation.state": _SO101, "action": _SO101},
        ),
        DatasetBase(
            name="two arms", version="v3.0", fps=50, robot="aloha", arms=(_LEFT, _RIGHT), grippers=(6, 6),
            columns=_absolute("observation.state", "action"),
            features={"observation.state": _TWO_ARMS, "action": _TWO_ARMS},
        ),
        DatasetBase(
            name="delta", version="v2.1", fps=10, robot="franka", arms=(_HAND,), is_delta=True,
            columns=_delta_columns, cameras=(FRONT, WRIST), pace=1.3,
            features={
                "observation.state": (*_POSE, "gripper"),
                "action": ("delta_x", "delta_y", "delta_z", "delta_roll", "delta_pitch", "delta_yaw", "gripper"),
            },
        ),
        DatasetBase(
            name="openpi", version="v2.1", fps=10, robot="koch", arms=(_KOCH,), state="state", action="actions",
            columns=_absolute("state", "actions"), features={"state": _SO101, "actions": _SO101},
        ),
        DatasetBase(
            name="panda", version="v3.0", fps=50, robot="panda", arms=(_PANDA_ARM,), columns=_panda_columns,
            features={
                "observation.state": _PANDA, "observation.velocity": _PANDA[:7], "observation.ee_pose": _POSE,
                "action": _PANDA,
            },
        ),
    )
}  # fmt: skip
"""Conventions of third-party recordings by name."""
