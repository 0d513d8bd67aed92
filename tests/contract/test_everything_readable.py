"""Every command that reads episodes, on every kind of episode.

It names the user's path, leaves nothing behind, and reads each episode and frame. Every other command works on imported
episodes, or gives the reason why it cannot.
"""

from __future__ import annotations

import errno
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import h5py
import pytest
from rosbags.rosbag2 import StoragePlugin
from support import bag_mappings, bags, hdf5
from support.check import edit_json
from support.commands import ON_A_PATH, ON_EVERYTHING, exit_code
from support.drawn_datasets import write_v21
from support.export import export, make_run, without_verification
from support.external import TOP, make_external, write_external
from support.foreign_dataset import write_foreign

from demorec import cli
from demorec.extensions.imports import import_run
from demorec.mcap import open_recording

COMMANDS = {name: ON_A_PATH[name] for name in ON_EVERYTHING} | {
    "export hdf5": "export hdf5 PATH --out NEW.hdf5",
    "import": "import FORMAT PATH --out NEW",
}
ROWS = {
    "simulation": (1, 24),
    "run of simulations": (2, 44),
    "dataset of simulations": (2, 44),
    "imported run": (1, 24),
    "imported dataset": (1, 24),
    "recorder": (1, 45),
    "mcap": (1, 48),
    "mcap with --mapping": (1, 48),
    "rosbag2": (1, 48),
    "folder of bags": (2, 96),
    "robomimic": (3, 18),
    "aloha": (1, 12),
    "lerobot v2.0": (2, 11),
    "lerobot v2.1": (2, 11),
    "lerobot v3.0": (2, 16),
}
"""Kind -> episodes and frames, as written."""
LIKE_OTHERS = ("imported run", "mcap with --mapping", "rosbag2", "aloha", "lerobot v2.0")
"""Kinds that only `info`, `check` and `import` are tried with; for other commands they equal a kind in the list."""
CASES = [
    (command, kind)
    for command in COMMANDS
    for kind in ROWS
    if (command, kind) != ("info", "run of simulations")
    and (command != "import" or kind not in ("simulation", "run of simulations", "imported run"))  # which need none
    and (command in ("info", "check", "import") or kind not in LIKE_OTHERS)
]
FORMATS = {"robomimic": "hdf5", "aloha": "hdf5"} | dict.fromkeys(
    ("dataset of simulations", "imported dataset", "lerobot v2.0", "lerobot v2.1", "lerobot v3.0"), "lerobot"
)
"""Kind -> format word of `demorec import`; bags and recordings, which are bags too, have none."""
EXTERNAL = "recorded by another robot or program"
OF_IMPORTED: dict[str, tuple[int, str]] = {
    "check RUN": (0, "good: 1 episode, 24 frames, 2 cameras; "),
    "check DATASET": (0, "good: 1 episode, 24 frames, 2 cameras; "),
    "check RUN --deep": (1, EXTERNAL),
    "check DATASET --deep": (2, "name the run of this dataset"),
    "replay RECORDING": (1, EXTERNAL),
    "replay DATASET": (2, "Expected a recording"),
    "render RECORDING --out NEW": (1, EXTERNAL),
    "dataset select DATASET --episodes 0 --out NEW": (0, "1 of 1 episode, 24 of 24 frames"),
    "dataset repair DATASET --out NEW": (0, "Nothing to repair, so nothing is written"),
    "dataset cut DATASET --at 0=7 --out NEW": (0, "2 parts of 1 episode, 24 of 24 frames"),
    "evaluate --policy RUN": (2, "Not a policy"),
    "correct --policy RUN": (2, "Not a policy"),
    "generate --config RUN --out NEW": (2, EXTERNAL),
    "generate --config RECORDING --out NEW": (2, EXTERNAL),
    "import BAG --mapping MAPPING --out RUN": (0, "1 of 1 bags had been imported before."),
    "recover RECORDING --out NEW.mcap": (0, "Complete: all 24 frames"),
    "info RECORDING": (0, "/frames "),
}
"""Command -> exit code, and phrases of its output."""


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[Path | str]]:
    """Kind -> path."""
    folder = tmp_path_factory.mktemp("readable")
    notes = bags.in_order(bags.so101(1.6))
    (folder / "bags").mkdir()
    for name in ("cups_1", "cups_2"):
        bags.write_mcap(notes, folder / "bags" / f"{name}.mcap")
    mapping = bag_mappings.write_mapping(bag_mappings.SO101, folder / "so101.toml")
    bag = bags.write_mcap(notes, folder / "stack.mcap")
    run = make_run(folder / "run", (24, 20))
    export(run, folder / "dataset")
    trossen = bags.write_trossen(bags.in_order(bags.trossen(0.8)), folder / "trossen.mcap")
    of_trossen = bag_mappings.write_mapping(bag_mappings.TROSSEN, folder / "trossen.toml")
    import_run.import_bags([trossen], of_trossen, folder / "imported")
    export(folder / "imported", folder / "imported-dataset")
    v20 = write_v21(folder / "older")
    edit_json(v20 / "meta" / "info.json", lambda info: info.update(codebase_version="v2.0"))
    return {
        "imported run": [folder / "imported"],
        "imported dataset": [folder / "imported-dataset"],
        "trossen": [trossen, "--mapping", of_trossen],
        "lerobot v2.0": [v20],
        "simulation": [run / "episodes" / "episode_000000.mcap"],
        "run of simulations": [run],
        "dataset of simulations": [folder / "dataset"],
        "recorder": [write_external(folder / "recorded.mcap", make_external(cameras=(TOP,)))],
        "mcap": [bag],
        "mcap with --mapping": [bag, "--mapping", mapping],
        "rosbag2": [bags.write_rosbag2(notes, folder / "so101", storage=StoragePlugin.SQLITE3)],
        "folder of bags": [folder / "bags"],
        "robomimic": [hdf5.write_robomimic(folder / "demo.hdf5")],
        "aloha": [hdf5.write_aloha(folder / "aloha.hdf5", count=12)],
        "lerobot v2.1": [write_v21(folder / "old")],
        "lerobot v3.0": [write_foreign(folder / "new")],
    }


