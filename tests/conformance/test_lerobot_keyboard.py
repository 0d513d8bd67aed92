"""LeRobot's keyboard teleoperator drives the simulated SO-101: a scripted operator's key events do pick_place."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from support.keyboard import KeyboardOperator

from demorec.mcap import Recording
from lerobot_robot_demorec import DemorecPanda, DemorecPandaConfig, DemorecSO101, DemorecSO101Config


class Listener:
    """Of pynput, which needs a screen: hears what `press` is told."""

    def __init__(self, on_press: Any, on_release: Any) -> None:
        self.on_press, self.on_release, self._is_alive = on_press, on_release, False

    def start(self) -> None:
        self._is_alive = True

    def stop(self) -> None:
        self._is_alive = False

    def is_alive(self) -> bool:
        return self._is_alive

    def press(self, key: str, is_down: bool) -> None:
        (self.on_press if is_down else self.on_release)(SimpleNamespace(char=key))


@pytest.fixture
def teleoperator(monkeypatch: pytest.MonkeyPatch) -> Any:
    from lerobot.teleoperators.keyboard import KeyboardTeleop, KeyboardTeleopConfig
    from lerobot.teleoperators.keyboard import teleop_keyboard as module

    monkeypatch.setattr(module, "keyboard", SimpleNamespace(Key=SimpleNamespace(esc=None), Listener=Listener))
    monkeypatch.setattr(module, "PYNPUT_AVAILABLE", True)
    monkeypatch.setattr(module, "pynput_can_capture", lambda: True)
    monkeypatch.setattr(module, "require_package", lambda *args, **more: None)
    return KeyboardTeleop(KeyboardTeleopConfig())


class Done(Exception):
    """The operator has nothing more to do."""


def operated(teleoperator: Any, folder: Path, scene: int, monkeypatch: pytest.MonkeyPatch) -> bool:
    """Run LeRobot's loop of `lerobot-teleoperate` in a scene; whether the recording of it is a success."""
    from lerobot.processor import make_default_processors
    from lerobot.scripts import lerobot_teleoperate

    monkeypatch.setattr(lerobot_teleoperate, "precise_sleep", lambda seconds: None)
    home: Any = {"calibration_dir": folder / "calibration", "cameras": [], "record": folder / str(scene)}
    robot = DemorecSO101(DemorecSO101Config(**home, scene=scene))
    teleoperator.connect()
    robot.connect()
    operator = KeyboardOperator(robot, teleoperator.listener.press)
    see = robot.get_observation

    def look() -> dict[str, Any]:
        if not operator.look():
            raise Done
        return see()

    monkeypatch.setattr(robot, "get_observation", look)
    processors = dict(
        zip(
            ("teleop_action_processor", "robot_action_processor", "robot_observation_processor"),
            make_default_processors(),
            strict=True,
        )
    )
    with pytest.raises(Done):
        lerobot_teleoperate.teleop_loop(teleoperator, robot, 30, **processors)
    robot.disconnect()
    teleoperator.disconnect()
    with Recording(folder / str(scene) / "episode_000000.mcap") as recording:
        return bool(recording.success)


def test_keys_do_a_pick_place(teleoperator: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert operated(teleoperator, tmp_path, 0, monkeypatch)


@pytest.mark.slow
@pytest.mark.long
def test_keys_do_nineteen_of_twenty(teleoperator: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    done = [operated(teleoperator, tmp_path, scene, monkeypatch) for scene in range(20)]
    assert sum(done) >= 19


def test_increments_move_the_hand_along_the_base(tmp_path: Path) -> None:
    """As of LeRobot's gamepad: x forward, y to the left, z up; the hand keeps its direction, and stays in reach."""
    robot = DemorecPanda(DemorecPandaConfig(calibration_dir=tmp_path, cameras=[]))
    robot.connect()
    arm = robot._env.world.arm
    before = arm.world_from_tcp()
    for _ in range(15):
        robot.send_action({"delta_x": 0.0, "delta_y": 1.0, "delta_z": -1.0, "gripper": 0})
    for _ in range(10):
        robot.send_action({"delta_x": 0.0, "delta_y": 0.0, "delta_z": 0.0, "gripper": 1})
    after = arm.world_from_tcp()
    # 15 steps of 0.2 m/s at 30 Hz.
    assert after.position - before.position == pytest.approx([0.0, 0.1, -0.1], abs=0.003)
    assert after.rotation == pytest.approx(before.rotation, abs=0.02)
    assert arm.gripper_width() < 0.001
    for _ in range(300):
        robot.send_action({"delta_x": 1.0, "delta_y": 0.0, "delta_z": 0.0})
    assert 0.6 < arm.world_from_tcp().position[0] < 0.9
    robot.disconnect()
