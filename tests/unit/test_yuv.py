"""Pictures as the coders take them, against libswscale's own conversion."""

from __future__ import annotations

import platform

import av
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from demorec.recording.video import coder_frame

Planes = list[NDArray[np.uint8]]

only_x86 = pytest.mark.skipif(
    platform.machine() not in ("x86_64", "AMD64"), reason="libswscale rounds otherwise on other machines"
)


def planes_of(frame: av.VideoFrame) -> Planes:
    """Brightness and colours, without what pads their rows."""
    width, height = frame.width, frame.height
    sizes = [(height, width), (-(-height // 2), -(-width // 2)), (-(-height // 2), -(-width // 2))]
    return [
        np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)[:h, :w].copy()
        for plane, (h, w) in zip(frame.planes, sizes, strict=True)
    ]


def judged(picture: NDArray[np.uint8]) -> Planes:
    return planes_of(av.VideoFrame.from_ndarray(picture, format="rgb24").reformat(format="yuv420p"))


@only_x86
@settings(max_examples=60, deadline=None)
@given(
    height=st.integers(4, 60).map(lambda half: 2 * half),
    width=st.integers(4, 80).map(lambda half: 2 * half),
    kind=st.sampled_from(("noise", "black and white", "one colour", "slope")),
    seed=st.integers(0, 2**32 - 1),
)
def test_the_same_bits_as_libswscale(height: int, width: int, kind: str, seed: int) -> None:
    picture = np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)
    if kind == "black and white":
        picture = np.where(picture < 128, 0, 255).astype(np.uint8)
    elif kind == "one colour":
        picture[:] = picture[0, 0]
    elif kind == "slope":
        picture = (np.indices((height, width)).sum(0)[..., None] * picture[0, 0].astype(int) % 256).astype(np.uint8)
    frame = coder_frame(picture)
    assert frame.format.name == "yuv420p"
    for found, expected in zip(planes_of(frame), judged(picture), strict=True):
        assert np.array_equal(found, expected)


@only_x86
def test_every_colour_has_the_brightness_that_libswscale_gives_it() -> None:
    red = np.arange(256, dtype=np.uint8)
    for blue in range(0, 256, 5):
        picture = np.empty((256, 256, 3), dtype=np.uint8)
        picture[..., 0], picture[..., 1], picture[..., 2] = red[:, None], red[None, :], blue
        for found, expected in zip(planes_of(coder_frame(picture)), judged(picture), strict=True):
            assert np.array_equal(found, expected)


def test_grey_has_no_colour_and_keeps_its_order() -> None:
    # BT.601 with 16 to 235: black, white and the neutral 128 of both colours.
    picture = np.repeat(np.linspace(0, 255, 32).round().astype(np.uint8)[None, :, None], 16, axis=0).repeat(3, axis=2)
    brightness, blueness, redness = planes_of(coder_frame(picture))
    assert (brightness[0, 0], brightness[0, -1]) == (16, 235)
    assert (np.diff(brightness[0].astype(int)) > 0).all()
    assert set(np.unique(np.concatenate([blueness, redness]))) == {128}


@pytest.mark.parametrize("shape", [(65, 66), (66, 65), (6, 64)])
def test_odd_and_very_short_sides_are_left_to_libswscale(shape: tuple[int, int]) -> None:
    assert coder_frame(np.zeros((*shape, 3), dtype=np.uint8)).format.name == "rgb24"


def test_pictures_that_are_cut_out_of_larger_ones() -> None:
    large = np.random.default_rng(0).integers(0, 256, (40, 60, 3), dtype=np.uint8)
    window = large[4:36, 10:50]
    for found, expected in zip(planes_of(coder_frame(window)), planes_of(coder_frame(window.copy())), strict=True):
        assert np.array_equal(found, expected)


@pytest.mark.parametrize(
    "picture", [np.zeros((32, 32, 3)), np.zeros((32, 32), np.uint8), np.zeros((32, 32, 4), np.uint8)]
)
def test_what_is_no_picture_is_refused(picture: NDArray[np.generic]) -> None:
    with pytest.raises(ValueError, match=r"."):
        coder_frame(picture)  # type: ignore[arg-type]
