"""Every command that writes: killed, out of disk, surprised, interrupted twice, run twice at once, without streams.

A new command joins with one row. In every case its sources are unchanged, and its outputs are absent, old or complete.
The same command again gives the undisturbed result and leaves nothing else behind.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rerun.chunk import RrdReader
from support.commands import exit_code
from support.crash import Ended, Running, SmallDisk, on_small_disk, run_command
from support.crash_rows import LONG, MAKERS, ROWS, SLOW, make_base
from support.export import content_of, files_of
from support.options import TARGETS

from demorec.core.extension import reader_rows
from demorec.core.limited import VARIABLE

KILLS = 6
PROGRAM = """
from demorec.core.streams import open_closed_streams

open_closed_streams()

import sys

from support import crash_rows

crash_rows.{name}(sys.argv[1:])
"""
"""As `demorec/__main__.py` begins, with the program of a row."""
MINE = "years of work"

pytestmark = pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")


NAMES = [pytest.param(name, marks=row.runs) for name, row in ROWS.items()]
KILLED = [pytest.param(name, marks=LONG if row.runs and row.old else row.runs) for name, row in ROWS.items()]
"""Replacing is killed as well, which includes this case."""
REPLACING = [pytest.param(name, marks=row.runs or SLOW) for name, row in ROWS.items() if row.old]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sources").resolve()
    make_base(folder)
    return folder


@pytest.fixture
def sources(made: Path, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The command's inputs, compared afterwards."""
    monkeypatch.setenv(VARIABLE, "off")  # otherwise each command forks once more
    for name in ROWS[request.node.callspec.params["name"]].needs:
        if not (made / name).exists():
            MAKERS[name](made)
    before = files_of(made)
    yield made
    assert files_of(made) == before


class Case:
    """A row in a separate folder, with its undisturbed result."""

    def __init__(self, name: str, sources: Path, folder: Path, *, replaces: bool) -> None:
        self.row, self.folder, self._sources = ROWS[name], folder / "work", sources
        self.words = self._words(self.row.call) + [self.row.flag] * replaces
        self._replaces = replaces
        self._start = folder / f"start_{replaces}"
        self._start.mkdir()
        if replaces:
            assert self._run(self._words(self.row.old), self._start).code == 0
        self.start_anew()
        self.before, self.all_before = self.state(), self.everything()
        ended = self.run()
        assert ended.code == 0, ended.said
        self.num_changes = ended.num_changes
        self.after, self.all_after = self.state(), self.everything()
        assert self.after != self.before

    def _words(self, call: str) -> list[str]:
        return call.replace("SOURCES", str(self._sources)).split()

    def _run(self, words: list[str], folder: Path, **arguments: Any) -> Ended:
        return run_command(words, folder, program=self.row.program, **arguments)

    def run(self, **arguments: Any) -> Ended:
        """Run the command; arguments as of `Running`."""
        return self._run(self.words, self.folder, **arguments)

    def start_anew(self) -> None:
        """Empty the folder, and write the old output into it."""
        shutil.rmtree(self.folder, ignore_errors=True)
        shutil.copytree(self._start, self.folder)

    def moments(self, count: int) -> list[int]:
        """Numbers of changes, spread from the first to the last."""
        return sorted({int(moment) for moment in np.linspace(1, self.num_changes, count)})

    def state(self) -> dict[str, Any]:
        """Each existing target -> its content."""
        found = [path for target in self.row.targets for path in sorted(self.folder.glob(target))]
        return {path.relative_to(self.folder).as_posix(): comparable(path) for path in found}

    def everything(self) -> dict[str, Any]:
        """All files, hidden ones included."""
        return {name: comparable(self.folder / name) for name in files_of(self.folder) if not name.endswith(".lock")}

    def check_whole(self, told: object) -> None:
        """Check that each target is absent, old or whole, and that no new one exists next to an old one."""
        state = self.state()
        assert state.items() <= self.before.items() or state.items() <= self.after.items(), told
        if len(self.row.targets) == 1 and not self.row.resumes:
            assert state in (self.before, self.after), told

    def check_again(self, told: object) -> None:
        """Run the same command again, unless it has finished: it gives the undisturbed result, and nothing else."""
        replaces_again = self._replaces and self.row.flag == "--overwrite"
        if self.state() != self.after or replaces_again or self.row.resumes:
            ended = self.run()
            assert ended.code == 0, (told, ended.said)
            assert self.everything() == self.all_after, told
        assert self.state() == self.after, told


