"""External episodes: bit-exact writing and reading; invalid values are refused."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
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

from demorec.core.errors import ConfigError, RecordingError
from demorec.episode.episode import NO_IMAGE, Sample, SampledFrame
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


def _frame(**changes: Any) -> Callable[[SampledWriter, SampledFrame], object]:
    return lambda writer, frame: writer.write(replace(frame, **changes))


def _sample(feature: str, vector: object, stamp_ns: object = 5) -> Callable[[SampledWriter, SampledFrame], object]:
    sample = Sample(stamp_ns=cast(int, stamp_ns), vector=cast(Any, vector))
    return lambda writer, frame: writer.write(replace(frame, samples={**frame.samples, feature: sample}))


def _image(*arguments: Any) -> Callable[[SampledWriter, SampledFrame], object]:
    return lambda writer, frame: writer.image(*arguments)


PIXELS = np.zeros((48, 64, 3), dtype=np.uint8)
BAD: dict[str, tuple[Callable[[SampledWriter, SampledFrame], object], str]] = {
    "length": (
        _sample("action", np.zeros(2)),
        r"'action' of frame 1 is float64 of shape \(2,\), it must be float64 of",
    ),
    "dtype": (_sample("observation.state", np.zeros(3)), "float64 of shape .* it must be float32"),
    "object": (_sample("action", np.array([None] * 3)), "is object of shape"),
    "list": (_sample("action", [0.0, 0.0, 0.0]), "is list of shape"),
    "nan": (_sample("action", np.array([0, np.nan, 0]), 10**18 * 2), "is nan in its element 'elbow.pos'"),
    "unknown feature": (_sample("acton", np.zeros(3)), "unknown feature 'acton'.*'action'"),
    "missing feature": (_frame(samples={}), "Frame 1 lacks the feature observation.state, action, observation.force"),
    "earlier": (_frame(time_ns=10**18), "stamps must not go backwards"),
    "negative time": (_frame(time_ns=-1), "the range is 0 to"),
    "float time": (_frame(time_ns=1.5), "must be a whole number of nanoseconds"),
    "feature goes back": (_sample("action", np.zeros(3), 7), "The feature 'action' of frame 1 has the stamp 7 ns"),
    "no such image": (_frame(images={"top": 9}), "has no image 9 for frame 1; images received: 1"),
    "no such camera": (_frame(images={"front": 0}), "camera 'front' has no image 0"),
    "unknown camera": (_image("tip", 5, PIXELS), "Unknown camera 'tip'.*'top'"),
    "size": (_image("top", 2 * 10**18, PIXELS[:-1]), r"uint8 of shape \(47, 64, 3\), it must be uint8 of shape"),
    "float image": (_image("top", 2 * 10**18, PIXELS / 255), "is float64 of shape"),
    "bytes for pixels": (_image("top", 2 * 10**18, b"x"), "is bytes, it must be uint8"),
    "image goes back": (_image("top", 5, PIXELS), "image of the camera 'top' has the stamp 5 ns, the one before"),
}


@pytest.mark.parametrize("what", BAD)
def test_invalid_frames_are_refused_in_one_sentence(tmp_path: Path, what: str) -> None:
    act, words = BAD[what]
    episode = make_external(num_frames=2, cameras=(TOP,))
    with SampledWriter(tmp_path / "a.mcap", episode.info) as writer:
        writer.image("top", *episode.images["top"][0])
        writer.write(episode.frames[0])
        with pytest.raises(RecordingError, match=words) as error:
            act(writer, replace(episode.frames[1], images={}))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"fps": 0}, "fps is 0"),
        ({"instruction": " "}, "task text is empty"),
        ({"features": ()}, "0 features"),
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
