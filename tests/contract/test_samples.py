"""`recordings/sample/` holds one recording, which this version reads (`make sample` makes it again)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from mcap.reader import make_reader

from demorec.mcap import Recording

FOLDER = Path(__file__).parents[2] / "recordings" / "sample"
SAMPLE = FOLDER / "pick_place.mcap"


def test_the_sample_is_one_small_file() -> None:
    assert list(FOLDER.glob("*")) == [SAMPLE]
    assert SAMPLE.stat().st_size <= 1_000_000


def test_the_sample_is_read() -> None:
    with SAMPLE.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    counts = {summary.channels[key].topic: count for key, count in summary.statistics.channel_message_counts.items()}
    with Recording(SAMPLE) as recording:
        assert recording.info.instruction == "move the red cube to the green target"
        assert recording.success
        assert recording.num_frames == counts["/wrench"] == counts["/camera/front/h264"] > 100
        trajectory = recording.trajectory()
        (moved,) = trajectory.object_poses.values()
        assert np.abs(moved[-1, :2] - moved[0, :2]).max() > 0.05  # the cube was carried away
        assert np.ptp(trajectory.gripper_width) > 0.02
        assert {"approach", "lift"} <= set(trajectory.phase)
        for camera in ("front", "wrist"):
            images = list(recording.images(camera))
            assert len(images) == recording.num_frames
            assert np.abs(images[0].astype(int) - images[-1]).mean() > 1.0
