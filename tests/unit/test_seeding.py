"""Streams are reproducible and independent of each other."""

from __future__ import annotations

import numpy as np

from demorec.core.seeding import PURPOSES, generator


def test_the_first_purposes_keep_their_place() -> None:
    """Recorded seeds depend on the position: new purposes may only be appended."""
    assert PURPOSES[:8] == ("scene", "expert", "noise", "looks", "perception", "cameras", "physics", "sampling")


def test_the_stream_is_numpys_seed_sequence() -> None:
    expected = np.random.Generator(np.random.PCG64(np.random.SeedSequence(7, spawn_key=(3, 1, 3)))).random(3)
    np.testing.assert_array_equal(
        generator(root_seed=7, episode_index=3, attempt=1, purpose="looks").random(3), expected
    )
