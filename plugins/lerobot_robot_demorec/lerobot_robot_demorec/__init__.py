"""demorec's simulated arms as robots of LeRobot, driven by its own commands with any of its teleoperators.

    lerobot-teleoperate --robot.type=demorec_so101 --robot.task=stack --fps=30 --teleop.type=so101_leader ...

LeRobot's `keyboard` reports the held keys, its `gamepad` increments of the hand; both move the hand. `lerobot-record`
writes the teleoperator's output, so it needs one with joint values.

Each action is one control step of 1/fps s, no matter how long it took to arrive. LeRobot has no command for a new
scene, so each connection has one scene; `--robot.record=DIR` writes it as an ordinary recording.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from lerobot.robots import Robot
from numpy.typing import NDArray

from demorec.api import (
    SO101_FOLLOWER,
    ConfigError,
    DemorecEnv,
    EpisodeWriter,
    Motors,
    Outcome,
    Pose,
    RobotSpec,
    state_names,
)
from lerobot_robot_demorec.config import DemorecPandaConfig, DemorecSO101Config, SimulatedArmConfig

__all__ = ["DemorecPanda", "DemorecPandaConfig", "DemorecSO101", "DemorecSO101Config"]


HAND = ("delta_x", "delta_y", "delta_z")
"""Increments of the hand from LeRobot's gamepad, along the axes of the base, x forward and y to the left, each from -1
to 1."""
CLOSE, OPEN = 0, 2
"""Its values for the gripper; 1 means no change."""
KEYS: Mapping[str, tuple[str, float]] = {
    "w": ("delta_x", 1.0),
    "s": ("delta_x", -1.0),
    "a": ("delta_y", 1.0),
    "d": ("delta_y", -1.0),
    "r": ("delta_z", 1.0),
    "f": ("delta_z", -1.0),
    "q": ("turn", 1.0),
    "e": ("turn", -1.0),
    "o": ("gripper", OPEN),
    "c": ("gripper", CLOSE),
}
"""Effect of a held key."""
HAND_SPEED, TURN_SPEED = 0.2, 1.0
"""Speeds of the hand: m/s for an arm of task_scale 1, and rad/s."""


class SimulatedArm(Robot):  # type: ignore[misc]
    """A row of `demorec list robots` in a scene of a task, with the states and actions of demorec's datasets."""

    row: ClassVar[str]
    """Name of the arm's row."""

    def __init__(self, config: SimulatedArmConfig) -> None:
        super().__init__(config)
        self.config = config
        self.cameras = dict.fromkeys(config.cameras)  # LeRobot counts them
        self._env = DemorecEnv(
            config.task,
            split="train",
            robot=self.row,
            seed=config.seed,
            variation=config.variation,
            cameras=tuple(config.cameras),
            width=config.width,
            height=config.height,
            fps=config.fps,
            privileged=False,
        )
        self._target: dict[str, float] = {}
        self._hand: Pose | None = None
        self._writer: EpisodeWriter | None = None

    @property
    def spec(self) -> RobotSpec:
        """The arm's spec."""
        return self._env.info.simulated.robot

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the elements of state and action."""
        return state_names(self.spec, "joint")

    def state_values(self, joint_position: NDArray[np.float64]) -> NDArray[np.float64]:
        """Convert (n_joints,) positions, rad and m, to (D,) values."""
        arm = len(self.spec.arm_joints)
        return np.append(joint_position[:arm], self.spec.gripper.width(joint_position[arm:]))

    def joint_targets(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Convert (D,) values to (n_arm + 1,) joint targets, rad, and opening, m."""
        return values

    @property
    def observation_features(self) -> dict[str, Any]:
        """See `Robot`."""
        size = (self.config.height, self.config.width, 3)
        return {**self.action_features, **dict.fromkeys(self.config.cameras, size)}

    @property
    def action_features(self) -> dict[str, Any]:
        """See `Robot`."""
        return dict.fromkeys(self.names, float)

    @property
    def is_connected(self) -> bool:
        """Whether a scene exists."""
        return bool(self._target)

    def connect(self, calibrate: bool = True) -> None:
        """Build the scene; SceneError if that fails."""
        del calibrate
        self._env.reset(seed=self.config.scene)
        self._target, self._hand = self._state(), None

    @property
    def is_calibrated(self) -> bool:
        """Always True."""
        return True

    def calibrate(self) -> None:
        """Do nothing."""

    def configure(self) -> None:
        """Do nothing."""

    def get_observation(self) -> dict[str, Any]:
        """Return the current state and images."""
        images = self._env.situation.images
        return {**self._state(), **{name: found.color for name, found in images.items()}}

    def send_action(self, action: dict[str, Any]) -> dict[str, float]:
        """Move towards the action for one control step; missing elements keep their targets. Returns the values sent.

        Raises:
            ConfigError: The action has no element of this arm.
        """
        if all(value is None for value in action.values()):  # keys, or none
            action = dict.fromkeys(HAND, 0.0) | dict(KEYS[key] for key in action if key in KEYS)
        if set(HAND) <= action.keys():
            action = self._moved(action)
        if not action.keys() & set(self.names):
            raise ConfigError(
                f"The teleoperator sends {', '.join(map(str, action)) or 'nothing'}, but the arm takes "
                f"{', '.join(self.names)}: choose one for this arm."
            )
        self._target |= {name: float(action[name]) for name in self.names if name in action}
        *_, about = self._env.step(self.joint_targets(np.array([self._target[name] for name in self.names])))
        self._record()
        command = about["command"]
        joints = np.append(command[:-1], self.spec.gripper.joint_position(command[-1]))
        return self._named(self.state_values(joints))

    def disconnect(self) -> None:
        """Finish the recording and free the simulator."""
        if self._writer is not None:
            checks = self._env.situation.checks
            failed = [check.name for check in checks if not check.passed]
            self._writer.finish(
                Outcome(
                    success=not failed,
                    checks=checks,
                    failure_reason=failed[0] if failed else "",
                    num_frames=self._env.situation.frame_index,
                    final_state_digest=self._env.world.state_digest(),
                )
            )
            self._writer = None
        self._target = {}
        self._env.close()

    def _moved(self, action: dict[str, Any]) -> dict[str, float]:
        """Compute the joints that move the hand by an increment at constant orientation; out of reach, it stays."""
        arm, gripper = self._env.world.arm, self.spec.gripper
        hand = self._hand or arm.kinematics.forward(arm.target)
        way = np.array([float(action[name]) for name in HAND]) * (HAND_SPEED * self.spec.task_scale / self.config.fps)
        turn = Pose.from_yaw((0.0, 0.0, 0.0), float(action.get("turn", 0.0)) * TURN_SPEED / self.config.fps)
        moved = Pose(position=hand.position + way, quat_xyzw=(turn @ hand).quat_xyzw)
        rest = arm.kinematics.turned_towards(np.array(self.spec.home_q), moved.position)
        joints = arm.kinematics.inverse(moved, start=arm.target, rest=rest)
        self._hand = hand if joints is None else moved
        width = {CLOSE: gripper.min_width, OPEN: gripper.open_width}.get(action.get("gripper", 1), arm.gripper_target)
        fingers = gripper.joint_position(width)
        return self._named(self.state_values(np.append(arm.target if joints is None else joints, fingers)))

    def _state(self) -> dict[str, float]:
        return self._named(self.state_values(self._env.situation.observation.joint_position))

    def _named(self, values: NDArray[np.float64]) -> dict[str, float]:
        return dict(zip(self.names, values.tolist(), strict=True))

    def _record(self) -> None:
        """Write the frame of the last step, the first of a scene to a new file."""
        frame = self._env.situation.last_frame
        if self.config.record is None or frame is None:
            return
        if self._writer is None:
            info = replace(self._env.info, origin="teleoperation by LeRobot")
            self._writer = EpisodeWriter(_free_place(self.config.record), info, video=self._env.config.video)
        self._writer.write(frame)


