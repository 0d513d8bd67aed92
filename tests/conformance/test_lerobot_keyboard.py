"""LeRobot's keyboard and gamepad teleoperators move the hand of the simulated arms."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from lerobot_robot_demorec import DemorecPanda, DemorecPandaConfig, DemorecSO101, DemorecSO101Config


class Listener:
    """A stand-in for pynput's listener, which needs a screen; it receives the keys given to `press`."""

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


@pytest.mark.parametrize(("key", "axis", "sign"), [("w", 0, 1), ("s", 0, -1), ("a", 1, 1), ("r", 2, 1)])
def test_a_held_key_moves_the_hand(key: str, axis: int, sign: int, teleoperator: Any, tmp_path: Path) -> None:
    robot = DemorecSO101(DemorecSO101Config(calibration_dir=tmp_path, cameras=[]))
    teleoperator.connect()
    robot.connect()
    arm = robot._env.world.arm
    before = arm.world_from_tcp().position
    teleoperator.listener.press(key, True)
    for _ in range(10):
        robot.send_action(teleoperator.get_action())
    teleoperator.listener.press(key, False)
    moved = arm.world_from_tcp().position - before
    assert sign * moved[axis] > 0.01
    assert np.abs(np.delete(moved, axis)).max() < abs(moved[axis]) / 2
    robot.disconnect()
    teleoperator.disconnect()


@pytest.mark.slow
def test_increments_move_the_hand_along_the_base(tmp_path: Path) -> None:
    """As with LeRobot's gamepad: x forward, y to the left, z up; the hand keeps its orientation and stays in reach."""
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
