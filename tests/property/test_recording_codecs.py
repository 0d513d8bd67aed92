"""Depth, labels, messages and shapes: lossless inverses, and errors for damage."""

from __future__ import annotations

import contextlib
import io
import struct
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from PIL import Image

from demorec.core.errors import RecordingError
from demorec.core.geometry import Pose
from demorec.episode.scene import Body, Shape
from demorec.mcap.cdr import decode
from demorec.mcap.description import body_description
from demorec.mcap.lossless import LabelDecoder, decode_millimetres, encode_depth, encode_labels
from demorec.mcap.ros2 import DEFINITIONS
from demorec.robots.urdf import read_links

images = hnp.array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=24)


@settings(max_examples=60)
@given(
    hnp.arrays(
        np.uint16, images, elements=st.one_of(st.just(0), st.integers(1, 12), st.integers(0, 65535)), fill=st.just(0)
    )
)
def test_depth_is_exact_to_the_millimetre(millimetres: np.ndarray[Any, Any]) -> None:
    metres = (millimetres / np.float32(1000)).astype(np.float32)
    decoded = decode_millimetres(encode_depth(metres), (metres.shape[0], metres.shape[1]))
    assert np.array_equal(decoded, millimetres)


def test_depth_beyond_its_range_counts_as_nothing_hit() -> None:
    metres = np.array([[np.nan, np.inf, -1.0, 65.6, 65.535, 0.0004, 0.0006, 1.2345]], dtype=np.float32)
    found = decode_millimetres(encode_depth(metres), (1, 8))
    assert found.tolist() in ([[0, 0, 0, 0, 65535, 0, 1, 1234]], [[0, 0, 0, 0, 65535, 0, 1, 1235]])


def test_depth_is_rvl_of_the_paper() -> None:
    """An image small enough to be encoded by hand.

    Runs 0 and 2, pixels 5 and 3 (differences 5 and -2, zigzag 10 and 3), then runs 2 and 0. Groups of three bits, with
    the continuation bit above them: 0, 2, 10 = 010 001 -> A 1, 3, 2, 0.
    """
    data = encode_depth(np.array([[0.005, 0.003, 0.0, 0.0]], dtype=np.float32))
    assert data[:12] == bytes(12)
    assert struct.unpack("<ii", data[12:20]) == (4, 1)
    assert data[20:] == struct.pack("<I", 0x02A13200)


@settings(max_examples=60)
@given(
    hnp.arrays(np.int32, images, elements=st.integers(0, 254)),
    hnp.arrays(np.int32, (24, 24), elements=st.integers(-1, 254)),
)
def test_labels(bodies: np.ndarray[Any, Any], links: np.ndarray[Any, Any]) -> None:
    height, width = bodies.shape
    values = np.where(links[:height, :width] == 7, -1, bodies + ((links[:height, :width] + 1) << 24 & 0x7F000000))
    values = values.astype(np.int32)
    assert np.array_equal(LabelDecoder((height, width)).decode(encode_labels(values)), values)


def test_too_many_bodies_for_labels() -> None:
    with pytest.raises(RecordingError, match="limited to 255 bodies"):
        encode_labels(np.array([[255]], dtype=np.int32))


@settings(max_examples=100)
@given(st.binary(max_size=40))
def test_reading_junk_raises_nothing_but_value_errors(junk: bytes) -> None:
    for data in (junk, b"\0\1\0\0" + junk):
        for schema in DEFINITIONS:
            with contextlib.suppress(ValueError):
                decode(schema, data)


@pytest.mark.parametrize(
    ("kind", "size", "primitives"),
    [
        ("box", (0.1, 0.2, 0.3), ["box"]),
        ("sphere", (0.1,), ["sphere"]),
        ("capsule", (0.1, 0.3), ["cylinder", "sphere", "sphere"]),
    ],
)
def test_a_body_is_described_by_primitives(kind: Any, size: tuple[float, ...], primitives: list[str]) -> None:
    body = Body(name="it", role="object", shape=Shape(kind=kind, size=size), world_from_body=Pose())
    (link,) = read_links(body_description(body))
    assert [visual.kind for visual in link.visuals] == primitives


def test_damaged_and_foreign_pngs_are_refused() -> None:
    good = encode_labels(np.arange(64 * 48, dtype=np.int32).reshape(48, 64) % 200)
    flipped = bytearray(good)
    flipped[len(good) // 2] ^= 16
    for spoilt in (bytes(flipped), good[: len(good) // 2], good[:40]):
        with pytest.raises(ValueError, match="a damaged segmentation image"):
            LabelDecoder((48, 64)).decode(spoilt)
    buffer = io.BytesIO()
    Image.new("RGB", (64, 48)).save(buffer, format="PNG")
    for foreign in (buffer.getvalue(), b"x" * 100):
        with pytest.raises(ValueError, match="segmentation image"):
            LabelDecoder((48, 64)).decode(foreign)
    with pytest.raises(ValueError, match="other than 16 bits of 4x4 pixels"):
        LabelDecoder((4, 4)).decode(good)


def test_segmentation_images_are_independent() -> None:
    """FFmpeg adds an image to the previous one unless it is marked as a keyframe."""
    decoder, table, cube = LabelDecoder((6, 8)), np.full((6, 8), 1, np.int32), np.full((6, 8), 2, np.int32)
    shown = [decoder.decode(encode_labels(image)) for image in (table, cube, cube, table)]
    for found, image in zip(shown, (table, cube, cube, table), strict=True):
        np.testing.assert_array_equal(found, image)
