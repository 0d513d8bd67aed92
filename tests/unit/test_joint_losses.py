"""Damping and friction of a URDF's joints, against the solutions of I dv/dt = torque - damping v - friction sign(v)."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from demorec.core.geometry import Array
from demorec.episode.episode import Frame
from demorec.sim.client import connect
from demorec.sim.lossy_motors import JointMotors, drive
from demorec.testing import run_expert

EXAMPLE = Path(__file__).parents[2] / "examples" / "own_robot"
HZ = 240
INERTIA = 1.0 * (0.2**2 + 0.2**2) / 12
"""kg m^2, of a cube of 1 kg and 20 cm about its axis."""
CUBE = """<robot name="r">
  <link name="base"/>
  <link name="cube">
    <inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><geometry><box size="0.2 0.2 0.2"/></geometry></collision>
  </link>
  <joint name="turn" type="continuous"><parent link="base"/><child link="cube"/><axis xyz="0 0 1"/></joint>
</robot>"""


def speeds(tmp_path: Path, *, limit: float, damping: float, friction: float, start: float, target: float) -> Array:
    """Speeds of the cube, rad/s, at each step of a second; it starts at 0 rad with `start` rad/s."""
    urdf = tmp_path / "cube.urdf"
    urdf.write_text(CUBE)
    client: Any = connect()
    client.setPhysicsEngineParameter(fixedTimeStep=1 / HZ)
    body = client.loadURDF(str(urdf), useFixedBase=True)
    for link in (-1, 0):
        client.changeDynamics(body, link, linearDamping=0, angularDamping=0)
    client.resetJointState(body, 0, 0.0, start)
    values = ([limit], [np.inf], [0.2], [damping], [friction])
    motors = JointMotors((0,), *(np.array(value) for value in values))
    found = [start]
    for _ in range(HZ):
        drive(client, body, motors, np.array([target]))
        client.stepSimulation()
        found.append(client.getJointState(body, 0)[1])
    client.disconnect()
    return np.array(found)


TIME = np.arange(HZ + 1) / HZ


@pytest.mark.parametrize(
    ("damping", "friction", "solution"),
    [
        (0.02, 0.0, lambda t: np.exp(-0.02 * t / INERTIA)),
        (0.02, 0.01, lambda t: np.maximum(1.5 * np.exp(-0.02 * t / INERTIA) - 0.5, 0)),
        (20.0, 1.0, lambda t: np.maximum(1.05 * np.exp(-20 * t / INERTIA) - 0.05, 0)),  # 12 times a step's inertia
    ],
)
def test_an_unpowered_joint_slows_down_by_its_equation(
    damping: float, friction: float, solution: Callable[[Array], Array], tmp_path: Path
) -> None:
    found = speeds(tmp_path, limit=0.0, damping=damping, friction=friction, start=1.0, target=0.0)
    assert np.abs(found - solution(TIME)).max() < 0.005
    assert (np.diff(found) <= 1e-9).all()
    assert (found >= -1e-9).all()


def expert_frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arm: str, finger: str) -> tuple[Frame, ...]:
    """One episode of the documented arm, whose turning and sliding joints have these <dynamics>."""
    module = f"arms_{abs(hash((arm, finger)))}"
    folder = tmp_path / module
    shutil.copytree(EXAMPLE, folder)
    (folder / "my_robots.py").rename(folder / f"{module}.py")
    text = (folder / "xarm6.urdf").read_text()
    for kind, dynamics in (("revolute", arm), ("prismatic", finger)):
        text, count = re.subn(f'type="{kind}">', f'type="{kind}"><dynamics {dynamics}/>', text)
        assert count
    (folder / "xarm6.urdf").write_text(text)
    monkeypatch.syspath_prepend(str(folder))
    frames, outcome = run_expert("pick_place", f"{module}:XARM6", 0, 0)
    assert outcome.success, outcome
    return frames


@pytest.mark.slow
def test_motors_supply_the_losses_of_the_joints(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same motion needs additional torque for damping and friction, and no other force."""
    plain = expert_frames(tmp_path, monkeypatch, "", "")
    lossy = expert_frames(tmp_path, monkeypatch, 'damping="2" friction="0.5"', 'damping="10" friction="4"')
    pairs = list(zip(plain, lossy, strict=True))
    for joint in (3, 5):  # far from their limits, so that the motion is the same
        effort, more, speed = (
            np.array([getattr(pair[which].observation, name)[joint] for pair in pairs])
            for which, name in ((0, "joint_effort"), (1, "joint_effort"), (1, "joint_velocity"))
        )
        moves = np.abs(speed) > 0.05
        assert moves.sum() > 20
        wanted = effort + 2 * speed + 0.5 * np.sign(speed)
        assert np.median(np.abs(more - wanted)[moves]) < 0.02
    limits = np.array([50.0, 50.0, 32.0, 32.0, 32.0, 20.0, 20.0, 20.0])
    assert all((np.abs(frame.observation.joint_effort) <= limits + 1e-9).all() for frame in lossy)
    held = [np.median([f.observation.contact_force for f in run if f.phase == "transport"]) for run in (plain, lossy)]
    assert held == pytest.approx([40.0, 2 * (20 - 4)], rel=0.1)
