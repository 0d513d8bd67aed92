"""Checks of third-party datasets find planted faults in a dataset not made by demorec, and pass without them.

All bases and faults: `benchmarks/doctor_faults.py`.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from support.doctor_bases import BASES, record
from support.doctor_judge import SECOND, Bench, bench, check, episodes_of, findings_of
from support.doctor_writer import VideoStore, write_dataset


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    """Quantised teleoperation at 10 fps under openpi's names."""
    return bench(BASES["openpi"], tmp_path_factory.mktemp("doctor") / "openpi")


def test_a_sound_dataset_is_good(arm: Bench) -> None:
    answer = check(arm.folder / "sound")
    assert (answer["verdict"], findings_of(answer)) == ("good", [])


def test_a_parked_arm_with_the_rounding_of_lerobot_is_good(tmp_path: Path) -> None:
    """LeRobot's float32 gives a parked joint a nonzero deviation; its encoder flickers by one tick."""
    (tmp_path / "videos").mkdir()
    dataset = record(BASES["two arms"], seed=10, episodes=4)
    answer = check(write_dataset(dataset, tmp_path / "parked", VideoStore(tmp_path / "videos")))
    assert (answer["verdict"], findings_of(answer)) == ("good", [])


@pytest.mark.parametrize(
    "name",
    [
        "gap",
        "stuck state",
        "NaN",
        "unit of an episode",
        "dead joint",
        "maximum of the state",
        "action late",
        "copy",
        "empty instruction",
    ],
)
def test_a_planted_fault_is_found(arm: Bench, name: str) -> None:
    """The fault alone, with a second bad episode, and with a NaN in another episode."""
    for second in SECOND:
        answer = check(arm.plant(name, second))
        assert arm.is_found(answer, episodes_of(name), second), (second, answer)


@pytest.fixture
def small(tmp_path: Path) -> Path:
    """Four sound episodes of v2.1 with the videos of one camera."""
    (tmp_path / "videos").mkdir()
    dataset = record(BASES["normalised"], seed=3, episodes=4)
    return write_dataset(dataset, tmp_path / "set", VideoStore(tmp_path / "videos"))


def test_a_codec_that_info_json_misnames_is_one_finding(small: Path) -> None:
    path = small / "meta/info.json"
    path.write_text(path.read_text().replace('"h264"', '"av1"'))
    (finding,) = findings_of(check(small))
    assert finding["check"] == "video_format"
    assert "episode_000000.mp4 and 3 more is h264" in finding["message"]


def test_channels_may_come_first(small: Path) -> None:
    path = small / "meta/info.json"
    info = json.loads(path.read_text())
    for feature in info["features"].values():
        if feature["dtype"] == "video":
            height, width, channels = feature["shape"]
            feature |= {"shape": [channels, height, width], "names": None}
            feature["info"] = {**feature.get("info", {}), "video.channels": channels}
    path.write_text(json.dumps(info))
    assert findings_of(check(small)) == []


def test_tables_that_are_missing_are_to_be_downloaded(small: Path) -> None:
    for path in (small / "data").rglob("*.parquet"):
        path.unlink()
    found = [each for each in findings_of(check(small)) if each["check"] == "unreadable_episodes"]
    assert {each["do"] for each in found} == {"download the tables again"}
    assert len(found) == 4


def test_the_table_of_episodes_is_not_taken_for_the_rows(tmp_path: Path) -> None:
    """Both are named file-000.parquet; a repository may hold the folder meta alone."""
    (tmp_path / "videos").mkdir()
    dataset = record(BASES["two arms"], seed=3, episodes=2)
    root = write_dataset(dataset, tmp_path / "set", VideoStore(tmp_path / "videos"))
    (root / "data/chunk-000/file-000.parquet").unlink()
    found = findings_of(check(root))
    assert {each["check"] for each in found} == {"unreadable_episodes"}
    assert all("data/chunk-000/file-000.parquet" in each["message"] for each in found)


def test_an_info_json_that_cannot_be_read_is_one_finding(small: Path) -> None:
    (small / "meta/info.json").write_text("")
    (finding,) = findings_of(check(small))
    assert finding["check"] == "unreadable_episodes"


def test_videos_in_another_folder_than_info_json_states(small: Path) -> None:
    """LeRobot finds none of them."""
    (small / "videos").rename(small / "video")
    (finding,) = findings_of(check(small))
    assert (finding["check"], finding["severity"]) == ("contradicting_counts", "broken")
    assert "found video/" in finding["message"]
    assert finding["do"] == "correct it in meta/info.json"
