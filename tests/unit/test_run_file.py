"""run.json: what is written is what is read, every way of breaking it is told, and only content decides the digest."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
from helpers_generate import expected_attempts

from demorec.config import GenerateConfig
from demorec.errors import ConfigError
from demorec.generate.run_file import (
    Attempt,
    DamagedRunFileError,
    ExportRecord,
    RunFile,
    Session,
    load_run_file,
    save_run_file,
)


def a_run() -> RunFile:
    attempts = [
        Attempt(
            episode_index=episode,
            attempt=attempt,
            seed=3,
            success=success,
            file=f"{episode}",
            sha256="ab",
            digest=f"{episode} {attempt}",
            num_frames=5,
            num_bytes=9,
            reason="" if success else "dropped",
            seconds={"simulation": 0.1 + 0.2},
        )
        for (episode, attempt), success in expected_attempts(6, seed=3).items()
    ]
    return RunFile(
        config=GenerateConfig(seed=3, cameras=("wrist",)),
        versions={"numpy": "2"},
        num_episodes=8,
        sessions=(Session(started="2026-01-01T00:00:00+00:00", machine={"host": "somewhere"}),),
        export=ExportRecord(run_digest="12", repo_id="me/cubes"),
    ).with_attempts(attempts)


def test_a_run_survives_the_file(tmp_path):
    run = a_run()
    save_run_file(run, tmp_path)
    assert load_run_file(tmp_path) == run
    assert [p.name for p in tmp_path.iterdir()] == ["run.json"]


def test_there_is_one_line_an_attempt_and_one_for_each_episode_to_come(tmp_path):
    run = a_run()
    save_run_file(run, tmp_path)
    text = (tmp_path / "run.json").read_text()
    lines = json.loads(text)["episodes"]
    assert len(lines) == len(run.attempts) + 2
    assert [line["episode_index"] for line in lines if line["state"] == "planned"] == [6, 7]
    assert sum(line.startswith('    {"state"') for line in text.splitlines()) == len(lines)
    assert {line["state"] for line in lines if line.get("success")} == {"done"}


@pytest.mark.parametrize(
    "damage",
    [
        lambda text: text[: len(text) // 2],
        lambda text: "",
        lambda text: "[]",
        lambda text: text.replace('"seed": 3', '"seed": "x"', 1),
        lambda text: text.replace('"attempt":', '"atempt":', 1),
        lambda text: text.replace('"versions"', '"verions"', 1),
        lambda text: "\x00" * 100,
    ],
)
def test_every_damage_is_told_as_such(tmp_path, damage):
    save_run_file(a_run(), tmp_path)
    path = tmp_path / "run.json"
    before = path.read_text()
    path.write_text(damage(before))
    assert path.read_text() != before
    with pytest.raises(DamagedRunFileError, match=r"run\.json is damaged"):
        load_run_file(tmp_path)


def test_a_newer_format_is_no_damage(tmp_path):
    save_run_file(a_run(), tmp_path)
    path = tmp_path / "run.json"
    path.write_text(path.read_text().replace('"format": 1', '"format": 2'))
    with pytest.raises(ConfigError, match="format 2") as error:
        load_run_file(tmp_path)
    assert not isinstance(error.value, DamagedRunFileError)


def test_a_folder_without_a_run_is_told(tmp_path):
    with pytest.raises(ConfigError, match="no run of generate-dataset"):
        load_run_file(tmp_path)


def test_the_digest_depends_on_content_and_on_nothing_else():
    run = a_run()
    same = [
        replace(run, sessions=(), export=None, versions={}, num_episodes=9),
        run.with_attempts([replace(a, seconds={}, sha256="", num_bytes=0) for a in reversed(run.attempts)]),
    ]
    assert {other.digest for other in same} == {run.digest}
    first, *rest = run.attempts
    other = [
        replace(run, config=replace(run.config, seed=4)),
        run.with_attempts(rest),
        run.with_attempts([replace(first, digest="x"), *rest]),
        run.with_attempts([replace(first, success=not first.success), *rest]),
        run.with_attempts([replace(first, episode_index=100), *rest]),
    ]
    assert run.digest not in {changed.digest for changed in other}
