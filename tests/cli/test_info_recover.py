"""`demorec info` and `demorec recover` from the command line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from support.commands import exit_code
from support.recording import make_episode, write_episode

from demorec.mcap import EpisodeWriter, Recording
from demorec.runs.find import find


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recordings")
    write_episode(folder / "a.mcap", num_frames=45, depth=True)
    write_episode(folder / "b.mcap", num_frames=30, success=False, episode_index=7, cameras=())
    info, frames, _ = make_episode(num_frames=70)
    with EpisodeWriter(folder / "c.mcap", info) as writer:
        for frame in frames:
            writer.write(frame)
    part = folder / "c.mcap.part"
    part.write_bytes(part.read_bytes()[:-3000])
    return folder


@pytest.mark.slow
def test_info_of_a_recording(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_code("info", folder / "a.mcap") == 0
    text = capsys.readouterr().out
    rows = dict(line.split("  ", 1) for line in text.split("\n\n")[0].splitlines())
    rows = {key: value.strip() for key, value in rows.items()}
    assert rows["instruction"] == "pick up the red cube and place it on the green target"
    assert rows["outcome"] == "success"
    assert rows["length"] == "45 frames, 1.50 s at 30 Hz (physics 240 Hz)"
    assert rows["camera front"] == "64x48 h264, GOP 2, crf 23, depth, 45 images, at most 0 ms old"
    assert rows["check distance_to_target"] == "passed: 0.004 m (limit 0.02)"
    streams = {line.split()[0]: line.split()[1:] for line in text.split("\n\n")[1].splitlines()}
    assert streams["/joint_states"] == ["45", "sensor_msgs/msg/JointState"]
    assert streams["/tf_static"] == ["1", "tf2_msgs/msg/TFMessage"]


def test_info_as_json(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_code("info", folder / "a.mcap", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    with Recording(folder / "a.mcap") as recording:
        assert found["digest"] == recording.digest()
    assert (found["kind"], found["frames"], found["success"], found["root_seed"]) == ("recording", 45, True, 0)
    assert found["cameras"][0]["video"]["codec"] == "h264"
    assert found["cameras"][0]["depth"] is True
    assert exit_code("info", folder / "a.mcap", folder / "b.mcap", "--json") == 0
    assert [item["episode_index"] for item in json.loads(capsys.readouterr().out)] == [0, 7]


def test_recover(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    part = tmp_path / "c.mcap.part"
    part.write_bytes((folder / "c.mcap.part").read_bytes())
    before = part.read_bytes()
    assert exit_code("recover", part) == 0
    assert capsys.readouterr().out == f"Kept 60 frames, then the end is missing: {tmp_path / 'c.mcap'}\n"
    with Recording(tmp_path / "c.mcap") as recording:
        assert (recording.num_frames, recording.outcome, recording.is_recovered) == (60, None, True)
    assert part.read_bytes() == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["c.mcap", "c.mcap.part"]
    assert exit_code("info", tmp_path / "c.mcap") == 0
    assert "unknown: recovered after a crash" in capsys.readouterr().out
    assert exit_code("recover", part) == 2
    assert "exists already" in capsys.readouterr().err
    assert exit_code("recover", part, "--overwrite") == 0
    assert exit_code("recover", part, "--out", tmp_path / "d.mcap") == 0


def test_a_complete_recording_is_not_copied(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = tmp_path / "a.mcap"
    source.write_bytes((folder / "a.mcap").read_bytes())
    assert exit_code("recover", source) == 0
    assert capsys.readouterr().out == f"Nothing to recover, the recording is whole: {source}\n"
    assert list(tmp_path.iterdir()) == [source]


@pytest.mark.parametrize("mark", ["run.json", "evaluation.json", ""])
@pytest.mark.parametrize("is_inside", [True, False])
def test_a_recovered_recording_does_not_count_as_another_episode(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mark: str, is_inside: bool
) -> None:
    damaged = tmp_path / "run" / "episodes" / "a.mcap"
    damaged.parent.mkdir(parents=True)
    damaged.write_bytes((folder / "a.mcap").read_bytes()[:-3000])
    if mark:
        (tmp_path / "run" / mark).write_text("{}")
    if is_inside:
        monkeypatch.chdir(damaged.parent)
    assert exit_code("recover", damaged.name if is_inside else damaged) == 0
    place = tmp_path / "run" / ("recovered" if mark else "episodes") / "a.recovered.mcap"
    with Recording(place) as recording:
        assert recording.num_frames > 0
    if mark:
        assert find(tmp_path / "run").recordings == (damaged,)


def test_recover_without_intact_data(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cut = (folder / "c.mcap.part").read_bytes()[:3000]
    assert exit_code("recover", tmp_path / "nothing.mcap.part") == 2
    for content, words in ((b"", "the file is empty"), (cut, "Nothing can be recovered")):
        (tmp_path / "empty.mcap.part").write_bytes(content)
        assert exit_code("recover", tmp_path / "empty.mcap.part") == 1
        assert words in capsys.readouterr().err
        assert not (tmp_path / "empty.mcap").exists()
