"""External episodes: bit-exact writing and reading; invalid values are refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from support.external import (
    ACTION,
    FORCE,
    STATE,
    TOP,
    WRIST,
    make_external,
    write_external,
)

from demorec.core.errors import ConfigError
from demorec.episode.episode import NO_IMAGE
from demorec.episode.info import Camera, EpisodeInfo
from demorec.mcap import Recording, SampledWriter


@pytest.mark.parametrize(("num_frames", "cameras"), [(0, ()), (1, (TOP, WRIST)), (45, ()), (100, (TOP, WRIST))])
def test_numbers_stamps_and_dtypes_are_read_as_they_were_written(
    tmp_path: Path, num_frames: int, cameras: tuple[Camera, ...]
) -> None:
    episode = make_external(num_frames=num_frames, cameras=cameras)
    path = write_external(tmp_path / "a.mcap", episode)
    with Recording(path) as recording:
        assert recording.info == episode.info
        assert recording.outcome == episode.outcome
        assert recording.num_frames == num_frames
        table = recording.table()
    assert table.time_ns.tolist() == [frame.time_ns for frame in episode.frames]
    for feature in (STATE, ACTION, FORCE):
        values = table.features[feature.name]
        assert values.dtype == feature.dtype
        assert values.shape == (num_frames, 3)
        assert values.tobytes() == b"".join(frame.samples[feature.name].vector.tobytes() for frame in episode.frames)
        assert table.stamps[feature.name].tolist() == [f.samples[feature.name].stamp_ns for f in episode.frames]
    for camera in cameras:
        expected = [frame.images.get(camera.name, NO_IMAGE) for frame in episode.frames]
        assert table.images[camera.name].tolist() == expected
        assert table.image_stamps[camera.name].tolist() == [stamp for stamp, _ in episode.images[camera.name]]
    if num_frames > 1 and cameras:
        assert table.images["wrist"][:3].tolist() == [NO_IMAGE, 0, 0]
        assert table.age_ns("observation.state").tolist() == [1_000_000] * num_frames
        assert table.image_age_ns("top").tolist() == [7_000_000] * num_frames


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"fps": 0}, "fps is 0"),
        ({"instruction": " "}, "task text is empty"),
        ({"features": ()}, "there are no features"),
        ({"features": (STATE, STATE)}, "2 features are called 'observation.state'"),
        ({"features": (replace(STATE, name="tf.x"),)}, "reserved"),
        ({"features": (replace(STATE, name="timestamp"),)}, "reserved"),
        ({"features": (replace(STATE, name="a/b"),)}, "allowed are words"),
        ({"features": (replace(STATE, units=("rad",)),)}, "3 elements, but 1 units"),
        ({"features": (replace(STATE, joints=("shoulder", "wrist", "")),)}, "URDF lacks: wrist"),
        ({"features": (replace(STATE, names=("a", "a", "b")),)}, "are called 'a'"),
        ({"cameras": (replace(TOP, name="my top"),)}, "allowed are letters"),
        ({"cameras": (replace(TOP, width=0),)}, "0x48 pixels"),
        ({"cameras": (replace(TOP, mount="nowhere"),)}, "not a link of the URDF"),
        ({"urdf": "<robot"}, "not valid XML"),
    ],
)
def test_an_impossible_description_is_refused(tmp_path: Path, changes: dict[str, Any], words: str) -> None:
    info: EpisodeInfo = replace(make_external(num_frames=1).info, **changes)
    with pytest.raises(ConfigError, match=words):
        SampledWriter(tmp_path / "a.mcap", info)
    assert not list(tmp_path.iterdir())
