"""`reproduce` compares with what the recordings hold, not with what run.json says of them."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from support.check import edit_json, simulate_run
from support.commands import exit_code
from support.mcap import rewritten

from demorec.cli import main
from demorec.core.plain import to_plain
from demorec.generate.reproduce import read_original
from demorec.mcap import Recording
from demorec.mcap.metadata import EPISODE


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulate_run(tmp_path_factory.mktemp("reproduce") / "run", 5, seed=3, fps=10)


def one_bit(source: Path) -> bytes:
    """The recording with another last bit of one coordinate."""
    seen = 0

    def spoil(topic: str, data: bytes) -> bytes:
        nonlocal seen
        seen += topic == "/ee_pose"
        return data[:-56] + bytes([data[-56] ^ 1]) + data[-55:] if topic == "/ee_pose" and seen == 9 else data

    spoilt = rewritten(source, messages=spoil)
    assert seen > 9
    return spoilt


@pytest.mark.slow
def test_what_is_no_longer_what_was_made(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    spoilt = tmp_path / "run"
    shutil.copytree(run, spoilt)
    names = [spoilt / f"episodes/episode_{index:06d}.mcap" for index in range(5)]
    names[1].write_bytes(one_bit(names[1]))
    names[2].unlink()
    names[3].write_bytes(names[3].read_bytes()[:-100])
    with Recording(names[4]) as recording:
        info = to_plain(recording.info)
    info["versions"]["pybullet"] = "3.2.5"
    names[4].write_bytes(rewritten(names[4], change={EPISODE: {"info": json.dumps(info)}}))
    with pytest.raises(SystemExit) as ended:
        main(["reproduce", str(spoilt), "--out", str(tmp_path / "copy"), "--workers", "1"])
    told = capsys.readouterr()
    assert ended.value.code == 1
    assert told.out.startswith("2 of 5 episodes are bit-exact")
    assert "Note: version of pybullet is 3.2.5 there" in told.err.splitlines()[0]
    assert "Different: 1 (attempt 0), 2 (attempt 0), 3 (attempt 0)" in told.err
    for name in names[1:4]:
        assert str(name) in told.err


def test_another_digest_in_run_json(run: Path, tmp_path: Path) -> None:
    spoilt = tmp_path / "run"
    shutil.copytree(run, spoilt)
    assert not read_original(spoilt).faults
    edit_json(spoilt / "run.json", lambda data: data["episodes"][0].update(digest="0" * 64))
    (fault,) = read_original(spoilt).faults
    assert "is not the one that run.json lists" in fault


def test_renderings_of_a_run_are_no_copy_of_it(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "renderings"
    assert exit_code("render", run, "--out", out, "--cameras", "front", "--width", 16, "--height", 16) == 0
    there = {path.name: path.read_bytes() for path in out.rglob("*.mcap")}
    assert len(there) == 5
    for command in (("reproduce", run), ("generate", "--num-episodes", 5, "--seed", 3, "--fps", 10)):
        assert exit_code(*command, "--out", out) == 2
        assert (
            "Nothing in the output folder was generated, choose another --out: The recording is a render of"
            in capsys.readouterr().err
        )
    assert {path.name: path.read_bytes() for path in out.rglob("*") if path.is_file()} == there
