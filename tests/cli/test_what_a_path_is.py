"""Every command describes a path that is not a recording, run or dataset in the same words."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable
from pathlib import Path

import h5py
import pytest
from support.commands import ON_A_PATH, ON_EVERYTHING, OTHERS, exit_code, words_of
from support.recording import write_episode

from demorec.cli import COMMANDS
from demorec.core.errors import ConfigError
from demorec.core.extension import ExporterRow
from demorec.datasets.lerobot.paths import INFO_PATH
from demorec.runs.find import PathKind, expect, find


def make_socket(path: Path) -> None:
    here = Path.cwd()
    os.chdir(path.parent)  # a socket's name is limited to about a hundred characters
    try:
        with socket.socket(socket.AF_UNIX) as listening:
            listening.bind(path.name)
    finally:
        os.chdir(here)


def make_hdf5(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file["data"] = 1


ODD: tuple[tuple[Callable[[Path], None], str], ...] = (
    (os.mkfifo, "This is a FIFO, not a file or folder"),
    (make_socket, "This is a socket, not a file or folder"),
    (lambda path: path.symlink_to("/dev/zero"), "This is a device, not a file or folder"),
    (lambda path: path.symlink_to(path.with_name("gone")), "This is a link whose target is missing"),
    (Path.mkdir, "The folder holds no recording (*.mcap), run (run.json) or dataset (meta/info.json)"),
    (lambda path: None, "No such file or folder"),
    (make_hdf5, "Expected a r"),
)


def test_an_export_is_known_by_its_mark(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    row = ExporterRow(target="tables:TABLES", name="tables", mark="tables.json")
    monkeypatch.setattr("demorec.runs.find.exporter_rows", lambda: {"tab": row})
    (tmp_path / "tables.json").write_text("1")
    with pytest.raises(ConfigError, match="found tables; name the run that it was made from"):
        expect(tmp_path, "run")


def test_every_command_is_tried() -> None:
    assert ON_A_PATH.keys() | OTHERS == set(COMMANDS.names())


@pytest.mark.parametrize(
    ("command", "make", "sentence"),
    [
        (command, make, sentence)
        for command in ON_A_PATH
        for make, sentence in ODD
        if make is not make_hdf5 or command not in ON_EVERYTHING
    ],
)
def test_every_command_describes_a_path_in_the_same_words(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    command: str,
    make: Callable[[Path], None],
    sentence: str,
) -> None:
    path = tmp_path / "x.mcap"
    make(path)
    before = sorted(tmp_path.iterdir())
    assert exit_code(*words_of(ON_A_PATH[command], path, tmp_path / "out")) == 2
    told = capsys.readouterr().err
    assert told.startswith(f"demorec {command}: {sentence}")
    assert told.endswith(f": {path}\n")
    assert told.count("\n") == 1
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.parametrize(
    ("command", "place"), [(command, "the path itself") for command in ON_A_PATH] + [("info", "in a folder")]
)
def test_names_that_are_not_utf8(tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str, place: str) -> None:
    """Neither PyArrow nor Rerun can open such names."""
    path = tmp_path / os.fsdecode(b"\xff.mcap")
    write_episode(path, num_frames=2, cameras=())
    before = sorted(tmp_path.iterdir())
    given = path if place == "the path itself" else tmp_path
    assert exit_code(*words_of(ON_A_PATH[command], given, tmp_path / "out")) == 2
    shown = str(path).replace("\udcff", "\\udcff")
    told = capsys.readouterr().err
    assert told.startswith(f"demorec {command}: This name has bytes that are not UTF-8")
    assert told.endswith(f": {shown}\n")
    assert told.count("\n") == 1
    assert sorted(tmp_path.iterdir()) == before


def test_an_unreadable_path_does_not_count_as_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "run" / "meta").mkdir(parents=True)

    def forbidden(self: Path) -> os.stat_result:
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr(Path, "lstat", forbidden)  # the tests may run as root, who may read everything
    found = find(tmp_path / "run")
    assert (found.kind, found.reason) == ("unreadable", "This cannot be read (Permission denied)")


def write(name: str, content: bytes = b"") -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
        return folder / name.partition("/")[0]

    return make


def a_recording(name: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        write_episode(folder / name, num_frames=2, cameras=())
        return folder / name.partition("/")[0]

    return make


@pytest.mark.parametrize(
    ("make", "kind"),
    [
        (a_recording("x.mcap"), "recording"),
        (write("damaged.mcap", b"\0" * 100), "recording"),
        (write("x.mcap.part", b"\x89MCAP0\r\n"), "unfinished"),
        (write("x.rrd", b"RRF2"), "rrd"),
        (write("x.db3", b"SQLite format 3\0"), "rosbag"),
        (write("notes.txt", b"words"), "nothing"),
        (write("run/run.json"), "run"),
        (write(f"dataset/{INFO_PATH}"), "dataset"),
        (write("evaluation/evaluation.json"), "evaluation"),
        (write("bag/metadata.yaml"), "rosbag"),
        (a_recording("folder/x.mcap"), "recordings"),
        (a_recording("lost/episodes/x.mcap"), "recordings"),
        (write("other/x.txt"), "nothing"),
    ],
)
def test_unexpected_content_is_named(tmp_path: Path, make: Callable[[Path], Path], kind: PathKind) -> None:
    assert find(make(tmp_path)).kind == kind


def test_a_run_has_the_recordings_of_its_folders_alone(tmp_path: Path) -> None:
    for name in ("mine.mcap", "episodes/b.mcap", "episodes/a.mcap", "failed/c.mcap", "episodes/d.mcap.part"):
        write(name)(tmp_path)
    found = find(tmp_path)
    assert found.recordings == tuple(tmp_path / name for name in ("mine.mcap", "episodes/a.mcap", "episodes/b.mcap"))
    write("run.json")(tmp_path)
    found = find(tmp_path)
    assert found.recordings == tuple(tmp_path / name for name in ("episodes/a.mcap", "episodes/b.mcap"))
    assert found.failed == (tmp_path / "failed/c.mcap",)


@pytest.fixture
def after_a_kill(tmp_path: Path) -> Path:
    """A folder with a complete recording, one left by a crash, and one left by a crash and recorded again since."""
    folder = tmp_path / "after a kill"
    a_recording("episodes/episode_000000.mcap")(folder)
    for name in ("episodes/episode_000001", "unfinished/node-1-0/episode_000000.attempt_0"):
        write(f"{name}.mcap.part", b"\x89MCAP0\r\n")(folder)
    return folder


@pytest.mark.parametrize("command", ["info", "check", "view"])
def test_leftovers_of_a_kill_are_named_with_a_remedy(
    after_a_kill: Path, capsys: pytest.CaptureFixture[str], command: str
) -> None:
    flags = {"view": ["--save", str(after_a_kill.parent / "x.rrd")]}.get(command, [])
    exit_code(command, after_a_kill, *flags)
    told = capsys.readouterr()
    assert (
        "Left out: a recording is unfinished (in progress, or left by a crash): demorec recover "
        f"'{after_a_kill}/episodes/episode_000001.mcap.part' keeps the rest of it."
    ) in told.out + told.err


@pytest.mark.parametrize("asked", ["", "episodes/episode_000001.mcap"])
def test_leftovers_alone_are_named_too(after_a_kill: Path, capsys: pytest.CaptureFixture[str], asked: str) -> None:
    (after_a_kill / "episodes/episode_000000.mcap").unlink()
    assert exit_code("check", after_a_kill / asked) == 2
    told = capsys.readouterr().err
    assert f"demorec recover '{after_a_kill}/episodes/episode_000001.mcap.part' keeps the rest of" in told
    assert ("a recording is unfinished" if asked else "2 recordings are unfinished") in told


def test_an_unreadable_folder_hides_nothing_else(after_a_kill: Path) -> None:
    (after_a_kill / "unfinished" / "loop").symlink_to("loop")
    assert len(find(after_a_kill).recordings) == 1
    assert len(find(after_a_kill).unfinished) == 1
