"""Memory that an import needs for a long bag: numbers and times of messages, and next to nothing for images."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from support import bags

from demorec.extensions.imports.import_run import import_bags

MAPPING = """
[robot]
name = "so101"
[task]
text = "stack the cups"
[clock]
fps = 30
[[features."observation.state"]]
topic = "/state"
field = "position"
[[features.action]]
topic = "/command"
field = "position"
[cameras.front]
topic = "/front/image"
"""
PER_JOINT_MESSAGE = 6 * 8 + 8 + 8 + 4
"""Six numbers, two times, a checksum."""
PER_IMAGE = 4 * 8
"""Two times, its number, two checksums, its kind."""


def write_bag(path: Path, seconds: float, *, rate: float) -> Path:
    notes = bags.joints("/state", bags.SO101_JOINTS, bags.times(rate, seconds, seed=1))
    notes += bags.joints("/command", bags.SO101_JOINTS, bags.times(rate, seconds, seed=2))
    image = bags.jpeg(np.zeros((16, 16, 3), np.uint8))
    notes += [
        bags.Note(
            topic="/front/image",
            type="sensor_msgs/msg/CompressedImage",
            log_ns=moment,
            header_ns=moment,
            body={"format": "jpeg", "data": np.frombuffer(image, np.uint8)},
        )
        for moment in bags.times(100, seconds, seed=3)
    ]
    return bags.write_mcap(bags.in_order(notes), path)


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.timeout(600)
def test_the_peak_of_an_import_is_little_more_than_the_kept_memory(tmp_path: Path) -> None:
    (tmp_path / "robot.toml").write_text(MAPPING)
    peaks = []
    for seconds in (2, 60, 300):
        bag = write_bag(tmp_path / f"{seconds}.mcap", seconds, rate=200)
        tracemalloc.start()
        import_bags([bag], tmp_path / "robot.toml", tmp_path / f"run{seconds}")
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[2] - peaks[1] < 240 * (2 * 200 * PER_JOINT_MESSAGE + 100 * PER_IMAGE) * 2
