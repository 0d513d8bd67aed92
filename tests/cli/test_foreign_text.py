"""Escape codes, line breaks and bidirectional marks in every field that a command prints."""

from __future__ import annotations

import contextlib
import io
import json
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from support.check import edit_json
from support.commands import ON_A_PATH, words_of
from support.export import export
from support.mcap import rewritten
from support.recording import write_episode

from demorec.cli import COMMANDS, main, run_command
from demorec.mcap import Recording
from demorec.runs.recorded import inspect_recording
from demorec.runs.run_file import GeneratedRun, save_run_file

HOSTILE = "\x1b[2Jx\n\u202ey\x9b31m"
NAME = "\x1b[31mred\u202e.mcap"


def _spoken(arguments: Sequence[object]) -> str:
    """Return everything that a command printed; its only control characters may be line breaks."""
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said), contextlib.suppress(SystemExit):
        main([str(argument) for argument in arguments])
    text = said.getvalue()
    assert text, arguments
    for mark in ("\x1b", "\u202e", "\x9b", "\r"):
        assert mark not in text, (arguments, text)
    return text


def _on_a_path(path: Path, new: Path) -> list[Sequence[object]]:
    return [words_of(call, path, new) for call in ON_A_PATH.values()]


def _everywhere(value: Any) -> Any:
    """Return JSON data with every string made hostile."""
    if isinstance(value, dict):
        return {key: _everywhere(child) for key, child in value.items()}
    if isinstance(value, list):
        return [_everywhere(child) for child in value]
    return f"{value}{HOSTILE}" if isinstance(value, str) else value


def _fields(info: dict[str, Any]) -> dict[str, Any]:
    """Make a description's free texts hostile and keep its references valid."""
    info["instruction"] += HOSTILE
    info["origin"] = f"replay of {HOSTILE}"
    info["versions"] = {f"demorec{HOSTILE}": HOSTILE}
    simulation = info["simulation"]
    info["robot_name"] += HOSTILE
    simulation["task"] += HOSTILE
    simulation["robot"]["name"] += HOSTILE
    simulation["config_digest"] += HOSTILE
    simulation["behaviour"] = {HOSTILE: 1.0}
    return info


