"""Unexpected contents of a run's folder are refused, set aside or left alone, and never lost."""

from __future__ import annotations

import errno
import os
import shutil
import socket
import sys
from collections.abc import Callable
from contextlib import chdir
from pathlib import Path

import pytest
from support import generate as generating
from support.commands import exit_code
from support.generate import Remembers, run_fake
from support.recording import write_episode

from demorec.core.config import GenerateConfig
from demorec.core.errors import ConfigError, MissingDependencyError, ResourceError
from demorec.core.files import open_locked
from demorec.generate import contents
from demorec.generate.options import RunOptions, RunResult
from demorec.generate.run import generate
from demorec.runs.recorded import place_recording


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> RunResult:
    """A run of 8 episodes."""
    return run_fake(tmp_path_factory.mktemp("reference") / "run")


def content_of(folder: Path) -> dict[str, bytes | None]:
    """Relative path below a folder -> bytes, None for folders and special files."""
    return {str(p.relative_to(folder)): p.read_bytes() if p.is_file() else None for p in folder.rglob("*")}


def refuse_a_fixed_layout(out: Path) -> None:
    with pytest.raises(ConfigError, match="has no fixed layout"):
        generate(GenerateConfig(fixed=True), RunOptions(out=out))


def refuse_ray(out: Path) -> None:
    with pytest.raises(MissingDependencyError):
        generate(GenerateConfig(), RunOptions(out=out, executor="ray"))


@pytest.mark.parametrize("refuse", [refuse_a_fixed_layout, refuse_ray])
@pytest.mark.parametrize("there", ["nothing", "an empty folder", "a run", "files of somebody"])
def test_a_refused_request_writes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refuse: Callable[[Path], object], there: str
) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)  # not installed
    monkeypatch.delitem(sys.modules, "demorec.extensions.ray.on_ray", raising=False)
    out = tmp_path / "out"
    if there == "a run":
        run_fake(out, num_episodes=1)
    elif there != "nothing":
        out.mkdir()
    if there == "files of somebody":
        (out / "thesis.tex").write_text("mine")
    before = content_of(tmp_path)
    refuse(out)
    assert content_of(tmp_path) == before


def test_neither_another_run_nor_a_foreign_folder_changes(tmp_path: Path) -> None:
    run, stranger = tmp_path / "run", tmp_path / "stranger"
    run_fake(run, num_episodes=1)
    (run / ".lock").unlink()  # as after a copy that skips such files
    stranger.mkdir()
    (stranger / "thesis.tex").write_text("mine")
    before = content_of(tmp_path)
    for overwrite in (False, True):
        with pytest.raises(ConfigError, match="not part of a run"):
            run_fake(stranger, overwrite=overwrite)
    with pytest.raises(ConfigError, match="holds another run"):
        run_fake(run, seed=1)
    assert content_of(tmp_path) == before


def make_folder(path: Path) -> None:
    path.mkdir()
    (path / "mine.txt").write_text("mine")


def make_socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as made, chdir(path.parent):  # a socket's address is limited to 107 bytes
        made.bind(path.name)


def make_dangling_link(path: Path) -> None:
    path.symlink_to("nowhere")


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("make", [os.mkfifo, make_folder, make_socket, make_dangling_link])
def test_anything_with_the_name_of_a_recording_is_set_aside(
    tmp_path: Path, reference: RunResult, make: Callable[[Path], object], known: bool
) -> None:
    out = tmp_path / "run"
    shutil.copytree(reference.folder, out)
    victim = out / reference.run.successes[3].file
    victim.unlink()
    make(victim)
    if not known:
        (out / "run.json").unlink()
    heard = Remembers()
    result = run_fake(out, progress=heard)
    assert result.run.digest == reference.run.digest
    assert len(result.made) == 1
    assert victim.is_file()
    aside = out / "unfinished" / victim.name
    assert os.path.lexists(aside)
    assert not aside.is_file()
    assert [victim.name in said for said in heard.said] == [True]
    if make is make_folder:
        assert (aside / "mine.txt").read_text() == "mine"


def test_other_files_among_the_recordings_stay_where_they_are(tmp_path: Path, reference: RunResult) -> None:
    out = tmp_path / "run"
    shutil.copytree(reference.folder, out)
    (out / "episodes/notes.txt").write_text("mine")
    run_fake(out)
    assert (out / "episodes/notes.txt").read_text() == "mine"


