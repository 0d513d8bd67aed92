"""Damping and friction of a URDF's joints: the motors supply them, up to their limits."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from demorec.episode.episode import Frame
from demorec.testing import run_expert

EXAMPLE = Path(__file__).parents[2] / "examples" / "own_robot"


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
