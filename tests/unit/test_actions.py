"""The decoder of a policy's actions."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from support.sim import episode

from demorec.loop import make_world
from demorec.loop.actions import ActionDecoder
from demorec.sim.world import World


@pytest.fixture(scope="module")
def world() -> Iterator[World]:
    prepared = episode(0)
    with make_world(prepared.info) as made:
        made.reset(prepared.info.simulated.scene)
        yield made


def test_a_pose_out_of_reach_keeps_the_targets_and_a_policy_continues_from_there(world: World) -> None:
    deltas = np.array([[9.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.04], [-0.01, 0.0, 0.0, 0.0, 0.0, 0.0, 0.04]])
    decoder = ActionDecoder(world, "ee_delta")
    sent = decoder.command(deltas[0])
    assert np.array_equal(sent.joint_target, world.arm.target)
    assert sent.gripper_target == 0.04
    moved = decoder.command(deltas[1]).base_from_tcp_target.position - sent.base_from_tcp_target.position
    assert moved == pytest.approx([-0.01, 0.0, 0.0], abs=1e-4)
