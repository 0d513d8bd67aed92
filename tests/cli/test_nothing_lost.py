"""Commands that replace or delete are aimed at neighbouring files: nothing is lost, and they give the reason."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Sequence
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import pytest
from support.commands import exit_code
from support.export import export, files_of, make_run
from support.generate import run_fake
from support.recording import make_episode, write_episode

from demorec.cli.shared.paths import refuse_inside
from demorec.core.atomic import atomic_write
from demorec.core.config import GenerateConfig
from demorec.core.errors import ConfigError, DemorecError
from demorec.core.files import LOCK_NAME
from demorec.core.replacing import RECORDING, REPORT, REPORT_MARK, check_replaceable
from demorec.core.tables import EXPORTERS
from demorec.extensions.policies.evaluation import Evaluation, Settings, open_evaluation
from demorec.generate import reproduce as reproducing
from demorec.mcap import EpisodeWriter
from demorec.runs.find import EVALUATION_NAME


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a run, a recording and a dataset, to be copied."""
    folder = tmp_path_factory.mktemp("made")
    make_run(folder / "runs" / "run", (4, 5), cameras=("front",))
    write_episode(folder / "alone.mcap", num_frames=4, cameras=(), episode_index=7)
    export(folder / "runs" / "run", folder / "dataset")
    return folder


