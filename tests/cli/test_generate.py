"""`demorec generate` from the command line: rejected input, messages, exit codes and leftover files."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from support.commands import exit_code

from demorec.cli import generate_dataset_main
from demorec.cli.generate import Generate


def run(capsys: pytest.CaptureFixture[str], *args: str) -> tuple[int, str, str]:
    code = exit_code(*args, program=generate_dataset_main)
    told = capsys.readouterr()
    return code, told.out, told.err


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["--task", "pick_palce"], "Unknown task 'pick_palce'. Did you mean 'pick_place'?"),
        (["--cameras", "frnt"], "Unknown camera 'frnt'. Did you mean 'front'?"),
        (["--cameras", "front", "front"], "A camera is named twice"),
        (["--cameras", "none", "front"], "--cameras none excludes other cameras"),
        (["--num-episodes", "0"], "--num-episodes is 0, allowed are 1 to 10,000,000."),
        (["--fps", "31"], "--fps is 31, which does not divide the physics rate of 240 Hz: use 30 or 40."),
        (["--width", "225"], "--width is 225, but yuv420p video needs even sizes: use 224 or 226."),
        (["--repo-id", "cubes"], "--repo-id is 'cubes', but must be OWNER/NAME"),
        (["--cube-mass", "0.5", "0.2"], "--cube-mass is from 0.5 to 0.2; it must be within"),
        (["--address", "auto"], "--address is for Ray"),
        (["--config", "missing.toml"], "The config file cannot be read (No such file or directory): missing.toml"),
    ],
)
def test_impossible_requests_are_one_sentence_and_leave_nothing(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, args: list[str], message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    code, out, err = run(capsys, *args)
    assert code == 2
    assert message in err
    assert (out, len(err.splitlines()), list(tmp_path.iterdir())) == ("", 1, [])


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["--num-epsodes", "3"], ["Unrecognized options: --num-epsodes", "Perhaps you meant", "--num-episodes INT"]),
        (["--cube-mass", "0.1"], ["Error parsing --cube-mass: two numbers are needed, LOW HIGH, or auto"]),
    ],
)
def test_options_that_cannot_be_parsed(capsys: pytest.CaptureFixture[str], args: list[str], words: list[str]) -> None:
    code, out, err = run(capsys, *args)
    assert code == 2
    assert all(word in out + err for word in words)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("num_episods = 3", "unknown key 'num_episods'. Did you mean 'num_episodes'?"),
        ("width = 224.5", "width: 224.5 is not a whole number"),
        ('depth = "false"', "depth: 'false' is not a boolean"),
        ("seed = ", "is not valid TOML"),
        ("fps = 7", "fps is 7, which does not divide"),
        ('out = "x"\ntempo = 1\nwidht = 3', "an unknown key 'widht'. Did you mean 'width'?"),
    ],
)
def test_bad_config_files_are_refused(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, content: str, message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "run.toml").write_text(content)
    code, _, err = run(capsys, "--config", "run.toml")
    assert code == 2
    assert message in err
    assert [p.name for p in tmp_path.iterdir()] == ["run.toml"]


def parsed(monkeypatch: pytest.MonkeyPatch, args: list[str]) -> Generate:
    """Return the config that the command would run with."""
    seen: list[Generate] = []

    def remember(command: Generate) -> int:
        seen.append(command)
        return 0

    monkeypatch.setattr(Generate, "run", remember)
    assert exit_code(*args, program=generate_dataset_main) == 0
    return seen[0]


def test_flags_override_the_file_and_the_file_overrides_defaults(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    file = tmp_path / "run.toml"
    file.write_text(
        'num_episodes = 7\nseed = 5\ncameras = "wrist"\ncodec = "av1"\ncrf = 20\nout = "there"\nexport = false\n'
        "max-episode-seconds = 30\n"
    )
    command = parsed(monkeypatch, [f"--config={file}", "--seed", "6", "--gop", "4"])
    assert (command.options.num_episodes, command.options.out, command.options.export) == (7, Path("there"), False)
    assert (command.episodes.seed, command.episodes.cameras, command.episodes.fps) == (6, ("wrist",), 30)
    assert (command.episodes.video.codec, command.episodes.video.crf, command.episodes.video.gop) == ("av1", 20, 4)
    assert command.episodes.max_episode_seconds == 30.0


def test_ranges_take_two_numbers_or_auto(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    file = tmp_path / "run.toml"
    file.write_text("cube_mass = [0.1, 0.2]\ncube_side = [0.03, 0.04]\n")
    args = ["--cube-mass", "auto", "--distractors", "1", "3", "--gravity-offset", "-1", "2"]
    command = parsed(monkeypatch, ["--config", str(file), *args])
    ranges = command.episodes.ranges
    assert (ranges.cube_mass, ranges.cube_side, ranges.distractors) == (None, (0.03, 0.04), (1, 3))
    assert ranges.gravity_offset == (-1.0, 2.0)


def test_the_demo_file_is_valid(monkeypatch: pytest.MonkeyPatch) -> None:
    file = Path(__file__).parents[2] / "demo.toml"
    command = parsed(monkeypatch, ["--config", str(file)])
    command.episodes.validate()
    command.options.validate()
    assert command.options.num_episodes == 5


@pytest.mark.parametrize("what", ["tasks", "cameras", "robots", "renderers", "exporters"])
def test_list_describes_every_row_in_one_line(capsys: pytest.CaptureFixture[str], what: str) -> None:
    from demorec.core import tables

    assert exit_code("list", what) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == list(getattr(tables, what.upper()).rows)
    assert all(re.match(r"\S+\s+\S+", line) for line in lines), "a row without a summary"
    assert len({line.split(maxsplit=1)[1] for line in lines}) == len(lines), "two rows that read the same"
