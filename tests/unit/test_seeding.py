"""Streams are reproducible and independent of each other."""

from __future__ import annotations

import itertools

import numpy as np

from demorec.core.seeding import PURPOSES, generator


def test_the_first_purposes_keep_their_place() -> None:
    """Recorded seeds depend on the position: new purposes may only be appended."""
    assert PURPOSES[:8] == ("scene", "expert", "noise", "looks", "perception", "cameras", "physics", "sampling")


def test_same_key_same_numbers_other_key_other_numbers() -> None:
    keys = list(itertools.product((0, 1), (0, 1, 2), (0, 1), PURPOSES))
    drawn = {
        key: generator(root_seed=key[0], episode_index=key[1], attempt=key[2], purpose=key[3]).random(4).tobytes()
        for key in keys
    }
    assert len(set(drawn.values())) == len(keys)
    again = generator(root_seed=1, episode_index=2, attempt=1, purpose="looks").random(4).tobytes()
    assert again == drawn[(1, 2, 1, "looks")]


def test_the_stream_is_numpys_seed_sequence() -> None:
    expected = np.random.Generator(np.random.PCG64(np.random.SeedSequence(7, spawn_key=(3, 1, 0)))).random(3)
    np.testing.assert_array_equal(
        generator(root_seed=7, episode_index=3, attempt=1, purpose="scene").random(3), expected
    )
