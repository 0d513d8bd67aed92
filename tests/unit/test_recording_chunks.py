"""Whole topics at once, compared with the mcap library's own reader; and chunks with misleading headers."""

from __future__ import annotations

import struct
from dataclasses import replace

import numpy as np
import pytest

from demorec.mcap.messages import coded_images, compressed_image
from demorec.mcap.scan import blocks_of


def message(channel: int, time_ns: int, data: bytes) -> bytes:
    """A Message record (MCAP specification): channel, sequence, log time, publish time, data."""
    content = struct.pack("<HIQQ", channel, 0, time_ns, time_ns) + data
    return struct.pack("<BQ", 5, len(content)) + content


def test_images_of_several_formats_and_cut_off_ones() -> None:
    made = [compressed_image(0, "a", "h264", b"one")]
    made += [compressed_image(7, "a longer frame", "jpeg", b"three")]
    for messages in (made, made[:1] * 2):
        block = blocks_of([b"".join(message(1, 0, data) for data in messages)], {"/x": 1})["/x"]
        assert list(coded_images(block, "h264").messages()) == (
            [b"one", b"three"] if messages is made else [b"one"] * 2
        )
        for cut in (1, len(messages[-1]) - 3):
            short = replace(block, lengths=block.lengths - np.array([0, cut]))
            with pytest.raises((ValueError, struct.error)):
                coded_images(short, "h264")
