"""The decoder of actions: with limits for a policy, without them for recordings."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from support.sim import episode

from demorec.episode.features import ActionKind
from demorec.loop import make_world
from demorec.loop.actions import ActionDecoder
from demorec.sim.world import World


@pytest.fixture(scope="module")
def world() -> Iterator[World]:
    prepared = episode(0)
    with make_world(prepared.info) as made:
        made.reset(prepared.info.simulated.scene)
        yield made


@pytest.mark.parametrize("is_limited", [True, False])
@pytest.mark.parametrize("kind", ["ee", "ee_delta"])
def test_a_pose_out_of_reach_keeps_the_targets_and_is_counted(
    world: World, kind: ActionKind, *, is_limited: bool
) -> None:
    decoder = ActionDecoder(world, kind, is_limited=is_limited)
    away = [9.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.04] if kind == "ee" else [9.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.04]
    sent = decoder.command(np.array(away))
    assert decoder.num_unreachable == 1
    assert np.array_equal(sent.joint_target, world.arm.target)
    assert sent.gripper_target == 0.04


def test_after_a_pose_out_of_reach_a_policy_continues_from_its_pose(world: World) -> None:
    """The policy's next delta is small again; recorded deltas add up to recorded poses, even out of reach."""
    deltas = np.array([[9.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.04], [-0.01, 0.0, 0.0, 0.0, 0.0, 0.0, 0.04]])
    for is_limited, num_unreachable in ((True, 1), (False, 2)):
        decoder = ActionDecoder(world, "ee_delta", is_limited=is_limited)
        for delta in deltas:
            decoder.command(delta)
        assert decoder.num_unreachable == num_unreachable
