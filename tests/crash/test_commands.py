"""Every command that writes: killed, out of disk, surprised, interrupted twice, two at once, without streams.

A new command joins by one row. Whatever happens, its sources are unchanged, what it makes is absent, old or whole, and
the same command again gives the undisturbed result and leaves nothing else behind.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rerun.chunk import RrdReader
from support.check import simulate
from support.crash import Running, run_command
from support.export import content_of, export, files_of, make_run
from support.hdf5 import write_robomimic

from demorec.core.limited import VARIABLE
from demorec.sources.hdf5_suggest import suggested_hdf5_mapping

KILLS = 8
MINE = "years of work"
SLOW = (pytest.mark.slow,)
LONG = (pytest.mark.slow, pytest.mark.long)

pytestmark = pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")


@dataclass(frozen=True, kw_only=True)
class Row:
    """A command that writes.

    Attributes:
        call: Its words; SOURCES is a folder with a run, a dataset and recordings.
        targets: What it makes in the current folder, each whole or absent: a path, or a pattern.
        old: Words that make what the command replaces with `--overwrite`; "" for a command that has no such flag.
        resumes: Whether an interrupted command leaves finished targets, among which it goes on.
        surprise: A target that somebody else makes while the command runs.
        keeps: Whether the result is kept under another name then.
        flag: Lets the command replace what is there.
        runs: When the tests run.
    """

    call: str
    targets: tuple[str, ...]
    old: str = ""
    resumes: bool = False
    surprise: str = ""
    keeps: bool = True
    flag: str = "--overwrite"
    runs: tuple[pytest.MarkDecorator, ...] = ()

    @property
    def surprising(self) -> str:
        return self.surprise or self.targets[0]


ROWS = {
    "score": Row(
        call="dataset score SOURCES/dataset --out new.json",
        targets=("new.json",),
        old="dataset score SOURCES/other --out new.json",
    ),
    "split": Row(
        call="dataset split SOURCES/dataset --shares train=0.7 val=0.3 --seed 1 --out new",
        targets=("new/train", "new/val"),
        old="dataset split SOURCES/dataset --shares train=0.3 val=0.7 --seed 0 --out new",
        surprise="new/val",
    ),
    "view several": Row(
        call="view SOURCES/run --episodes 0:2 --save new.rrd",
        targets=("new-0000.rrd", "new-0001.rrd"),
        old="view SOURCES/reversed --episodes 0:2 --save new.rrd",
        surprise="new-0001.rrd",
        runs=SLOW,
    ),
    "import": Row(
        call="import lerobot SOURCES/dataset --out new",
        targets=("new/episodes/*.mcap",),
        surprise="new/episodes/episode_000001.mcap",
        resumes=True,
        keeps=False,
        runs=SLOW,
    ),
    "import hdf5": Row(
        call="import hdf5 SOURCES/demo.hdf5 --mapping SOURCES/hdf5.toml --out new",
        targets=("new/episodes/*.mcap",),
        surprise="new/episodes/episode_000001.mcap",
        resumes=True,
        keeps=False,
        runs=LONG,
    ),
    "export lerobot": Row(
        call="export lerobot SOURCES/run --no-verify --out new",
        targets=("new",),
        old="export lerobot SOURCES/run --episodes 1 --no-verify --out new",
        runs=SLOW,
    ),
    "export hdf5": Row(
        call="export hdf5 SOURCES/run --out new.hdf5",
        targets=("new.hdf5",),
        old="export hdf5 SOURCES/run --episodes 1 --out new.hdf5",
        runs=SLOW,
    ),
    "recover": Row(
        call="recover SOURCES/cut.mcap --out new.mcap",
        targets=("new.mcap",),
        old="recover SOURCES/other_cut.mcap --out new.mcap",
        runs=SLOW,
    ),
    "append": Row(
        call="export lerobot SOURCES/run --episodes 1: --no-verify --out new",
        targets=("new",),
        old="export lerobot SOURCES/run --episodes 0 --no-verify --out new",
        flag="--append",
        runs=LONG,
    ),
    "export lerobot with processes": Row(
        call="export lerobot SOURCES/run --no-verify --workers 2 --out new",
        targets=("new",),
        old="export lerobot SOURCES/run --episodes 1 --no-verify --out new",
        runs=LONG,
    ),
    "edit": Row(
        call="dataset select SOURCES/dataset --episodes 0:2 --out new",
        targets=("new",),
        old="dataset select SOURCES/dataset --episodes 2 --out new",
        runs=LONG,
    ),
    "merge": Row(
        call="dataset merge SOURCES/dataset SOURCES/other --out new",
        targets=("new",),
        old="dataset select SOURCES/dataset --episodes 2 --out new",
        runs=LONG,
    ),
    "report": Row(
        call="report SOURCES/dataset --no-checks --out new.html",
        targets=("new.html",),
        old="report SOURCES/run --no-checks --out new.html",
        runs=LONG,
    ),
    "view": Row(
        call="view SOURCES/run --episodes 0 --save new.rrd",
        targets=("new.rrd",),
        old="view SOURCES/run --episodes 1 --save new.rrd",
        runs=LONG,
    ),
    "replay": Row(
        call="replay SOURCES/e.mcap --out new",
        targets=("new/*.mcap",),
        surprise="new/e.mcap",
        resumes=True,
        runs=LONG,
    ),
    "render": Row(
        call="render SOURCES/e.mcap --cameras front --workers 1 --out new.mcap",
        targets=("new.mcap",),
        old="recover SOURCES/other_cut.mcap --out new.mcap",
        resumes=True,
        runs=LONG,
    ),
    "generate": Row(
        call="generate --num-episodes 2 --cameras none --workers 1 --no-export --no-check --out new",
        targets=("new/episodes/*.mcap",),
        surprise="new/notes.txt",
        resumes=True,
        keeps=False,
        runs=LONG,
    ),
}
"""All commands that write, but for imports of bags, screenshots, and evaluate and correct, which need a policy."""
NAMES = [pytest.param(name, marks=row.runs) for name, row in ROWS.items()]
KILLED = [pytest.param(name, marks=LONG if row.runs and row.old else row.runs) for name, row in ROWS.items()]
"""Replacing is killed, too, which is more."""
REPLACING = [pytest.param(name, marks=row.runs or SLOW) for name, row in ROWS.items() if row.old]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run, datasets and recordings, as small as they can be."""
    folder = tmp_path_factory.mktemp("sources").resolve()
    make_run(folder / "run", (4, 5, 6), cameras=("front",))
    make_run(folder / "reversed", (6, 4, 5), cameras=("front",))
    export(folder / "run", folder / "dataset")
    export(folder / "reversed", folder / "other")
    simulate(folder / "e.mcap", fps=10, max_episode_seconds=0.5, cameras=("front",), width=32, height=32)
    for name, source in (("cut", "run/episodes/episode_000000"), ("other_cut", "run/episodes/episode_000001")):
        (folder / f"{name}.mcap").write_bytes((folder / f"{source}.mcap").read_bytes()[:-400])
    hdf5 = write_robomimic(folder / "demo.hdf5")
    (folder / "hdf5.toml").write_text("\n".join(suggested_hdf5_mapping(hdf5)))
    return folder