def comparable(path: Path) -> Any:
    """Content of a file or folder without the parts that differ in every run."""
    if path.suffix == ".rrd":
        return sorted((chunk.entity_path, chunk.num_rows) for chunk in RrdReader(path).stream())
    if path.name == "run.json":
        run = json.loads(path.read_text())
        lines = [{key: value for key, value in line.items() if key != "seconds"} for line in run["episodes"]]
        export = {**run["export"], "seconds": 0.0} if run.get("export") else None
        return {**run, "episodes": lines, "export": export}
    return content_of(path)


def kill(number: int) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def killed(case: Case) -> None:
    left_something = False
    for moment in case.moments(KILLS):
        case.start_anew()
        ended = case.run(at=moment, act=kill)
        assert ended.code == -signal.SIGKILL
        left_something |= any(case.folder.iterdir())
        case.check_whole(moment)
        case.check_again(moment)
    assert left_something


@pytest.mark.slow
@pytest.mark.parametrize("name", KILLED)
def test_killed_at_six_moments(name: str, sources: Path, tmp_path: Path) -> None:
    killed(Case(name, sources, tmp_path, replaces=False))


@pytest.mark.parametrize("name", REPLACING)
def test_killed_at_six_moments_of_replacing(name: str, sources: Path, tmp_path: Path) -> None:
    killed(Case(name, sources, tmp_path, replaces=True))


def check_full(case: Case, ended: Ended) -> None:
    """Check the message and leftovers of a command on a full disk, and its result on a disk with room.

    It succeeds where the disk has just enough room.
    """
    if ended.code == 0:
        assert case.state() == case.after
        return
    assert ended.code == 1
    assert len(ended.said) == 1
    assert "unexpected" not in ended.said[0]
    case.check_whole("full disk")
    if not case.row.resumes:
        assert case.everything() == case.all_before


