"""Imports of many bags: an unreadable bag does not stop the others; interrupts do not change the result."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin
from support import bag_mappings, bags
from support.check import result_of
from support.commands import exit_code

from demorec.core.errors import ConfigError, DemorecError
from demorec.episode.info import Origin
from demorec.extensions.imports import planning
from demorec.extensions.imports.bag_files import BagError
from demorec.extensions.imports.import_file import BagReport
from demorec.extensions.imports.import_run import import_bags
from demorec.mcap import Recording
from demorec.runs.run_file import load_any_run_file

pytestmark = pytest.mark.slow

FRONT = "/follower/cam_front/image_raw/compressed"


def _bag(path: Path, seconds: float = 0.6, change: Callable[[bags.Notes], bags.Notes] = lambda notes: notes) -> Path:
    return bags.write_mcap(change(bags.in_order(bags.so101(seconds))), path)


def _resized(notes: bags.Notes) -> bags.Notes:
    data = np.frombuffer(bags.jpeg(np.zeros((24, 32, 3), np.uint8)), np.uint8)
    return bags.changed(notes, FRONT, lambda k, note: bags.with_body(note, data=data))


def _named(notes: bags.Notes, name: str) -> bags.Notes:
    names = [name, *bags.SO101_JOINTS[1:]]
    return bags.changed(notes, "/follower/joint_states", lambda k, note: bags.with_body(note, name=names))


def _recorded(note: bags.Note, time_ns: int) -> bags.Note:
    """Move a message to that recording time, with an empty header time."""
    return replace(note, log_ns=note.log_ns - bags.EPOCH_NS + time_ns, header_ns=0)


BAD: dict[str, tuple[Callable[[Path], object], str]] = {
    "empty": (lambda path: path.write_bytes(b""), "The bag is empty"),
    "text": (lambda path: path.write_text("hello"), "This is not "),
    "cut": (lambda path: path.write_bytes(path.read_bytes()[:2000]), "The bag holds no messages"),
    "no camera": (
        lambda path: _bag(path, change=lambda notes: [note for note in notes if note.topic != FRONT]),
        f"no message of '{FRONT}'",
    ),
    "another size": (lambda path: _bag(path, change=_resized), "camera front is 64x48 jpeg there and 32x24 jpeg here"),
    "escape codes": (
        lambda path: _bag(path, change=lambda notes: _named(notes, "a\x1b[2J")),
        "elements of the feature 'observation.state' is called 'a\\x1b[2J'",
    ),
    "year 2043": (
        lambda path: _bag(path, change=lambda notes: [_recorded(note, 2**61) for note in notes]),
        "a message has the time 2305843009 s, allowed are 0 to 2147483647 s",
    ),
}


def _batch(folder: Path) -> tuple[Path, Path]:
    """A mapping and a folder in which every other bag is bad, each for a different reason."""
    (folder / "bags").mkdir(parents=True)
    for number, (spoil, _) in enumerate(BAD.values()):
        _bag(folder / "bags" / f"run_{2 * number}.mcap", 0.5 + 0.1 * number)
        spoil(_bag(folder / "bags" / f"run_{2 * number + 1}.mcap"))
    return folder / "bags", bag_mappings.write_mapping(bag_mappings.SO101, folder / "robot.toml")


@pytest.fixture(scope="module")
def batch(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    return _batch(tmp_path_factory.mktemp("batch"))


def _files(recording: Recording) -> list[str]:
    origin = recording.info.origin
    assert isinstance(origin, Origin)
    return [file.name for file in origin.files]


def _content(run: Path) -> dict[str, bytes]:
    """Recordings and import.json, which have neither the author nor the time of the import."""
    return {path.name: path.read_bytes() for path in [*run.glob("episodes/*"), run / "import.json"]}


@pytest.fixture(scope="module")
def alone(batch: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run that a single process makes."""
    run = tmp_path_factory.mktemp("alone") / "run"
    import_bags([batch[0]], batch[1], run, skip_bad=True)
    return run