@pytest.fixture
def sources(made: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The sources, compared afterwards."""
    monkeypatch.setenv(VARIABLE, "off")  # else each command forks once more
    before = files_of(made)
    yield made
    assert files_of(made) == before


class Case:
    """A row in a folder of its own, with the undisturbed result."""

    def __init__(self, name: str, sources: Path, folder: Path, *, replaces: bool) -> None:
        self.row, self.folder, self._sources = ROWS[name], folder / "work", sources
        self.words = self._words(self.row.call) + [self.row.flag] * replaces
        self._replaces = replaces
        self._start = folder / f"start_{replaces}"
        self._start.mkdir()
        if replaces:
            assert run_command(self._words(self.row.old), self._start).code == 0
        self.start_anew()
        self.before, self.all_before = self.state(), self.everything()
        ended = run_command(self.words, self.folder)
        assert ended.code == 0, ended.said
        self.num_changes = ended.num_changes
        self.after, self.all_after = self.state(), self.everything()
        assert self.after != self.before

    def _words(self, call: str) -> list[str]:
        return call.replace("SOURCES", str(self._sources)).split()

    def start_anew(self) -> None:
        """Empty the folder, and put the old into it."""
        shutil.rmtree(self.folder, ignore_errors=True)
        shutil.copytree(self._start, self.folder)

    def moments(self, count: int) -> list[int]:
        """Numbers of changes, spread from the first to the last."""
        return sorted({int(moment) for moment in np.linspace(1, self.num_changes, count)})

    def state(self) -> dict[str, Any]:
        """Each target that exists -> its content."""
        found = [path for target in self.row.targets for path in sorted(self.folder.glob(target))]
        return {path.relative_to(self.folder).as_posix(): comparable(path) for path in found}

    def everything(self) -> dict[str, Any]:
        """All files, hidden ones included."""
        return {name: comparable(self.folder / name) for name in files_of(self.folder) if not name.endswith(".lock")}

    def check_whole(self, told: object) -> None:
        """Check that each target is absent, old or whole, and no new one beside an old one."""
        state = self.state()
        assert state.items() <= self.before.items() or state.items() <= self.after.items(), told
        if len(self.row.targets) == 1 and not self.row.resumes:
            assert state in (self.before, self.after), told

    def check_again(self, told: object) -> None:
        """Run the same command again, unless its result is there: it gives the undisturbed one, and nothing else."""
        replaces_again = self._replaces and self.row.flag == "--overwrite"
        if self.state() != self.after or replaces_again or self.row.resumes:
            ended = run_command(self.words, self.folder)
            assert ended.code == 0, (told, ended.said)
            assert self.everything() == self.all_after, told
        assert self.state() == self.after, told


def comparable(path: Path) -> Any:
    """Content of a file or folder without what differs each time."""
    if path.suffix == ".rrd":
        return sorted((chunk.entity_path, chunk.num_rows) for chunk in RrdReader(path).stream())
    if path.name == "run.json":
        run = json.loads(path.read_text())
        lines = [{key: value for key, value in line.items() if key != "seconds"} for line in run["episodes"]]
        return {**run, "sessions": [], "episodes": lines}
    return content_of(path)


def kill(number: int) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def killed(case: Case) -> None:
    left_something = False
    for moment in case.moments(KILLS):
        case.start_anew()
        ended = run_command(case.words, case.folder, at=moment, act=kill)
        assert ended.code == -signal.SIGKILL
        left_something |= any(case.folder.iterdir())
        case.check_whole(moment)
        case.check_again(moment)
    assert left_something


@pytest.mark.parametrize("name", KILLED)
def test_killed_at_eight_moments(name: str, sources: Path, tmp_path: Path) -> None:
    killed(Case(name, sources, tmp_path, replaces=False))


@pytest.mark.parametrize("name", REPLACING)
def test_killed_at_eight_moments_of_replacing(name: str, sources: Path, tmp_path: Path) -> None:
    killed(Case(name, sources, tmp_path, replaces=True))


@pytest.mark.parametrize("name", NAMES)
def test_a_full_disk(name: str, sources: Path, tmp_path: Path) -> None:
    """A limit on the size of a file fails the write that crosses it, as a full disk does."""
    for replaces in {False, bool(ROWS[name].old)}:
        case = Case(name, sources, tmp_path, replaces=replaces)
        case.start_anew()
        largest = max(len(content) for content in files_of(case.folder).values()) if replaces else 0
        run_command(case.words, case.folder)
        largest = max(largest, *(len(content) for content in files_of(case.folder).values()))
        case.start_anew()
        ended = run_command(case.words, case.folder, max_bytes=largest // 3)
        assert ended.code == 1
        assert len(ended.said) == 1
        assert "unexpected" not in ended.said[0]
        case.check_whole("full disk")
        if not case.row.resumes:
            assert case.everything() == case.all_before
        case.check_again("full disk")


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

        ended = run_command(case.words, case.folder, at=(case.num_changes + 1) // 2, act=write)
        assert ended.code == 2
        assert len(ended.said) == 1
        assert mine.read_text() == MINE
        assert list(case.folder.rglob("*.tex")) == [mine] * is_folder
        if case.row.keeps:
            assert "is kept as" in ended.said[0]


@pytest.mark.parametrize("name", NAMES)
def test_two_at_once(name: str, sources: Path, tmp_path: Path) -> None:
    """One of them wins, and the other one says why it does not."""
    case = Case(name, sources, tmp_path, replaces=False)
    case.start_anew()
    reached, go_on = os.pipe(), os.pipe()

    def wait(number: int) -> None:
        if number == 0:
            os.write(reached[1], b"x")
            os.read(go_on[0], 1)

    first = Running(case.words, case.folder, at=(case.num_changes + 1) // 2, act=wait)
    os.close(reached[1])
    assert os.read(reached[0], 1) == b"x"  # nothing if it has ended
    second = run_command(case.words, case.folder)
    os.write(go_on[1], b"x")
    ended = [first.wait(), second]
    assert sorted(each.code for each in ended) == [0, 2]
    assert all(len(each.said) == 1 for each in ended if each.code)
    assert case.state() == case.after
    for descriptor in (reached[0], *go_on):
        os.close(descriptor)


@pytest.mark.parametrize("name", NAMES)
def test_a_second_interrupt_during_the_clean_up(name: str, sources: Path, tmp_path: Path) -> None:
    case = Case(name, sources, tmp_path, replaces=bool(ROWS[name].old))

    def interrupt(number: int) -> None:
        if number < 2:
            os.kill(os.getpid(), signal.SIGINT)

    for moment in case.moments(5)[1:-1]:
        case.start_anew()
        ended = run_command(case.words, case.folder, at=moment, act=interrupt)
        assert ended.code == 130, moment
        case.check_whole(moment)
        case.check_again(moment)


@pytest.mark.parametrize("name", [pytest.param(name, marks=SLOW if name == "split" else LONG) for name in ROWS])
def test_closed_streams(name: str, sources: Path, tmp_path: Path) -> None:
    """Nobody hears the answer, and nothing is half made."""
    case = Case(name, sources, tmp_path, replaces=False)
    program = [sys.executable, "-m", "demorec", *case.words]
    for line in ('"$@" >&-', '"$@" 2>&-', '"$@" | true; exit ${PIPESTATUS[0]}'):
        case.start_anew()
        ended = subprocess.run(
            ["bash", "-c", line, "bash", *program], cwd=case.folder, capture_output=True, check=False
        )
        assert ended.returncode in (0, 1), line
        case.check_whole(line)
        case.check_again(line)
