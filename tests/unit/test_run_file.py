"""run.json: exact round trip, a message for every kind of damage, and a digest of content alone."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from support.check import edit_json
from support.generate import expected_attempts

from demorec.core.config import GenerateConfig
from demorec.core.errors import ConfigError
from demorec.runs.run_file import (
    Attempt,
    DamagedRunFileError,
    ExportRecord,
    GeneratedRun,
    load_run_file,
    recording_name,
    save_run_file,
)


def a_run() -> GeneratedRun:
    attempts = [
        Attempt(
            episode_index=episode,
            attempt=attempt,
            seed=3,
            success=success,
            file=f"{'episodes' if success else 'failed'}/{recording_name(episode, attempt, success=success)}",
            sha256="ab",
            digest=f"{episode} {attempt}",
            num_frames=5,
            num_bytes=9,
            reason="" if success else "dropped",
            seconds=0.1 + 0.2,
        )
        for (episode, attempt), success in expected_attempts(6, seed=3).items()
    ]
    return GeneratedRun(
        config=GenerateConfig(seed=3, cameras=("wrist",)),
        versions={"numpy": "2"},
        num_episodes=8,
        export=ExportRecord(run_digest="12", repo_id="me/cubes"),
    ).with_attempts(attempts)


def test_there_is_one_line_for_each_attempt(tmp_path: Path) -> None:
    run = a_run()
    save_run_file(run, tmp_path)
    text = (tmp_path / "run.json").read_text()
    assert sum(line.startswith('    {"episode_index"') for line in text.splitlines()) == len(run.attempts)
    assert load_run_file(tmp_path) == run


@pytest.mark.parametrize(
    "damage",
    [
        lambda text: text[: len(text) // 2],
        lambda text: "[]",
        lambda text: text.replace('"seed": 3', '"seed": "x"', 1),
        lambda text: text.replace('"attempt":', '"atempt":', 1),
    ],
)
def test_every_damage_is_reported_as_damage(tmp_path: Path, damage: Callable[[str], str]) -> None:
    save_run_file(a_run(), tmp_path)
    path = tmp_path / "run.json"
    before = path.read_text()
    path.write_text(damage(before))
    assert path.read_text() != before
    with pytest.raises(DamagedRunFileError, match=r"run\.json is damaged"):
        load_run_file(tmp_path)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda run: run.update(num_episodes=10**8), "num_episodes is 100000000, allowed are 1 to 10,000,000"),
        (lambda run: run.update(num_episodes=0), "num_episodes is 0"),
        (lambda run: run["episodes"][0].update(episode_index=10**7), "episode 10000000, attempt 0"),
        (lambda run: run["episodes"][0].update(episode_index=-1), "episode -1"),
        (lambda run: run["episodes"][0].update(attempt=10**9), "attempt 1000000000"),
        (lambda run: run["episodes"][0].update(file="../../elsewhere.mcap"), "has the file '../../elsewhere.mcap'"),
        (lambda run: run["episodes"].append(run["episodes"][0]), "two lines have episode 0, attempt 0"),
    ],
)
def test_impossible_numbers_are_damage(tmp_path: Path, change: Callable[[Any], object], words: str) -> None:
    run = a_run()
    assert run.attempts[0].success, "the first line must be that of a recording in episodes/"
    save_run_file(run, tmp_path)
    edit_json(tmp_path / "run.json", change)
    with pytest.raises(DamagedRunFileError) as error:
        load_run_file(tmp_path)
    assert words in str(error.value)


def test_it_is_never_written_through_links_or_fifos(tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("mine")
    (tmp_path / "run.json.part").symlink_to("mine")
    save_run_file(a_run(), tmp_path)
    assert (tmp_path / "mine").read_text() == "mine"
    os.mkfifo(tmp_path / "run.json.part")
    save_run_file(a_run(), tmp_path)
    assert load_run_file(tmp_path) == a_run()


def test_a_newer_format_is_not_damage(tmp_path: Path) -> None:
    save_run_file(a_run(), tmp_path)
    path = tmp_path / "run.json"
    path.write_text(path.read_text().replace('"format": 1', '"format": 2'))
    with pytest.raises(ConfigError, match="format 2") as error:
        load_run_file(tmp_path)
    assert not isinstance(error.value, DamagedRunFileError)


def test_the_digest_depends_on_content_and_on_nothing_else() -> None:
    run = a_run()
    same = [
        replace(run, export=None, versions={}, num_episodes=9),
        run.with_attempts([replace(a, seconds=0.0, sha256="", num_bytes=0) for a in reversed(run.attempts)]),
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