@pytest.fixture
def place(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A home folder; the user works in its folder `work`. Tests compare all of it afterwards."""
    home = tmp_path / "home"
    shutil.copytree(made, home)
    (home / "thesis").mkdir()
    (home / "thesis" / "chapter_1.tex").write_text("years of work")
    (home / "thesis.tex").write_text("years of work")
    for name in ("work", "repository", "mixed", "noted"):
        shutil.copytree(home / "dataset", home / name)
    (home / "repository" / ".git").mkdir()
    (home / "repository" / ".git" / "HEAD").write_text("ref: refs/heads/main")
    (home / "mixed" / "data" / "notes.txt").write_text("years of work")
    (home / "noted" / "notes").symlink_to(home / "thesis")
    for name in ("runs", "thesis", "mixed"):
        (home / f"link_to_{name}").symlink_to(home / name)
    (home / "link_to_nothing").symlink_to(home / "nothing")
    monkeypatch.setenv("HOME", str(home))
    monkeypatch.chdir(home / "work")
    return home


TARGETS = {
    "runs/run": "an input of this command is inside it",
    "runs/run/episodes": "of this command",
    "runs": "an input of this command is inside it",
    "link_to_runs": "an input of this command is inside it",
    ".": "an input of this command is inside it",
    "..": "an input of this command is inside it",
    "work": "it is the current folder",
    "repository": "it is a repository",
    "thesis": "it is not a LeRobot dataset",
    "link_to_thesis": "it is not a LeRobot dataset",
    "thesis.tex": "it is a file",
    "alone.mcap": "it is a file",
    "mixed": "data/notes.txt",
    "link_to_mixed": "data/notes.txt",
    "noted": "(notes)",
    "link_to_nothing": "a link whose target is missing",
}


@pytest.mark.parametrize("command", ["export lerobot runs/run --no-verify", "dataset select dataset --episodes 0"])
def test_a_dataset_replaces_only_datasets(place: Path, capsys: pytest.CaptureFixture[str], command: str) -> None:
    before = files_of(place.parent)
    name, kind, source, *options = command.split()
    for target, reason in TARGETS.items():
        arguments = (name, kind, place / source, *options, "--out", place / target)
        assert exit_code(*arguments, "--overwrite") == 2, target
        said = capsys.readouterr().err
        assert reason in said or name == "dataset"  # which reads no run
        assert len(said.splitlines()) == 1
        assert exit_code(*arguments) == 2, target  # without the flag the message does not suggest it
        assert "--overwrite" not in capsys.readouterr().err
    assert files_of(place.parent) == before


def test_the_home_folder_is_never_a_target(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = files_of(place.parent)
    elsewhere = write_episode(place.parent / "other.mcap", num_frames=3, cameras=())
    for target, word in (
        (place, "home folder"),
        (place.parent, "an input of this command is inside it"),
        (Path("/"), "input"),
    ):
        assert exit_code("export", "lerobot", elsewhere, "--out", target, "--overwrite", "--no-verify") == 2
        assert word in capsys.readouterr().err
    assert before.items() <= files_of(place.parent).items()


@pytest.mark.parametrize("target", ["mixed", "repository", "thesis", "thesis.tex", "noted"])
def test_append_keeps_existing_files_or_refuses(place: Path, target: str) -> None:
    """Foreign files are kept when appending; where that is impossible, and in a repository, nothing is appended."""
    before = files_of(place)
    other = make_run(place.parent / "other", (6,), cameras=("front",), seed=1)
    code = exit_code("export", "lerobot", other, "--out", place / target, "--append", "--no-verify")
    assert code == (0 if target == "mixed" else code or 1)
    after = files_of(place)
    kept = {name: data for name, data in before.items() if not name.startswith(target) or code}
    assert kept.items() <= after.items()
    assert (place / "mixed/data/notes.txt").read_text() == "years of work"


def test_a_third_party_workshop_is_left_alone(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    workshop = place / ".new.demorec-part"
    (workshop / "new").mkdir(parents=True)
    (workshop / "new" / "chapter_2.tex").write_text("years of work")
    before = files_of(place)
    assert exit_code("export", "hdf5", place / "runs/run", "--out", place / "new") == 2
    assert "not made by demorec" in capsys.readouterr().err
    assert files_of(place) == before


# A run: `generate --overwrite`.


@pytest.fixture(scope="module")
def run_made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of stand-in recordings, to be copied."""
    return run_fake(tmp_path_factory.mktemp("run") / "run", num_episodes=2).folder


@pytest.fixture
def run(run_made: Path, tmp_path: Path) -> Path:
    return shutil.copytree(run_made, tmp_path / "run")


@pytest.mark.parametrize(
    "foreign",
    ["episodes/notes.txt", "episodes/episode_000077.mcap", "episodes/mine.mcap", "failed/chapter/1.tex", "dataset"],
)
def test_a_run_with_foreign_files_is_not_overwritten(run: Path, made: Path, foreign: str) -> None:
    (run / foreign).parent.mkdir(exist_ok=True)
    if foreign == "dataset":
        shutil.copytree(made / "dataset", run / foreign)
    elif foreign == "episodes/mine.mcap":
        shutil.copy(made / "alone.mcap", run / foreign)
    else:
        (run / foreign).write_text("mine")
    before = {name: data for name, data in files_of(run).items() if name != ".lock"}
    with pytest.raises(ConfigError, match="not part of a run") as error:
        run_fake(run, num_episodes=2, seed=1, overwrite=True)
    assert foreign in str(error.value)
    with pytest.raises(ConfigError, match="holds another run") as error:
        run_fake(run, num_episodes=2, seed=1)
    assert "--overwrite" not in str(error.value)  # --overwrite would be refused
    assert {name: data for name, data in files_of(run).items() if name != ".lock"} == before


def test_a_run_that_contains_the_current_folder_is_not_overwritten(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = {name: data for name, data in files_of(run).items() if name != ".lock"}
    with monkeypatch.context() as patch:
        patch.setenv("HOME", str(run))
        with pytest.raises(ConfigError, match="it is the home folder"):
            run_fake(run, num_episodes=2, seed=1, overwrite=True)
    with monkeypatch.context() as patch:
        patch.chdir(run / "episodes")
        with pytest.raises(ConfigError, match="the current folder is inside it"):
            run_fake(run, num_episodes=2, seed=1, overwrite=True)
    (run / ".git").mkdir()
    with pytest.raises(ConfigError, match="it is a repository"):
        run_fake(run, num_episodes=2, seed=1, overwrite=True)
    assert {name: data for name, data in files_of(run).items() if name != ".lock"} == before


@pytest.mark.parametrize("origin", ["rendered", "imported", "imported, run.json lost", "imported among its own"])
def test_episodes_that_were_not_generated_are_not_overwritten(
    run: Path, place: Path, tmp_path: Path, origin: str
) -> None:
    folder = tmp_path / "others"
    if origin == "rendered":
        (folder / "episodes").mkdir(parents=True)
        info, frames, outcome = make_episode(num_frames=4, cameras=())
        info = replace(info, origin="render of episode_000000.mcap")
        with EpisodeWriter(folder / "episodes/episode_000000.mcap", info) as writer:
            for frame in frames:
                writer.write(frame)
            writer.finish(outcome)
    else:
        assert exit_code("import", "lerobot", place / "dataset", "--out", folder) == 0
    if origin == "imported, run.json lost":
        (folder / "run.json").unlink()
    if origin == "imported among its own":
        shutil.copy(folder / "episodes/episode_000000.mcap", run / "episodes/episode_000088.mcap")
        folder = run
    before = {name: data for name, data in files_of(folder).items() if name != ".lock"}
    with pytest.raises(ConfigError, match=r"not a run|episode_000088\.mcap|choose another --out"):
        run_fake(folder, num_episodes=2, seed=1, overwrite=True)
    assert {name: data for name, data in files_of(folder).items() if name != ".lock"} == before


# An evaluation.


def opened(settings: Settings, out: Path, *, overwrite: bool) -> Evaluation:
    with open_evaluation(settings, out, overwrite=overwrite) as found:
        return found


@pytest.fixture
def evaluation(tmp_path: Path, made: Path) -> Path:
    """An evaluation with a rollout in each folder."""
    out = tmp_path / "evaluation"
    opened(SETTINGS, out, overwrite=False)
    for place in ("episodes", "failed"):
        shutil.copy(made / "alone.mcap", out / place / "episode_000000.mcap")
    return out


SETTINGS = Settings(
    policy="p", policy_type="act", policy_digest="0" * 16, config=GenerateConfig(cameras=()), action="joint"
)


@pytest.mark.parametrize("foreign", ["episodes/notes.txt", "failed/thesis.mcap", "episodes/deep/er.txt"])
def test_an_evaluation_with_foreign_files_is_not_overwritten(evaluation: Path, foreign: str) -> None:
    (evaluation / foreign).parent.mkdir(exist_ok=True)
    (evaluation / foreign).write_text("mine")
    before = files_of(evaluation)
    with pytest.raises(ConfigError, match="not part of an evaluation") as error:
        opened(SETTINGS, evaluation, overwrite=True)
    assert foreign in str(error.value)
    with pytest.raises(ConfigError, match="Another evaluation") as error:
        opened(replace(SETTINGS, episode_length=7), evaluation, overwrite=False)
    assert "--overwrite" not in str(error.value)  # --overwrite would be refused
    assert files_of(evaluation) == before


@pytest.mark.parametrize("name", ["episodes/episode_000000.mcap", "thesis.txt"])
def test_a_folder_without_an_evaluation_is_not_overwritten(tmp_path: Path, name: str) -> None:
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text("mine")
    with pytest.raises(ConfigError, match="not part of an evaluation"):
        opened(SETTINGS, tmp_path, overwrite=True)
    assert files_of(tmp_path) == {name: b"mine"}


def test_overwriting_an_evaluation_keeps_other_files(evaluation: Path) -> None:
    (evaluation / "notes.txt").write_text("mine")
    opened(SETTINGS, evaluation, overwrite=True)
    assert files_of(evaluation).keys() == {EVALUATION_NAME, LOCK_NAME, "notes.txt"}


def test_an_evaluation_records_its_versions(evaluation: Path) -> None:
    plain = json.loads((evaluation / EVALUATION_NAME).read_text())
    for package in ("demorec", "numpy", "lerobot", "torch"):
        assert plain["versions"][package] == version(package)
    plain["versions"]["torch"] = "1.0"
    (evaluation / EVALUATION_NAME).write_text(json.dumps(plain))
    with pytest.raises(ConfigError, match=r"version of torch is 1\.0 there"):
        opened(SETTINGS, evaluation, overwrite=False)


@pytest.mark.parametrize("content", ["{}", "[]", "", '{"settings": 1, "rollouts": []}'])
def test_a_file_with_the_name_of_an_evaluation_is_kept(evaluation: Path, content: str) -> None:
    (evaluation / EVALUATION_NAME).write_text(content)
    before = files_of(evaluation)
    with pytest.raises(ConfigError, match="not an evaluation"):
        opened(SETTINGS, evaluation, overwrite=True)
    assert files_of(evaluation) == before


# Commands that write recordings, .rrd files, pages and datasets.


KEPT: dict[str, dict[str, str]] = {
    "recover broken.mcap --out": {
        "thesis.tex": "it is not a recording",
        "thesis": "it is a folder",
        "link_to_thesis": "it is a folder",
        "link_to_nothing": "a link whose target is missing",
        "broken.mcap": "needs a different name from the damaged one",
        "lock.mcap": "lock.mcap",
    },
    "view alone.mcap --save": {
        "alone.rrd": "it is not a Rerun file",  # a recording with the suffix of a Rerun file
        "thesis.rrd": "it is not a Rerun file",
        "link.rrd": "it is an input of this command",
        "folder.rrd": "it is a folder",
        "dangling.rrd": "a link whose target is missing",
        "lock.rrd": "lock.rrd",
    },
    "report alone.mcap --out": {
        "thesis.html": "it is not a report",
        "link.html": "it is an input of this command",
        "lock.html": "lock.html",
    },
    "report dataset --out": {"dataset/report.html": "A new file inside a dataset would prevent"},
    **{f"export {exporter} alone.mcap --out": {"lock": "lock"} for exporter in EXPORTERS.names()},
}
"""Command -> files that it must not overwrite, and part of the reason."""


@pytest.fixture
def full(place: Path) -> Path:
    """A home folder with a file under every name. An empty file may be another program's lock or marker."""
    (place / "broken.mcap").write_bytes((place / "alone.mcap").read_bytes()[:-500])
    shutil.copy(place / "alone.mcap", place / "alone.rrd")
    for suffix in ("rrd", "html", "json"):
        (place / f"thesis.{suffix}").write_text('{"episodes": []}')
        (place / f"link.{suffix}").symlink_to(place / "alone.mcap")
        (place / f"dangling.{suffix}").symlink_to(place / "nothing")
        (place / f"folder.{suffix}").mkdir()
    for name in ("lock", "lock.mcap", "lock.rrd", "lock.html"):
        (place / name).touch()
    (place / "dataset" / "report.html").write_text(REPORT_MARK)
    return place


@pytest.mark.parametrize("command", KEPT)
def test_a_command_replaces_its_own_files_only(full: Path, capsys: pytest.CaptureFixture[str], command: str) -> None:
    before = files_of(full.parent)
    *words, source, flag = command.split()
    for target, reason in KEPT[command].items():
        for flags in ((), ("--overwrite",)):
            assert exit_code(*words, full / source, flag, full / target, *flags) == 2, target
            said = capsys.readouterr().err
            assert len(said.splitlines()) == 1
            assert "--overwrite" not in said
        assert reason in said
    assert files_of(full.parent) == before


OWN = {
    "report --no-checks alone.mcap --out": "new.html",
    "recover broken.mcap --out": "new.mcap",
}


@pytest.mark.parametrize("command", OWN)
def test_own_files_are_replaced_on_request(full: Path, capsys: pytest.CaptureFixture[str], command: str) -> None:
    (full / "dataset/report.html").unlink()
    *words, source, flag = command.split()
    for flags, code in (((), 0), ((), 2), (("--overwrite",), 0)):
        assert exit_code(*words, full / source, flag, full / OWN[command], *flags) == code
        assert ("--overwrite" in capsys.readouterr().err) == (code == 2)


def test_the_output_of_another_recovery_stays(full: Path) -> None:
    (full / "x.mcap.recovering").write_text("years of work")
    before = files_of(full)
    assert exit_code("recover", full / "broken.mcap", "--out", full / "x.mcap") == 2
    assert files_of(full) == before


def test_render_never_replaces_its_inputs(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The command refuses before it renders, so stand-in recordings suffice."""
    copy = place / "copy"
    copy.mkdir()
    shutil.copy(place / "alone.mcap", copy / "alone.mcap")
    shutil.copy(place / "alone.mcap", copy / "second.mcap")
    (place / "link").symlink_to(copy)
    before = files_of(place.parent)
    for sources, out in (
        ((copy,), copy),
        ((copy,), place / "link"),
        ((place / "link",), copy),
        ((place / "alone.mcap", copy / "second.mcap"), copy),
        ((place / "runs/run", copy), copy),
        ((place / "runs/run",), place / "runs/run"),
        ((place / "runs/run",), place / "runs/run/new"),
        ((place / "runs/run/episodes/episode_000000.mcap",), place / "runs/run"),
    ):
        assert exit_code("render", *sources, "--out", out, "--overwrite") == 2
        assert "of this command" in capsys.readouterr().err
    assert files_of(place.parent) == before


def test_a_recording_replaces_recordings_only(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Test the writer that render and evaluate share."""
    info, _, _ = make_episode(num_frames=1, cameras=())
    before = files_of(place.parent)
    for target in ("thesis.tex", "thesis", "dataset", "link_to_thesis"):
        with pytest.raises(ConfigError, match="never replaced"):
            EpisodeWriter(place / target, info, overwrite=True)
    (place / "b.mcap.part").symlink_to(place / "thesis.tex")
    for overwrite in (False, True):
        with pytest.raises(DemorecError, match="in the way"):
            EpisodeWriter(place / "b.mcap", info, overwrite=overwrite)
    (place / "b.mcap.part").unlink()
    assert files_of(place.parent) == before


PARTS = ("runs/other/episodes", "runs/other/failed", "runs/other/unfinished", "runs/other/failed/new")
INSIDE: dict[str, Sequence[str]] = {
    "view alone.mcap --save": ("runs/other/episodes/v.rrd", "runs/other/failed/v.rrd", "dataset/data/v.rrd"),
    "report alone.mcap --out": ("runs/other/episodes/v.html", "dataset/v.html"),
    "render alone.mcap --out": ("runs/other/episodes", "dataset", "evaluation/failed", "runs/other/episodes/x.mcap"),
    "import lerobot dataset --out": PARTS,
    **{f"export {exporter} alone.mcap --out": (*PARTS, "dataset/a/b") for exporter in EXPORTERS.names()},
}


@pytest.mark.parametrize("command", INSIDE)
def test_nothing_is_written_into_another_run_or_dataset(
    place: Path, command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """The new file would be foreign there, and would keep --overwrite from replacing the folder."""
    for whole, mark in (("runs/other", "run.json"), ("evaluation", "evaluation.json")):
        for part in ("episodes", "failed", "unfinished"):
            (place / whole / part).mkdir(parents=True)
        (place / whole / mark).write_text("{}")
    before = files_of(place)
    *words, source, flag = command.split()
    for target in INSIDE[command]:
        (place / target).parent.mkdir(parents=True, exist_ok=True)
        assert exit_code(*words, place / source, flag, place / target) == 2, target
        assert "would prevent it from being replaced" in capsys.readouterr().err
    assert files_of(place) == before


def test_new_files_next_to_the_parts_of_a_run_are_accepted(place: Path) -> None:
    (place / "runs/run/run.json").write_text("{}")
    for target in (place / "runs/run/v.rrd", place / "v.rrd"):
        assert exit_code("view", place / "alone.mcap", "--save", target) == 0
    refuse_inside([place / "runs/run/dataset", place / "dataset", place / "renders/episodes/a.mcap"])


# The rule itself.


def test_special_files_are_never_replaced(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fifo")  # reading it would block forever
    for target in (tmp_path / "fifo", Path("/dev/null")):
        with pytest.raises(ConfigError, match="no regular file"):
            check_replaceable(target, RECORDING, overwrite=True)


def test_a_third_party_unfinished_file_is_kept(tmp_path: Path) -> None:
    part = tmp_path / ".x.html.demorec-part"
    part.write_text("mine")
    with pytest.raises(ConfigError, match="not made by demorec"), atomic_write(tmp_path / "x.html", REPORT):
        pass
    assert part.read_text() == "mine"


@pytest.mark.parametrize("out", ["runs/run", "runs/run/copy", "runs"])
def test_a_copy_needs_a_folder_outside_its_original(
    place: Path, out: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    source = place / "runs" / "run"
    original = reproducing.Original(
        source=source, config=GenerateConfig(), num_episodes=1, versions=(), digests={(0, 0): "x"}
    )
    monkeypatch.setattr(reproducing, "read_original", lambda path: original)
    before = files_of(place / "runs")
    assert exit_code("generate", "--config", source, "--out", place / out) == 2
    assert "needs a separate folder" in capsys.readouterr().err
    assert files_of(place / "runs") == before