class DemorecSO101(SimulatedArm):
    """The SO-101 in the units of LeRobot's `so101_follower`, with the calibration of `--robot.id` if it exists."""

    config_class = DemorecSO101Config
    name = "demorec_so101"
    row = "so101"

    @cached_property
    def motors(self) -> Motors:
        """The servos of the real arm; ConfigError if the calibration belongs to another arm."""
        own = self.calibration_fpath if self.calibration_fpath.is_file() else None
        return SO101_FOLLOWER.motors("degrees" if self.config.use_degrees else "range_m100_100", own)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """See `SimulatedArm`; names of the real arm."""
        return self.motors.names

    def state_values(self, joint_position: NDArray[np.float64]) -> NDArray[np.float64]:
        """Convert (6,) positions, rad, to (6,) values."""
        return np.asarray(self.motors.values(joint_position[np.newaxis])[0])

    def joint_targets(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Convert (6,) values to (6,) joint targets, rad, and opening, m."""
        factor, offset = np.array(self.motors.to_positions).T
        position = values * factor + offset
        return np.append(position[:-1], self.spec.gripper.width(position[-1:]))


class DemorecPanda(SimulatedArm):
    """The Panda: joints in rad, the opening in metres, as in demorec's datasets."""

    config_class = DemorecPandaConfig
    name = "demorec_panda"
    row = "panda"


def _free_place(folder: Path) -> Path:
    """Choose the next episode's file in a folder, which is created if missing."""
    folder.mkdir(parents=True, exist_ok=True)
    number = 0
    while (path := folder / f"episode_{number:06d}.mcap").exists():
        number += 1
    return path
