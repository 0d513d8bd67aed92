"""`demorec generate --config RUN/run.json` compares with the content of the recordings, not with run.json."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from support.check import simulate_run
from support.commands import exit_code
from support.mcap import rewritten

from demorec.core.plain import to_plain
from demorec.mcap import Recording
from demorec.mcap.metadata import EPISODE


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulate_run(tmp_path_factory.mktemp("reproduce") / "run", 5, seed=3, fps=10)


def one_bit(source: Path) -> bytes:
    """The recording with the last bit of one coordinate changed."""
    seen = 0

    def spoil(topic: str, data: bytes) -> bytes:
        nonlocal seen
        seen += topic == "/ee_pose"
        return data[:-56] + bytes([data[-56] ^ 1]) + data[-55:] if topic == "/ee_pose" and seen == 9 else data

    spoilt = rewritten(source, messages=spoil)
    assert seen > 9
    return spoilt


@pytest.mark.slow
def test_changed_recordings_are_found(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
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
    code = exit_code("generate", "--config", spoilt, "--out", tmp_path / "copy", "--workers", 1, "--no-check")
    told = capsys.readouterr()
    assert code == 1
    last = told.out.splitlines()[-1]
    assert (
        last == f"Not the same as {spoilt}: 3 of 5 episodes differ: {', '.join(f'{n} (attempt 0)' for n in (1, 2, 3))}."
    )
    assert "Note: version of pybullet is 3.2.5 there" in told.err.splitlines()[0]
    for name in names[1:4]:
        assert str(name) in told.err


@pytest.mark.slow
def test_a_single_recording_is_made_again(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = run / "episodes" / "episode_000001.mcap"
    words = ("--out", tmp_path / "copy", "--workers", 1, "--no-check", "--no-export")
    assert exit_code("generate", "--config", source, *words) == 0
    assert capsys.readouterr().out.endswith(f"The same as {source}: 1 episode, bit for bit.\n")
    assert len(list((tmp_path / "copy" / "episodes").iterdir())) == 2


@pytest.mark.parametrize(
    ("flags", "named"),
    [
        (("--seed", 4), "--seed"),
        (("--num-episodes", 2), "--num-episodes"),
        (("--codec", "av1", "--speed", 1, 2, "--no-antialias"), "--antialias, --codec, --speed"),
        (("--cameras", "none"), "--cameras"),
    ],
)
def test_episode_flags_next_to_a_run_are_refused(
    flags: tuple[object, ...], named: str, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert exit_code("generate", "--config", run / "run.json", "--out", tmp_path / "copy", *flags) == 2
    said = capsys.readouterr().err
    assert f"again unchanged: leave out {named}." in said
    assert not (tmp_path / "copy").exists()


def test_allow_is_for_names_in_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_code("generate", "--out", tmp_path / "run", "--allow", "my_tasks") == 2
    assert "--allow is for a --config that names a run" in capsys.readouterr().err
