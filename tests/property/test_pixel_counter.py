"""Both ways of counting pixels give what counting one by one gives."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from demorec.mcap.pictures import PixelCounter


@pytest.mark.parametrize("compiled", [False, True])
@settings(deadline=None, max_examples=30)
@given(
    height=st.integers(1, 40),
    width=st.sampled_from([1, 7, 299, 300, 640]),
    num_pictures=st.integers(1, 10),
    seed=st.integers(0, 1000),
)
def test_counts_are_those_of_the_documented_pixels(
    compiled: bool, height: int, width: int, num_pictures: int, seed: int
) -> None:
    pictures = np.random.default_rng(seed).integers(0, 256, (num_pictures, height, width, 3), dtype=np.uint8)
    counter = PixelCounter(compiled=compiled)
    for picture in pictures:
        counter.add(picture)
    found = counter.statistics()

    step = {299: 1, 300: 2, 640: 4}.get(width, 1)  # LeRobot's: the longer side // 150, from 300 on
    counted = pictures[::2]
    expected = [Counter[int](), Counter[int](), Counter[int]()]
    for number, picture in enumerate(counted.tolist()):
        for row in range(step * (number % 4), height, 4 * step):
            for pixel in picture[row][::step]:
                for channel, value in zip(expected, pixel, strict=True):
                    channel[value] += 1
    assert found.num_images == len(counted)
    assert found.counts.tolist() == [[channel[value] for value in range(256)] for channel in expected]