def test_bad_bags_are_skipped_and_listed(
    batch: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, mapping = batch
    run = tmp_path / "run"
    assert exit_code("import", folder, "--mapping", mapping, "--out", run, "--skip-bad") == 1
    lines = capsys.readouterr().out.splitlines()
    header = lines[-len(BAD) - 1]
    assert header == f"Skipped {len(BAD)} of {2 * len(BAD)} bags:"
    for number, (line, (_, reason)) in enumerate(zip(lines[-len(BAD) :], BAD.values(), strict=True)):
        assert line.startswith(f"  {folder / f'run_{2 * number + 1}.mcap'}: ")
        assert reason in line
    assert len(load_any_run_file(run).attempts) == len(BAD)
    for number in range(len(BAD)):
        with Recording(run / "episodes" / f"episode_{number:06d}.mcap") as recording:
            assert _files(recording) == [f"run_{2 * number}.mcap"]
    assert exit_code("info", run) == 0
    shown = capsys.readouterr().out
    assert exit_code("info", run, "--json") == 0
    left_out = json.loads(capsys.readouterr().out)["left_out"]
    for number, (_, reason) in enumerate(BAD.values()):
        assert left_out[number]["bag"] == f"run_{2 * number + 1}.mcap"
        assert reason in left_out[number]["reason"]
        assert left_out[number]["reason"] in shown
    judged = result_of(run, "import_findings", "run")
    assert judged.findings[0].value == str(len(BAD))
    assert "run_1.mcap: The bag is empty" in judged.findings[0].message


def test_each_bag_of_a_batch_is_reported_in_order(batch: tuple[Path, Path], alone: Path, tmp_path: Path) -> None:
    done: list[tuple[int, int]] = []
    told: list[BagReport] = []
    result = import_bags(
        [batch[0]], batch[1], tmp_path / "run", skip_bad=True, tell=told.append, progress=lambda *c: done.append(c)
    )
    assert _content(tmp_path / "run") == _content(alone)
    assert load_any_run_file(tmp_path / "run").digest == load_any_run_file(alone).digest
    assert tuple(told) == result.reports
    assert done == [(count, 2 * len(BAD)) for count in range(2 * len(BAD) + 1)]


def test_a_bag_that_was_repaired_is_imported_and_one_that_was_not_is_listed_again(tmp_path: Path) -> None:
    folder, mapping = _batch(tmp_path)
    run = tmp_path / "run"
    import_bags([folder], mapping, run, skip_bad=True)
    before = _content(run)
    again = import_bags([folder], mapping, run, skip_bad=True)
    assert (again.num_new, len(again.skipped)) == (0, len(BAD))
    assert _content(run) == before
    _bag(folder / "run_1.mcap", 1.3)
    result = import_bags([folder], mapping, run, skip_bad=True)
    assert (result.num_new, len(result.skipped)) == (1, len(BAD) - 1)
    assert folder / "run_1.mcap" not in result.skipped
    after = _content(run)
    assert {name: data for name, data in after.items() if name in before and name != "import.json"} == {
        name: data for name, data in before.items() if name != "import.json"
    }
    with Recording(run / "episodes" / f"episode_{len(BAD):06d}.mcap") as recording:
        assert _files(recording) == ["run_1.mcap"]
    skipped = json.loads((run / "import.json").read_text())["skipped"]
    assert [bag["name"] for bag in skipped] == [f"run_{2 * number + 1}.mcap" for number in range(1, len(BAD))]


def test_errors_other_than_bad_bags_stop_a_batch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A mistyped name, a full disk and too little memory stop the batch."""
    bag, run = _bag(tmp_path / "a.mcap"), tmp_path / "run"
    mapping = bag_mappings.write_mapping(bag_mappings.SO101, tmp_path / "robot.toml")
    with pytest.raises(ConfigError, match="No readable bag"):
        import_bags([bag, tmp_path / "b.mcap"], mapping, run, skip_bad=True)
    full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    for place, name, error, words in (
        (planning, "read_streams", MemoryError(), "too little memory"),
        (os, "fsync", full, "No space left"),
    ):

        def fails(*arguments: object, error: Exception = error) -> None:
            raise error

        with monkeypatch.context() as patched:
            patched.setattr(place, name, fails)
            with pytest.raises(DemorecError, match=words):
                import_bags([bag], mapping, run, skip_bad=True)
    assert import_bags([bag], mapping, run, skip_bad=True).num_new == 1


def test_the_same_bag_twice_is_imported_once(tmp_path: Path) -> None:
    first = _bag(tmp_path / "a.mcap")
    copy = tmp_path / "copy" / "a.mcap"
    copy.parent.mkdir()
    copy.write_bytes(first.read_bytes())
    mapping = bag_mappings.write_mapping(bag_mappings.SO101, tmp_path / "robot.toml")
    assert import_bags([first, first, copy], mapping, tmp_path / "run").num_new == 1


def test_a_folder_means_its_bags_in_natural_order(tmp_path: Path) -> None:
    folder, notes = tmp_path / "day", bags.in_order(bags.so101(0.5))
    folder.mkdir()
    bags.write_ros1(notes, folder / "run_10.bag")
    bags.write_rosbag2(bags.in_order(bags.so101(0.6)), folder / "run_2")
    bags.write_rosbag2(bags.in_order(bags.so101(0.7)), folder / "run_1", storage=StoragePlugin.SQLITE3)
    bags.write_rosbag2(bags.in_order(bags.so101(0.8)), folder / "run_3")
    (folder / "run_3" / "metadata.yaml").unlink()  # as after a crash of the recorder
    (folder / "notes.txt").write_text("Tuesday")
    (folder / "photos").mkdir()
    mapping = bag_mappings.write_mapping(bag_mappings.SO101, tmp_path / "robot.toml")
    result = import_bags([folder], mapping, tmp_path / "run")
    assert [report.name for report in result.reports] == ["run_1", "run_2", "run_3.mcap", "run_10.bag"]
    assert exit_code("import", "--suggest", folder) == 0
    with pytest.raises(BagError, match=r"holds no metadata.yaml.* and no bags"):
        import_bags([folder / "photos"], mapping, tmp_path / "run")


def test_flags_of_other_sources_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_code("import", "hdf5", "x", "--mapping", "x", "--skip-bad", "--out", tmp_path / "run") == 2
    assert "--skip-bad: only for datasets" in capsys.readouterr().err


def test_bags_before_a_bad_one_are_imported(tmp_path: Path) -> None:
    good = [_bag(tmp_path / f"{number}.mcap", 0.5 + 0.1 * number) for number in range(3)]
    good[1].write_bytes(b"")
    mapping, run = bag_mappings.write_mapping(bag_mappings.SO101, tmp_path / "robot.toml"), tmp_path / "run"
    with pytest.raises(BagError, match="The bag is empty"):
        import_bags(good, mapping, run)
    assert [path.name for path in run.glob("episodes/*")] == ["episode_000000.mcap"]
    assert len(load_any_run_file(run).attempts) == 1