@pytest.mark.parametrize("name", [pytest.param(name, marks=row.runs or SLOW) for name, row in ROWS.items()])
def test_a_full_file_system(name: str, sources: Path, tmp_path: Path) -> None:
    """A real file system, with no room, and with room for most of the output."""

    def work(disk: SmallDisk) -> None:
        for replaces in {False, bool(ROWS[name].old)}:
            case = Case(name, sources, disk.folder, replaces=replaces)
            page = os.statvfs(disk.folder).f_frsize
            written = [len(content) for file, content in files_of(case.folder).items() if not file.endswith(".lock")]
            num_pages = sum(-(-size // page) for size in written)
            codes = set()
            for room in {0, num_pages * 2 // 3, num_pages - 1}:
                case.start_anew()
                disk.resize(disk.num_used + room * page)
                ended = case.run()
                disk.resize()
                check_full(case, ended)
                case.check_again(room)
                codes.add(ended.code)
            assert 1 in codes

    (tmp_path / "disk").mkdir()
    on_small_disk(tmp_path / "disk", work)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_a_target_that_appears_meanwhile_stays(name: str, sources: Path, tmp_path: Path) -> None:
    for replaces in {False, bool(ROWS[name].old)}:
        case = Case(name, sources, tmp_path, replaces=replaces)
        case.start_anew()
        target = case.folder / case.row.surprising
        is_folder = isinstance(case.after[case.row.surprising], dict) and "" not in case.after[case.row.surprising]
        mine = target / "thesis.tex" if is_folder else target

        def write(number: int, target: Path = target, mine: Path = mine) -> None:
            if number == 0:
                shutil.rmtree(target) if target.is_dir() else target.unlink(missing_ok=True)
                mine.parent.mkdir(parents=True, exist_ok=True)
                mine.write_text(MINE)

        ended = case.run(at=(case.num_changes + 1) // 2, act=write)
        assert ended.code == 2
        assert len(ended.said) == 1
        assert mine.read_text() == MINE
        assert list(case.folder.rglob("*.tex")) == [mine] * is_folder
        if case.row.keeps:
            assert "is kept as" in ended.said[0]


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_two_at_once(name: str, sources: Path, tmp_path: Path) -> None:
    """One of them wins, and the other one reports the reason."""
    case = Case(name, sources, tmp_path, replaces=False)
    case.start_anew()
    reached, go_on = os.pipe(), os.pipe()

    def wait(number: int) -> None:
        if number == 0:
            os.write(reached[1], b"x")
            os.read(go_on[0], 1)

    half = (case.num_changes + 1) // 2
    first = Running(case.words, case.folder, program=case.row.program, at=half, act=wait)
    os.close(reached[1])
    assert os.read(reached[0], 1) == b"x"  # nothing if it has ended
    second = case.run()
    os.write(go_on[1], b"x")
    ended = [first.wait(), second]
    assert sorted(each.code for each in ended) == [0, 2]
    assert all(len(each.said) == 1 for each in ended if each.code)
    assert case.state() == case.after
    for descriptor in (reached[0], *go_on):
        os.close(descriptor)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_a_second_interrupt_during_the_clean_up(name: str, sources: Path, tmp_path: Path) -> None:
    case = Case(name, sources, tmp_path, replaces=bool(ROWS[name].old))

    def interrupt(number: int) -> None:
        if number < 2:
            os.kill(os.getpid(), signal.SIGINT)

    for moment in case.moments(5)[1:-1]:
        case.start_anew()
        ended = case.run(at=moment, act=interrupt)
        assert ended.code == 130, moment
        case.check_whole(moment)
        case.check_again(moment)


@pytest.mark.parametrize("name", [pytest.param(name, marks=SLOW if name == "split" else LONG) for name in ROWS])
def test_closed_streams(name: str, sources: Path, tmp_path: Path) -> None:
    """The output is lost, and no target is left incomplete."""
    case = Case(name, sources, tmp_path, replaces=False)
    program = [sys.executable, "-c", PROGRAM.format(name=case.row.program.__name__), *case.words]
    for line in ('"$@" >&-', '"$@" 2>&-', '"$@" | true; exit ${PIPESTATUS[0]}'):
        case.start_anew()
        ended = subprocess.run(
            ["bash", "-c", line, "bash", *program],
            cwd=case.folder,
            env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])},
            capture_output=True,
            check=False,
        )
        assert ended.returncode in (0, 1), line
        case.check_whole(line)
        case.check_again(line)


@pytest.mark.slow
@pytest.mark.parametrize("name", ROWS)
def test_an_unwritable_target_is_exit_code_2(
    name: str, sources: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Tests of options have names that are too long, not UTF-8 or below a file."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "lerobot", None)  # as some programs do; undone after the test
    Path("link").symlink_to("nothing")
    call = ROWS[name].call.replace("SOURCES", str(sources))
    for place in ("/proc/new", "link/new"):
        assert exit_code(*call.replace(" new", f" {place}").split(), program=ROWS[name].program) == 2
        (said,) = (line for line in capsys.readouterr().err.splitlines() if line.startswith("demorec "))
        assert place in said
    assert [path.name for path in tmp_path.iterdir()] == ["link"]


def test_every_command_that_writes_has_a_row() -> None:
    words = {option: " ".join(option.command) for option in TARGETS if option.command != ("export",)}
    wanted = {(head, option.name) for option, head in words.items()}
    wanted |= {(f"import {word}", "out") for row in reader_rows().values() if (word := row.word)}
    calls = [row.call for row in ROWS.values()]
    without = {
        (head, flag) for head, flag in wanted if not any(c.startswith(f"{head} ") and f"--{flag} " in c for c in calls)
    }
    assert not without, "each needs a row in tests/support/crash_rows.py"
    assert any(call.startswith("import SOURCES") for call in calls)