@pytest.mark.parametrize("make", [os.mkfifo, lambda path: path.symlink_to("run.json")])
def test_a_lock_that_is_not_a_file_is_reported(
    tmp_path: Path, reference: RunResult, make: Callable[[Path], object]
) -> None:
    out = tmp_path / "run"
    shutil.copytree(reference.folder, out)
    (out / ".lock").unlink()
    make(out / ".lock")
    before = (out / "run.json").read_bytes()
    with pytest.raises(
        ConfigError, match=r"The lock of the run cannot be written \(it is .*, not a regular file\): .*\.lock"
    ):
        run_fake(out)
    assert (out / "run.json").read_bytes() == before


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (OSError(errno.EMFILE, "Too many open files"), "ulimit -n"),
        (OSError(errno.EIO, "Input/output error"), "storage"),
        (MemoryError(), "too little memory"),
    ],
)
@pytest.mark.parametrize("known", [True, False])
def test_nothing_is_set_aside_for_lack_of_resources(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reference: RunResult, error: Exception, words: str, known: bool
) -> None:
    out = tmp_path / "run"
    shutil.copytree(reference.folder, out)
    if not known:
        (out / "run.json").unlink()
    before = {path: data for path, data in content_of(out).items() if path != ".lock"}

    def fail(path: Path) -> str:
        raise error

    monkeypatch.setattr(contents, "sha256_of", fail)
    monkeypatch.setattr(generating, "read_text_limited", lambda path, limit: fail(path))
    with pytest.raises(ResourceError, match=words):
        run_fake(out)
    assert {path: data for path, data in content_of(out).items() if path != ".lock"} == before


@pytest.mark.parametrize("command", ["info", "check", "generate"])
@pytest.mark.parametrize("make", [os.mkfifo, lambda path: path.write_text("[" * 100_000)])
def test_a_run_json_that_cannot_be_read_is_one_sentence_for_every_command(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str, make: Callable[[Path], object]
) -> None:
    make(tmp_path / "run.json")
    words = [str(tmp_path)] if command != "generate" else ["--config", str(tmp_path), "--out", str(tmp_path / "copy")]
    assert exit_code(command, *words) in (1, 2)
    told = capsys.readouterr()
    assert "Traceback" not in told.err
    assert len((told.err or told.out).splitlines()) <= 8
    assert not (tmp_path / "copy").exists()


def test_leftovers_of_a_lost_worker_are_removed_with_its_episode(tmp_path: Path, reference: RunResult) -> None:
    """Files that are being written, third-party files and files of episodes that were not made are kept."""
    out = Path(shutil.copytree(reference.folder, tmp_path / "run"))
    left = {
        "node-1-0/episode_000002.attempt_0.mcap.part": False,
        "node-2-0/episode_000003.attempt_0.mcap": False,
        "node-3-0/episode_000900.attempt_0.mcap.part": True,
        "node-4-0/notes.txt": True,
        "node-5-0/episode_000004.attempt_0.mcap.part": True,
    }
    for name in left:
        (out / "unfinished" / name).parent.mkdir()
        (out / "unfinished" / name).write_bytes(b"half")
    handle = open_locked(out / "unfinished/node-5-0/episode_000004.attempt_0.mcap.part")
    run_fake(out)
    os.close(handle)
    stays = {name for name, is_kept in left.items() if is_kept}
    assert {str(path.relative_to(out / "unfinished")) for path in out.glob("unfinished/*/*")} == stays
    assert len(list(out.glob("unfinished/*"))) == len(stays)


@pytest.mark.parametrize("there", ["a text", "another episode", "the same episode"])
def test_a_recording_takes_the_name_of_no_other_file(tmp_path: Path, there: str) -> None:
    """As a worker of generate or evaluate chooses it."""
    made, target = write_episode(tmp_path / "made.mcap", num_frames=3), tmp_path / "episode.mcap"
    if there == "a text":
        target.write_text("years of work")
    else:
        write_episode(target, num_frames=3, episode_index=int(there == "another episode"))
    mine, new = target.read_bytes(), made.read_bytes()
    if there == "the same episode":
        place_recording(made, target)
        assert target.read_bytes() == new
        assert not made.exists()
        return
    with pytest.raises(ConfigError, match=f"left unchanged .*{target.name}.* is kept as .*{made.name}"):
        place_recording(made, target)
    assert (target.read_bytes(), made.read_bytes()) == (mine, new)
