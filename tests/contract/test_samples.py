"""`recordings/sample/` holds a file of every format version, and this demorec reads them all, to the bit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from demorec.episode.info import FORMAT_VERSION
from demorec.mcap import Recording

FOLDER = Path(__file__).parents[2] / "recordings" / "sample"
# Never change a row: the file of a version that is out in the world stays what it is.
SAMPLES = {
    1: (
        "c6f7b6393497e18b018d3a4f9ade412530706cf015eba92c87e005b78cbe3984",
        219,
        "move the red cube to the green target",
    ),
    2: (
        "6e88228b90c112e018d96a227ff9182f3bccbf9a5cd1adb958b0961e46d4020b",
        219,
        "move the red cube to the green target",
    ),
}


def test_there_is_one_for_every_version() -> None:
    assert set(SAMPLES) == set(range(1, FORMAT_VERSION + 1))
    assert {path.name for path in FOLDER.glob("*.mcap")} == {f"format_{version}.mcap" for version in SAMPLES}
    assert all(path.stat().st_size <= 1_000_000 for path in FOLDER.glob("*.mcap"))


@pytest.mark.parametrize("version", SAMPLES)
def test_a_sample_is_read(version: int) -> None:
    digest, num_frames, instruction = SAMPLES[version]
    with Recording(FOLDER / f"format_{version}.mcap") as recording:
        assert recording.info.format_version == version
        assert recording.info.instruction == instruction
        assert recording.outcome is not None
        assert recording.outcome.success
        assert recording.num_frames == num_frames
        assert recording.digest() == digest
        columns = recording.columns()
        assert columns.num_frames == num_frames
        (moved,) = columns.object_poses.values()
        assert np.abs(moved[-1, :2] - moved[0, :2]).max() > 0.05  # the cube was carried away
        assert np.ptp(columns.gripper_width) > 0.02
        assert ("wrench" in columns.sensed) == (version >= 2)
        assert {"approach", "lift"} <= set(columns.phase) or len(set(columns.phase)) >= 5
        for camera in ("front", "wrist"):
            images = list(recording.images(camera))
            assert len(images) == num_frames
            assert np.abs(images[0].astype(int) - images[-1]).mean() > 1.0
            counts = recording.pixel_statistics(camera).counts
            assert counts.sum(axis=1).tolist() == [counts[0].sum()] * 3
            assert counts.sum() > 0
