"""Images in bags of other recorders, by `rosbags` and `mcap`: none is lost, and only faulty bags give findings.

Timestamps are derived from exact ticks and rounded like those of drivers; rows' images are read from the recording.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest
from support import bag_mappings, bags
from support.bag_faults import ACTION, FRONT, SIDE, STATE
from support.check import result_of
from support.commands import exit_code

from demorec.mcap import Recording

NAMES = ("a", "b")
MAPPING = bag_mappings.SO101
ONE_CAMERA = MAPPING.partition("[cameras.side]")[0]


def ticks(rate: float, count: int, *, phase: float = 0.0, jitter_s: float = 0.0, is_floored: bool = False) -> list[int]:
    """Timestamps of a sensor in whole nanoseconds; `phase` in periods."""
    off = np.random.default_rng(count).uniform(-jitter_s, jitter_s, count) * bags.NS
    exact = [(phase + k) * bags.NS / rate + off[k] for k in range(count)]
    rounded = np.floor(exact) if is_floored else np.rint(exact)
    return [bags.EPOCH_NS + bags.NS + int(value) for value in rounded]


def bag(cameras: Mapping[str, Sequence[int]]) -> bags.Notes:
    """A bag with cameras and two joint topics that start 50 ms earlier and end 50 ms later."""
    first, last = min(min(times) for times in cameras.values()), max(max(times) for times in cameras.values())
    moments = range(first - 50_000_000, last + 90_000_000, 10_000_000)
    notes = bags.joints(STATE, NAMES, moments) + bags.joints(ACTION, NAMES, moments, shift=0.1)
    for number, (topic, times) in enumerate(cameras.items()):
        notes += bags.jpeg_images(topic, times, number, topic.split("/")[1])
    return bags.in_order(notes)


def imported(
    path: Path, mapping: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> tuple[str, dict[str, list[int]]]:
    """Return the output of an import, and the timestamp of each camera's image in every row of the only episode."""
    file = bag_mappings.write_mapping(mapping, tmp_path / "robot.toml")
    assert exit_code("import", path, "--mapping", file, "--out", tmp_path / "run") == 0
    told = capsys.readouterr().out
    with Recording(tmp_path / "run/episodes/episode_000000.mcap") as recording:
        table = recording.table()
        shown = {name: table.image_stamps[name][table.images[name]].tolist() for name in table.images}
    return told, shown


def suggested(path: Path, capsys: pytest.CaptureFixture[str]) -> str:
    """Suggest a mapping for a bag."""
    assert exit_code("import", "--suggest", path) == 0
    return capsys.readouterr().out


CLEAN: dict[str, Mapping[str, Sequence[int]]] = {
    "stamps to the nearest nanosecond": {FRONT: ticks(30, 60)},
    "stamps rounded down": {FRONT: ticks(30, 60, is_floored=True)},
    "a millisecond of jitter": {FRONT: ticks(30, 90, jitter_s=0.001)},
    "two cameras of one phase": {
        FRONT: ticks(30, 90, jitter_s=0.001),
        SIDE: ticks(30, 89, jitter_s=0.001),
    },
    "two cameras half a period apart": {
        FRONT: ticks(30, 90, jitter_s=0.003),
        SIDE: ticks(30, 91, phase=0.5, jitter_s=0.003),
    },
}


@pytest.mark.parametrize(
    ("name", "rows"),
    [(name, rows) for name in CLEAN for rows in ("default", "suggested") if rows == "default" or SIDE in CLEAN[name]],
)
def test_no_image_is_lost(name: str, rows: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cameras = CLEAN[name]
    path = bags.write_mcap(bag(cameras), tmp_path / "stack_cups.mcap")
    mapping = MAPPING if SIDE in cameras else ONE_CAMERA
    if rows == "suggested":
        mapping = suggested(path, capsys)
        assert tomllib.loads(mapping)["clock"]["fps"] == 30
    told, shown = imported(path, mapping, tmp_path, capsys)
    assert "No findings." in told
    # Nothing can be shown before the second camera's first image, nor after the first camera's last one.
    begin, end = max(times[0] for times in cameras.values()), min(times[-1] for times in cameras.values())
    for times, stamps in zip(cameras.values(), shown.values(), strict=True):
        assert {time for time in times if begin <= time <= end} <= set(stamps)


@pytest.mark.parametrize(("fps", "slow"), [(30, 15), (15, 15), (25, 25)])
def test_cameras_of_different_rates(fps: int, slow: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Rows follow the camera whose rate equals fps; repeated and unused images of other cameras are expected."""
    cameras = {FRONT: ticks(30, 90, jitter_s=0.001), SIDE: ticks(slow, 3 * slow, phase=0.2, jitter_s=0.001)}
    path = bags.write_rosbag2(bag(cameras), tmp_path / "stack_cups")
    told, shown = imported(path, MAPPING.replace("fps = 30", f"fps = {fps}"), tmp_path, capsys)
    assert "No findings." in told
    times = cameras[FRONT if fps == 30 else SIDE]
    followed = shown["front" if fps == 30 else "side"]
    assert followed == [time for time in times if time >= followed[0]]
    assert len(followed) >= len(times) - 1
    assert set(cameras[SIDE][1:-1]) <= set(shown["side"])


@pytest.mark.parametrize(("fps", "kind"), [(20, "skips"), (15, ""), (60, "repeats")])
def test_a_rate_that_no_camera_has(fps: int, kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Using every second image may be intended; using sometimes the second and sometimes the third cannot be."""
    path = bags.write_mcap(bag({FRONT: ticks(30, 90, jitter_s=0.001)}), tmp_path / "stack_cups.mcap")
    told, shown = imported(path, ONE_CAMERA.replace("fps = 30", f"fps = {fps}"), tmp_path, capsys)
    assert ("No findings." in told) == (not kind)
    left_out = 90 - len(set(shown["front"]))
    if kind:
        (line,) = [line for line in told.splitlines() if line.startswith(f"  {kind}: ")]
        assert "use fps = 30" in line
    if kind == "skips":
        (share,) = re.findall(r"([\d.]+) % of its images are in no row", line)
        assert float(share) == pytest.approx(100 * left_out / 90, abs=1)
    assert result_of(tmp_path / "run", "import_findings", "run").verdict == ("look" if kind else "good")