@pytest.fixture(scope="module")
def hostile(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a good recording and hostile copies of it, of a run and of a dataset."""
    folder = tmp_path_factory.mktemp("hostile")
    good = write_episode(folder / "good.mcap", num_frames=24, cameras=())
    with Recording(good) as recording:
        container = recording._container
        episode, outcome = container.metadata("demorec.episode"), container.metadata("demorec.outcome")
    assert episode is not None
    assert outcome is not None
    ended = json.loads(outcome["outcome"])
    ended["success"], ended["failure_phase"], ended["failure_reason"] = False, HOSTILE, HOSTILE
    ended["checks"][0]["name"] += HOSTILE
    ended["checks"][0]["unit"] += HOSTILE
    change = {
        "demorec.episode": {"info": json.dumps(_fields(json.loads(episode["info"])))},
        "demorec.outcome": {"outcome": json.dumps(ended)},
    }
    (folder / NAME).write_bytes(rewritten(good, change=change))
    (folder / "version.mcap").write_bytes(rewritten(good, change={"demorec.episode": {"format_version": HOSTILE}}))
    wrong = json.dumps(_everywhere(json.loads(episode["info"])))
    (folder / "names.mcap").write_bytes(rewritten(good, change={"demorec.episode": {"info": wrong}}))
    extra = json.dumps({**json.loads(episode["info"]), HOSTILE: 1})
    (folder / "keys.mcap").write_bytes(rewritten(good, change={"demorec.episode": {"info": extra}}))

    run = folder / "run"
    (run / "episodes").mkdir(parents=True)
    (run / "failed").mkdir()
    shutil.copy(good, run / "episodes" / "episode_000000.mcap")
    from dataclasses import replace

    from demorec.core.config import GenerateConfig

    attempt = replace(inspect_recording(good)[0], file="episodes/episode_000000.mcap")
    config = GenerateConfig(cameras=())
    save_run_file(GeneratedRun(config=config, versions={}, num_episodes=1, attempts=(attempt,)), run)
    file = run / "run.json"
    plain = json.loads(file.read_text())
    plain["versions"] = {HOSTILE: HOSTILE}
    plain["config"]["task"] += HOSTILE
    plain["episodes"].append({**plain["episodes"][0], "episode_index": 1, "success": False,
                              "file": HOSTILE, "phase": HOSTILE, "reason": HOSTILE})  # fmt: skip
    file.write_text(json.dumps(plain))

    export([good], folder / "dataset")
    info = Path("meta/info.json")
    edit_json(folder / "dataset" / info, lambda plain: plain.update(robot_type=f"panda{HOSTILE}"))
    names = [f"{HOSTILE}{number}" for number in range(8)]
    edit_json(folder / "dataset" / info, lambda plain: plain["features"]["observation.state"].update(names=names))
    file = folder / "dataset" / "demorec" / "configs.json"  # refused by generate
    file.write_text(json.dumps(_everywhere(json.loads(file.read_text()))))
    shutil.copytree(folder / "dataset", folder / "damaged")
    feature = {"dtype": HOSTILE, "shape": [1], "names": [HOSTILE]}
    edit_json(folder / "damaged" / info, lambda plain: plain["features"].update({HOSTILE: feature}))
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("name", [NAME, "version.mcap", "names.mcap", "keys.mcap"])
def test_recordings(hostile: Path, name: str, tmp_path: Path) -> None:
    path = hostile / name
    for arguments in (
        *_on_a_path(path, tmp_path / NAME),
        ["info", path, "--json"], ["check", path, "--all"], ["check", path, "--json"],
        ["render", path, "--cameras", HOSTILE, "--out", tmp_path / "new.mcap", "--workers", "1"],
    ):  # fmt: skip
        _spoken(arguments)


def test_the_fields_are_printed(hostile: Path) -> None:
    text = _spoken(["info", hostile / NAME])
    assert text.count("\\x1b[2Jx\\n\\u202ey\\x9b31m") >= 9
    assert "\\x1b[31mred\\u202e.mcap" in text


@pytest.mark.slow
@pytest.mark.parametrize("name", ["run", "dataset", "damaged"])
def test_runs_and_datasets(hostile: Path, name: str, tmp_path: Path) -> None:
    path = hostile / name
    for arguments in (
        *_on_a_path(path, tmp_path / f"new_{NAME}"),
        ["info", path, "--json"], ["check", path, "--no-images", "--all"],
        ["export", "lerobot", hostile / "good.mcap", "--out", path, "--append", "--no-verify"],
        ["dataset", "rename", path, f"observation.state={HOSTILE}", "--out", tmp_path / "new"],
        ["dataset", "merge", path, hostile / "dataset", "--out", tmp_path / NAME],
        ["dataset", "select", path, "--where", f"task == {HOSTILE!r}", "--out", tmp_path / NAME],
        ["dataset", "trim", path, "--head", "1", "--out", tmp_path / NAME],
    ):  # fmt: skip
        _spoken(arguments)


def test_flags_and_names_on_the_command_line() -> None:
    for arguments in (
        [HOSTILE], ["import", HOSTILE, "--suggest"],
        ["list", HOSTILE], ["explain", HOSTILE], ["info", f"--{HOSTILE}=1"], ["info", HOSTILE], ["export", HOSTILE],
        ["generate", f"--{HOSTILE}"], ["generate", "--seed", HOSTILE], ["generate", "--task", HOSTILE, "--out", "/x"],
        ["check", "x", "--only", HOSTILE], ["check", "--workers", HOSTILE], ["view", "x", "--size", HOSTILE, "1"],
    ):  # fmt: skip
        _spoken(arguments)


def test_warnings_of_python() -> None:
    program = (
        "import warnings, demorec.cli as cli\n"
        "class Warns:\n"
        "    'Warn.'\n"
        "    def run(self):\n"
        f"        warnings.warn({HOSTILE!r})\n"
        "        return 0\n"
        "cli.parse = lambda *_, **__: Warns()\n"
        "cli.run_command(Warns, [], prog='demorec warns')\n"
    )
    done = subprocess.run([sys.executable, "-W", "always", "-c", program], capture_output=True, text=True, check=True)
    assert "UserWarning: \\x1b[2Jx" in done.stderr
    assert "\x1b" not in done.stderr


def test_an_unexpected_error_leaves_a_report(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    from dataclasses import dataclass

    @dataclass(frozen=True, kw_only=True)
    class Fails:
        """Fail."""

        def run(self) -> int:
            """Raise an unexpected exception."""
            raise ZeroDivisionError(HOSTILE)

    assert run_command(Fails, [], prog="demorec fails") == 1
    err = capsys.readouterr().err
    assert err.startswith("demorec fails: ZeroDivisionError: ")  # a file outside demorec
    report = Path(err.partition("the traceback is in ")[2].partition(")")[0])
    assert "Traceback" in report.read_text()
    report.unlink()
    assert len(err.splitlines()) == 1


POLICIES = ("correct", "evaluate")
"""Commands that read policies."""


def test_every_command_is_tried() -> None:
    source = Path(__file__).read_text()
    assert all(f'["{name}"' in source for name in COMMANDS.names() if name not in (*ON_A_PATH, *POLICIES))
