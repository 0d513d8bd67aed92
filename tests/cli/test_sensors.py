"""Every command on recordings whose sensors this version does not simulate."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from support.check import rewrite_messages, simulate
from support.commands import exit_code
from support.export import export, feature_of

from demorec.core.errors import RecordingError
from demorec.episode.info import Feature, SensorStream
from demorec.mcap import EpisodeWriter, Recording
from demorec.mcap.metadata import EPISODE, sealed

SLIP = Feature(
    name="observation.finger.slip",
    names=("left", "right", "angle"),
    units=("m/s", "m/s", "rad"),
    source="speed with which a thing slides along each finger (m/s), and turns between them (rad)",
    stream=SensorStream(topic="/finger/slip"),
)
FT = Feature(
    name="observation.wrist_ft",
    names=("fx", "fy", "fz", "tx", "ty", "tz"),
    units=("N", "N", "N", "N m", "N m", "N m"),
    stream=SensorStream(topic="/wrist_ft", layout="wrench", frame="panda_link7"),
)


def values_of(feature: Feature, frame: int) -> NDArray[np.float64]:
    return np.array([math.sin(0.1 * frame + n) for n in range(len(feature.names))])


def with_sensors(source: Path, target: Path, sensors: Sequence[Feature]) -> Path:
    """Replace the sensors of a recorded episode."""
    with (
        Recording(source) as recording,
        EpisodeWriter(
            target,
            replace(
                recording.info,
                features=(*(feature for feature in recording.info.features if feature.stream is None), *sensors),
            ),
        ) as writer,
    ):
        for frame in recording:
            sensed = {f.name.removeprefix("observation."): values_of(f, frame.frame_index) for f in sensors}
            writer.write(replace(frame, observation=replace(frame.observation, sensed=sensed)))
        assert recording.outcome is not None
        writer.finish(recording.outcome)
    return target


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulate(tmp_path_factory.mktemp("source") / "episode_000000.mcap", cameras=("front",), width=64, height=48)


@pytest.mark.slow
@pytest.mark.parametrize("sensors", [(), (SLIP,), (SLIP, FT)], ids=["none", "unknown", "two unknown"])
def test_every_command_uses_the_sensors_listed_in_a_recording(
    source: Path, sensors: tuple[Feature, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = with_sensors(source, tmp_path / "episode_000000.mcap", sensors)
    names = [feature.name for feature in sensors]
    with Recording(path) as recording:
        table, num_frames = recording.table(), recording.num_frames
        assert list(recording.info.sensors) == [name.removeprefix("observation.") for name in names]
        for feature in sensors:
            expected = [values_of(feature, frame) for frame in range(num_frames)]
            assert np.array_equal(table.features[feature.name], expected)

    assert exit_code("info", path, "--json") == 0
    described = {row["name"]: row for row in json.loads(capsys.readouterr().out)["features"]}
    assert [name for name in described if described[name]["units"] and name in (*names, "observation.wrench")] == names
    for feature in sensors:
        assert described[feature.name]["elements"] == list(feature.names)
        assert described[feature.name]["source"] == feature.source

    assert exit_code("check", path) == 0
    assert exit_code("view", path, "--save", tmp_path / "e.rrd") == 0
    assert (tmp_path / "e.rrd").stat().st_size > 0
    assert exit_code("replay", path) == 0
    export(path, tmp_path / "d", features=names)
    for feature in sensors:
        found, elements = feature_of(tmp_path / "d", feature.name, "lerobot")
        assert np.array_equal(found, table.features[feature.name].astype(np.float32))
        assert elements == list(feature.names)
        line = next(
            row for row in (tmp_path / "d" / "README.md").read_text().splitlines() if f"`{feature.name}`" in row
        )
        assert feature.source in line


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"name": "slip"}, "the sensor 'slip' is not an observation"),
        ({"stream": {"topic": "slip here"}}, "the topic of the sensor 'observation.finger.slip' is 'slip here'"),
        ({"stream": {"topic": "/slip", "layout": "wrench"}}, "the wrench 'observation.finger.slip' has 3 elements"),
        ({"units": ["m/s"]}, "has 3 elements, but 1 units"),
    ],
)
def test_an_impossible_sensor_is_refused(
    source: Path, changes: dict[str, object], message: str, tmp_path: Path
) -> None:
    def edit(name: str, values: dict[str, str]) -> dict[str, str]:
        if name == EPISODE:
            info = json.loads(values["info"])
            info["features"] = [
                feature | changes if feature["name"] == SLIP.name else feature for feature in info["features"]
            ]
            values = {key: value for key, value in values.items() if key != "crc32"}
            values = sealed(values | {"info": json.dumps(info)})
        return values

    path = with_sensors(source, tmp_path / "e.mcap", [SLIP])
    rewrite_messages(path, tmp_path / "changed.mcap", lambda message: [message], metadata=edit)
    with pytest.raises(RecordingError, match=message):
        Recording(tmp_path / "changed.mcap")


def test_a_listed_sensor_without_its_messages_is_found(
    source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = with_sensors(source, tmp_path / "e.mcap", [SLIP])
    rewrite_messages(path, tmp_path / "less.mcap", lambda message: [] if message[0] == "/finger/slip" else [message])
    assert exit_code("check", tmp_path / "less.mcap") == 1
    assert "0 messages on /finger/slip, not one at the time of each" in capsys.readouterr().out
