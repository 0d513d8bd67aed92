"""Episodes: aligned, bounded, replayable, and a function of the plan alone."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from support.sim import episode, run

from demorec.core.plain import to_json
from demorec.core.tables import ROBOTS
from demorec.episode.episode import Frame, Outcome
from demorec.loop import PreparedEpisode, make_world


@pytest.fixture(scope="module")
def ran() -> tuple[PreparedEpisode, list[Frame], Outcome]:
    prepared = episode(4)
    frames, outcome = run(prepared)
    return prepared, frames, outcome


def test_observation_comes_before_the_action(ran: tuple[PreparedEpisode, list[Frame], Outcome]) -> None:
    """The joints follow the command of frame t only at frame t + 1."""
    _, frames, _ = ran
    commands = np.array([frame.command.joint_target for frame in frames])
    joints = np.array([frame.observation.joint_position[:7] for frame in frames])
    follows = np.abs(joints[1:] - commands[:-1]).mean()
    equal = np.abs(joints - commands).mean()
    assert follows < 0.5 * equal


def test_noise_is_on_the_command_only_and_only_in_free_motion(
    ran: tuple[PreparedEpisode, list[Frame], Outcome],
) -> None:
    _, frames, _ = ran
    noise: dict[str, list[float]] = {phase: [] for phase in {frame.phase for frame in frames}}
    for frame in frames:
        noise[frame.phase].append(np.abs(frame.command.joint_target - frame.action.joint_target).max())
    assert np.mean(noise["approach"]) > 0.005
    assert np.mean(noise["transport"]) > 0.003
    # Switched off by a ramp: the remaining noise decays within a few frames.
    for phase in ("close", "lift", "release"):
        assert max(noise[phase]) < 0.001, phase


def test_no_frame_is_idle(ran: tuple[PreparedEpisode, list[Frame], Outcome]) -> None:
    _, frames, _ = ran
    # Neither the label nor the executed command moves.
    labels = np.array([[*f.action.joint_target, *f.command.joint_target, f.action.gripper_target] for f in frames])
    still = np.abs(np.diff(labels, axis=0)).max(axis=1) < 1e-12
    outside_of_gripping = [
        s for s, frame in zip(still, frames, strict=False) if frame.phase not in ("close", "release")
    ]
    assert sum(outside_of_gripping) <= 0.06 * len(frames)


@pytest.mark.slow
def test_images_do_not_disturb_the_physics() -> None:
    _, without = run(episode(4, max_episode_seconds=1.0))
    frames, outcome = run(episode(4, max_episode_seconds=1.0, cameras=("front",), width=32, height=32, renderer="tiny"))
    assert outcome.final_state_digest == without.final_state_digest
    assert frames[0].images["front"].color.shape == (32, 32, 3)


PRINT_DIGEST = """
import json, sys
from support.sim import episode, run
from demorec.core.plain import to_json
prepared = episode(4)
frames, outcome = run(prepared)
print(json.dumps([outcome.final_state_digest, to_json(prepared.info)]))
"""


@pytest.mark.parametrize("coretype", ["Haswell", pytest.param("Nehalem", marks=pytest.mark.slow)])
def test_another_process_and_another_blas_kernel_give_the_same_bits(
    ran: tuple[PreparedEpisode, list[Frame], Outcome], coretype: str
) -> None:
    prepared, _, outcome = ran
    path = str(Path(__file__).parents[1])
    env = {**os.environ, "PYTHONPATH": path, "PYTHONHASHSEED": "7", "OPENBLAS_CORETYPE": coretype}
    result = subprocess.run(
        [sys.executable, "-c", PRINT_DIGEST], env=env, capture_output=True, text=True, timeout=240, check=False
    )
    if result.returncode == -4:
        pytest.skip(f"this CPU cannot run {coretype} code")
    assert result.returncode == 0, result.stderr
    digest, info = json.loads(result.stdout)
    assert digest == outcome.final_state_digest
    assert info == to_json(prepared.info)


def test_a_stuck_episode_ends_as_a_failure_with_its_phase() -> None:
    frames, outcome = run(episode(4, max_episode_seconds=2.0))
    assert len(frames) == 60
    assert not outcome.success
    assert outcome.failure_reason == "time_limit"
    assert outcome.failure_phase == frames[-1].phase


def test_joint_samples_at_the_physics_rate() -> None:
    frames, _ = run(episode(4, joint_rate="physics", max_episode_seconds=1.0))
    assert frames[0].joint_samples == ()
    assert all(len(frame.joint_samples) == 7 for frame in frames[1:])
    times = [t for frame in frames[1:] for t in (*(s.time_ns for s in frame.joint_samples), frame.time_ns)]
    assert np.abs(np.diff(times) - 1e9 / 240).max() <= 1


@pytest.mark.slow
@pytest.mark.parametrize("robot", ROBOTS.names())
def test_recorded_commands_replay_to_the_bit_in_a_used_world(robot: str) -> None:
    prepared = episode(3, robot=robot, variation="full")
    with make_world(prepared.info) as world:
        run(episode(4, robot=robot, variation="full", max_episode_seconds=2.0), world)
        frames, outcome = run(prepared, world)
        world.reset(prepared.info.simulated.scene)
        for frame in frames:
            assert world.observe().object_poses == frame.observation.object_poses
            world.apply(frame.command)
        assert world.state_digest() == outcome.final_state_digest