@pytest.fixture
def scratch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder for temporary files."""
    folder = tmp_path / "scratch"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    without_verification(monkeypatch)
    return folder


@pytest.mark.parametrize(("command", "kind"), CASES)
def test_a_command_reads_it(
    command: str,
    kind: str,
    places: dict[str, list[Path | str]],
    scratch: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    words: list[str] = []
    flags: list[str] = []
    if command == "import" and len(places[kind]) == 1 and FORMATS.get(kind) != "lerobot":
        code = exit_code("import", *([FORMATS[kind]] if kind in FORMATS else []), places[kind][0], "--suggest")
        mapping = capsys.readouterr().out
        assert code == 0
        (tmp_path / "mapping.toml").write_text(mapping)
        flags = ["--mapping", str(tmp_path / "mapping.toml")]
    for word in COMMANDS[command].split():
        if word == "PATH":
            words += map(str, places[kind])
        elif word != "FORMAT":
            words.append(word.replace("NEW", str(tmp_path / "new")))
        elif kind in FORMATS:
            words.append(FORMATS[kind])
    code = exit_code(*words, *flags)
    printed = capsys.readouterr()
    assert "demorec-reading" not in printed.out + printed.err
    assert not list(scratch.iterdir())
    assert code in ((0, 1) if command == "check" else (0,)), printed  # the small foreign datasets have faults
    assert str(places[kind][0]) in printed.out or command != "info"
    episodes, frames = ROWS[kind]
    if command == "info" and kind in ("mcap", "rosbag2", "folder of bags"):  # whose topics are listed
        assert printed.out.count("/follower/joint_states") == episodes
    elif command == "info":
        is_one = kind in ("simulation", "recorder")  # a recording, which is one episode
        assert is_one or re.search(rf"episodes +{episodes}\b|\b{episodes} (of|episodes?|recordings?)\b", printed.out)
        assert str(frames) in printed.out
    if command == "import":
        recordings = sorted((tmp_path / "new" / "episodes").glob("*.mcap"))
        assert [len(recordings), sum(_num_frames(file) for file in recordings)] == [episodes, frames]
    if command == "export":
        told = json.loads((tmp_path / "new" / "meta" / "info.json").read_text())
        assert [told["total_episodes"], told["total_frames"]] == [episodes, frames]
    if command == "export hdf5":
        with h5py.File(tmp_path / "new.hdf5") as file:
            assert len(file["data"]) == episodes
            assert sum(len(file[f"data/{name}/actions"]) for name in file["data"]) == frames
    if command == "report" and kind in ("mcap", "robomimic"):
        page = (tmp_path / "new.html").read_text()
        assert page.count("<article") == episodes
        assert f"{frames} (" in page
        assert page.count('src="data:image/jpeg') == episodes
        assert "failed:" not in page  # nothing specifies it
    if command == "view":
        assert len(list(tmp_path.glob("new*.rrd"))) == episodes


def test_every_command_has_a_row() -> None:
    tried = {call.split()[0] for call in (*COMMANDS.values(), *OF_IMPORTED)}
    assert {*tried, "list", "explain"} == set(cli.COMMANDS.names())  # which take no path


@pytest.mark.parametrize("row", OF_IMPORTED)
def test_commands_work_on_imports_or_give_the_reason(
    row: str, places: dict[str, list[Path | str]], scratch: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (run,), (dataset,), (bag, _, mapping) = (places[kind] for kind in ("imported run", "imported dataset", "trossen"))
    words = {"RUN": run, "DATASET": dataset, "BAG": bag, "MAPPING": mapping, "NEW": tmp_path / "new"}
    words["RECORDING"] = Path(run) / "episodes" / "episode_000000.mcap"
    args = [re.sub(r"\b[A-Z]{3,}\b", lambda found: str(words[found[0]]), word) for word in row.split()]
    code, told = OF_IMPORTED[row]
    assert exit_code(*args) == code
    printed = capsys.readouterr()
    assert told in printed.out + printed.err
    assert "Traceback" not in printed.err
    if code == 2:
        (sentence,) = printed.err.strip().splitlines()
        assert sentence.startswith(f"demorec {args[0]}: ")
        assert list(tmp_path.iterdir()) == [scratch]


def _num_frames(recording: Path) -> int:
    with open_recording(recording) as opened:
        return opened.num_frames


@pytest.mark.parametrize(("kind", "word"), [("robomimic", "hdf5"), ("aloha", "hdf5"), ("lerobot v3.0", "lerobot")])
@pytest.mark.parametrize("flags", [(), ("--mapping", "MAPPING", "--out", "NEW"), ("--suggest",)])
def test_bags_get_their_import_word(
    kind: str,
    word: str,
    flags: tuple[str, ...],
    places: dict[str, list[Path | str]],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (path,) = places[kind]
    values = {"MAPPING": places["mcap with --mapping"][-1], "NEW": tmp_path / "new"}
    assert exit_code("import", path, *(values.get(flag, flag) for flag in flags)) == 2
    told = capsys.readouterr().err
    assert f"not a bag: demorec import {word} {path} imports it" in told
    assert told.count("\n") == 1
    assert not (tmp_path / "new" / "run.json").exists()


def test_omissions_and_the_mapping_are_reported(
    places: dict[str, list[Path | str]], scratch: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (source,) = places["robomimic"]
    assert exit_code("check", source) in (0, 1)  # the small file has faults
    printed = capsys.readouterr()
    assert printed.out.startswith(f"{source}: ")
    assert f"{source}: read by the suggested mapping; demorec import hdf5 " in printed.err
    assert "because the mapping does not name them: dones, next_obs, rewards, states." in printed.err


@pytest.mark.parametrize(
    ("kind", "words", "sentence"),
    [
        ("lerobot v3.0", ["--mapping", "x.toml"], "Only bags and HDF5 files are read by a mapping"),
        ("robomimic", ["--mapping", "BAG.toml"], "This is a mapping of bags, not of HDF5 files"),
        (
            "mcap",
            ["--mapping", "x.toml"],
            "No mapping (demorec import ... --suggest > FILE writes one): x.toml",
        ),
    ],
)
def test_a_mapping_of_another_format(
    kind: str,
    words: list[str],
    sentence: str,
    places: dict[str, list[Path | str]],
    scratch: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    words = [str(places["mcap with --mapping"][-1]) if word == "BAG.toml" else word for word in words]
    assert exit_code("info", *places[kind], *words) == 2
    assert sentence in capsys.readouterr().err
    assert not list(scratch.iterdir())


def test_a_bag_with_open_decisions_needs_a_mapping(
    scratch: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    notes = bags.of_topic(bags.in_order(bags.so101(1.0)), "/follower/cam_front/image_raw/compressed")
    bag = bags.write_mcap(notes, tmp_path / "bag.mcap")
    assert exit_code("check", bag) == 2
    told = capsys.readouterr().err
    assert f"demorec import {bag} --suggest > mapping.toml" in told
    assert told.count("\n") == 1
    assert not list(scratch.iterdir())


@pytest.mark.parametrize("error", [KeyboardInterrupt(), OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))])
def test_an_interrupted_reading_leaves_nothing(
    error: BaseException,
    places: dict[str, list[Path | str]],
    scratch: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def cut_off(*_: Any, **__: Any) -> None:
        assert list(scratch.iterdir())
        raise error

    monkeypatch.setattr(import_run, "import_bags", cut_off)
    assert exit_code("check", *places["mcap"]) == (130 if isinstance(error, KeyboardInterrupt) else 1)
    assert not [path for path in scratch.iterdir() if path.is_dir()]


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_leaves_nothing_behind(number: int, tmp_path: Path) -> None:
    bag = bags.write_mcap(bags.in_order(bags.so101(12.0)), tmp_path / "bag.mcap")
    (tmp_path / "scratch").mkdir()
    process = subprocess.Popen(
        [sys.executable, "-m", "demorec", "check", str(bag)],
        env={**os.environ, "TMPDIR": str(tmp_path / "scratch")},
        stderr=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
    )
    while process.poll() is None and not list((tmp_path / "scratch").glob("demorec-reading-*/0/*/episodes")):
        time.sleep(0.01)
    process.send_signal(number)
    assert process.wait(60) == 130
    assert not list((tmp_path / "scratch").iterdir())
