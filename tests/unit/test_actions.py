"""The decoder of actions: with limits for a policy, without them for recordings."""

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
    """The policy's next delta is small again; recorded deltas add up to recorded poses, even out of reach."""
    deltas = np.array([[9.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.04], [-0.01, 0.0, 0.0, 0.0, 0.0, 0.0, 0.04]])
    for is_limited, num_unreachable in ((True, 1), (False, 2)):
        decoder = ActionDecoder(world, "ee_delta", is_limited=is_limited)
        sent = decoder.command(deltas[0])
        assert np.array_equal(sent.joint_target, world.arm.target)
        assert (sent.gripper_target, decoder.num_unreachable) == (0.04, 1)
        decoder.command(deltas[1])
        assert decoder.num_unreachable == num_unreachable
