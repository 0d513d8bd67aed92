"""Every command that reads a dataset detects missing episodes and rows of other episodes.

One damaged file affects only its own episode.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from support.check import change_table, checked, edit_json, edit_parquet
from support.commands import exit_code, words_of
from support.drawn_datasets import write_v21
from support.export import content_of, export, export_in_files, make_run, recordings

NUM_EPISODES, LENGTH = 4, 8
READERS = {
    "info": "info PATH",
    "check": "check PATH --only unreadable_episodes contradicting_counts",
    "view": "view PATH --episodes 1 --save NEW.rrd",
    "export-hdf5": "export hdf5 PATH --out NEW.hdf5",
    "export-lerobot": "export lerobot PATH --out NEW --no-verify",
    "import": "import lerobot PATH --out NEW",
    "select": "dataset select PATH --episodes 0:3 --out NEW",
    "drop": "dataset drop PATH --episodes 0 --out NEW",
    "trim": "dataset trim PATH --head 1 --out NEW",
    "trim-idle": "dataset trim PATH --idle --out NEW",
    "cut": "dataset cut PATH --at 1=3 --out NEW",
    "split": "dataset split PATH --shares a=0.5 b=0.5 --out NEW",
    "merge": "dataset merge PATH PATH --out NEW",
    "rename": "dataset rename PATH action=command --out NEW",
    "drop-features": "dataset drop-features PATH next.reward --out NEW",
    "set-task": "dataset set-task PATH --task push --out NEW",
    "reorder": "dataset reorder PATH --order 3,2,1,0 --out NEW",
    "shuffle": "dataset shuffle PATH --out NEW",
    "diff": "dataset diff PATH PATH",
}
"""Command -> its call with a PATH; names of outputs begin with NEW."""


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_run(tmp_path_factory.mktemp("whole") / "run", [LENGTH] * NUM_EPISODES, cameras=("front",))


@pytest.fixture(scope="module")
def exported(run: Path) -> Path:
    """A dataset with all rows in one file, and all images in another."""
    export(run, run / "dataset")
    return run / "dataset"


@pytest.fixture(scope="module")
def apart(run: Path) -> Path:
    """The same dataset with separate files for each episode."""
    export_in_files(run, run.parent / "apart", data_mb=1e-6, video_mb=1e-6)
    assert len(list((run.parent / "apart").glob("data/*/*.parquet"))) == NUM_EPISODES
    return run.parent / "apart"


def without_table(root: Path) -> None:
    shutil.rmtree(root / "meta/episodes")


def short_table(root: Path) -> None:
    change_table(root, "meta/episodes", lambda table: table.slice(0, NUM_EPISODES - 1))


def short_table_and_info(root: Path) -> None:
    """The counts of info.json fit, and only the rows show that an episode is missing."""
    short_table(root)
    totals = {"total_episodes": NUM_EPISODES - 1, "total_frames": (NUM_EPISODES - 1) * LENGTH}
    edit_json(root / "meta/info.json", lambda info: info.update(totals))


def longer_episode(root: Path) -> None:
    (path,) = root.glob("meta/episodes/*/*.parquet")
    edit_parquet(path, "length", lambda lengths: [*lengths[:-1], LENGTH + 1])


def exchanged_rows(root: Path) -> None:
    """Swap a row of episode 1 with the same one of episode 2."""
    order = np.arange(NUM_EPISODES * LENGTH)
    order[[LENGTH + 2, 2 * LENGTH + 2]] = order[[2 * LENGTH + 2, LENGTH + 2]]
    change_table(root, "data", lambda table: table.take(pa.array(order)))


def rows_of_one_episode_exchanged(root: Path) -> None:
    order = np.arange(NUM_EPISODES * LENGTH)
    order[[LENGTH + 2, LENGTH + 3]] = order[[LENGTH + 3, LENGTH + 2]]
    change_table(root, "data", lambda table: table.take(pa.array(order)))


FAULTS: dict[str, tuple[Callable[[Path], None], tuple[str, ...]]] = {
    "an episode less in the table": (short_table, ("is incomplete", "total_episodes is 4, found 3")),
    "an episode less in table and info": (short_table_and_info, ("has 32 rows",)),
    "an episode that is longer": (longer_episode, ("is incomplete", "total_frames is 32, found 33")),
    "rows exchanged between episodes": (exchanged_rows, ("belong to another",)),
    "rows exchanged in an episode": (rows_of_one_episode_exchanged, ("belong to another",)),
}
"""Fault -> function that makes it, and phrases of which one must name it."""
EVERY_FAULT = ("info", "check", "view", "import", "select")
"""Commands that are tried with every fault; the others open a dataset as `select` does."""


def wrong_files(root: Path) -> None:
    """The table assigns the rows of all episodes to the first data file, as some converters did (lerobot#2401)."""
    zeros = pa.array([0] * NUM_EPISODES, pa.int64())
    name = "data/file_index"
    change_table(root, "meta/episodes", lambda table: table.set_column(table.schema.get_field_index(name), name, zeros))


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize("spoil", [without_table, wrong_files])
@pytest.mark.parametrize("command", EVERY_FAULT)
def test_episodes_missing_from_the_table_are_found_by_the_rows(
    command: str, spoil: Callable[[Path], None], apart: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = Path(shutil.copytree(apart, tmp_path / "d"))
    spoil(root)
    before = content_of(root)
    assert exit_code(*words_of(READERS[command], root, tmp_path / "new")) == (1 if command == "check" else 0)
    captured = capsys.readouterr()
    assert (captured.out + captured.err).count("found by the episode_index") == 1
    assert content_of(root) == before
    assert exit_code(*words_of(READERS[command], apart, tmp_path / "whole")) == 0
    for path in (tmp_path / "whole").rglob("*"):
        if path.suffix in (".mp4", ".mcap") or path.match("data/*/*.parquet"):
            assert (tmp_path / "new" / path.relative_to(tmp_path / "whole")).read_bytes() == path.read_bytes()


def test_an_old_dataset_without_its_table_is_found_by_the_rows(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    roots = [write_v21(tmp_path / name) for name in ("whole", "spoilt")]
    (roots[1] / "meta/episodes.jsonl").unlink()
    for root in roots:
        assert exit_code("view", root, "--save", tmp_path / f"{root.name}.rrd") == 0
        assert exit_code("dataset", "select", root, "--episodes", "0,1", "--out", tmp_path / f"{root.name}-new") == 0
    assert "found by the episode_index" in capsys.readouterr().err
    tables = [pq.read_table(tmp_path / f"{root.name}-new" / "data") for root in roots]
    assert tables[0].equals(tables[1])


def test_a_dataset_without_episodes_is_reported_as_empty(exported: Path, tmp_path: Path) -> None:
    root = Path(shutil.copytree(exported, tmp_path / "d"))
    for place in ("meta/episodes", "data"):
        change_table(root, place, lambda table: table.slice(0, 0))
    edit_json(root / "meta/info.json", lambda info: info.update(total_episodes=0, total_frames=0))
    assert exit_code("view", root, "--save", tmp_path / "new.rrd") == 2


@pytest.mark.parametrize(
    ("command", "fault"),
    [
        (command, fault)
        for command in READERS
        for fault in FAULTS
        if command in EVERY_FAULT or fault == "rows exchanged between episodes"
    ],
)
def test_an_incomplete_dataset_is_refused(
    command: str, fault: str, exported: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = Path(shutil.copytree(exported, tmp_path / "d"))
    spoil, words = FAULTS[fault]
    spoil(root)
    before = content_of(root)
    code = exit_code(*words_of(READERS[command], root, tmp_path / "new"))
    assert code == {"info": 0, "diff": 2}.get(command, 1)  # info lists problems, and 1 of diff means a difference
    captured = capsys.readouterr()
    assert any(text in captured.out + captured.err for text in words)
    assert content_of(root) == before
    written = [path for path in tmp_path.glob("new*") for path in (path, *path.rglob("*")) if path.is_file()]
    # An import continues with the recordings, and a split writes its parts one after the other.
    assert not written or (command in ("import", "split") and fault.startswith("rows exchanged"))


@pytest.mark.slow
def test_the_commands_succeed_on_the_complete_dataset(
    exported: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    codes = {name: exit_code(*words_of(call, exported, tmp_path / name)) for name, call in READERS.items()}
    assert codes == dict.fromkeys(READERS, 0), capsys.readouterr().err


@pytest.mark.parametrize("fault", ["an episode less in table and info", "rows exchanged between episodes"])
def test_an_incomplete_dataset_is_not_appended_to(
    fault: str, run: Path, exported: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = Path(shutil.copytree(exported, tmp_path / "d"))
    FAULTS[fault][0](root)
    before = content_of(root)
    assert exit_code("export", "lerobot", recordings(run)[0], "--out", root, "--append", "--no-verify") == 1
    told = capsys.readouterr().err
    assert "is incomplete" in told or "belong to another" in told
    assert content_of(root) == before


@pytest.mark.parametrize("fault", ["an episode less in table and info", "rows exchanged between episodes"])
def test_a_report_names_the_fault(
    fault: str, exported: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = Path(shutil.copytree(exported, tmp_path / "d"))
    spoil, words = FAULTS[fault]
    spoil(root)
    code = exit_code("report", root, "--no-checks", "--out", tmp_path / "page.html")
    told = (tmp_path / "page.html").read_text() if code == 0 else capsys.readouterr().err
    assert any(text in told for text in words)


@pytest.fixture(params=["data", "videos"])
def spoilt(request: pytest.FixtureRequest, apart: Path, tmp_path: Path) -> tuple[Path, Path]:
    """A dataset without one file of episode 1, and the path of that file."""
    root = Path(shutil.copytree(apart, tmp_path / "d"))
    (path,) = root.glob(f"{request.param}/**/file-001.*")
    path.unlink()
    return root, path


def test_the_checks_judge_the_other_episodes(spoilt: tuple[Path, Path]) -> None:
    root, path = spoilt
    found = {result.check: result for result in checked(root, "dataset", images=False).results}
    is_data = path.suffix == ".parquet"
    assert (found["unreadable_episodes"].verdict == "broken") == is_data
    assert (found["video_places"].verdict == "broken") != is_data
    assert path.name in found["unreadable_episodes" if is_data else "video_places"].findings[0].message
    assert {found[name].verdict for name in ("missing_numbers", "contradicting_counts", "wrong_statistics")} <= {
        "good",
        "not measured",
    }
    assert found["missing_numbers"].verdict == "good"


def test_the_other_episodes_are_shown(spoilt: tuple[Path, Path], tmp_path: Path) -> None:
    root, _ = spoilt
    assert exit_code("view", root, "--episodes", "2:4", "--save", tmp_path / "shown.rrd") == 0
    assert exit_code("view", root, "--episodes", "1", "--save", tmp_path / "bad.rrd") == 1


def test_a_report_shows_the_other_episodes(spoilt: tuple[Path, Path], tmp_path: Path) -> None:
    root, path = spoilt
    assert exit_code("report", root, "--no-checks", "--out", tmp_path / "page.html") == 0
    page = (tmp_path / "page.html").read_text()
    assert path.name in page
    assert all(f"episode {number}" in page for number in range(NUM_EPISODES))


def test_the_other_episodes_are_imported(
    spoilt: tuple[Path, Path], apart: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root, path = spoilt
    assert exit_code("import", "lerobot", root, "--out", tmp_path / "run") == 1
    assert exit_code("import", "lerobot", root, "--out", tmp_path / "run", "--skip-bad") == 1
    told = capsys.readouterr().out
    assert f"3 episodes, {3 * LENGTH} frames" in told
    assert "Skipped 1 of 4 episodes:" in told
    assert path.name in told.splitlines()[-1]
    assert [file.stem for file in recordings(tmp_path / "run")] == [f"episode_00000{number}" for number in (0, 2, 3)]
    (root / path.relative_to(root)).write_bytes((apart / path.relative_to(root)).read_bytes())
    assert exit_code("import", "lerobot", root, "--out", tmp_path / "run") == 0
    assert exit_code("import", "lerobot", apart, "--out", tmp_path / "other") == 0
    assert len(recordings(tmp_path / "run")) == NUM_EPISODES
    for mine, other in zip(recordings(tmp_path / "run"), recordings(tmp_path / "other"), strict=True):
        assert mine.read_bytes() == other.read_bytes()


def test_chosen_episodes_are_imported(
    spoilt: tuple[Path, Path], apart: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root, _ = spoilt
    assert exit_code("import", "lerobot", root, "--episodes", "3,2:", "--out", tmp_path / "run") == 0
    assert f"2 episodes, {2 * LENGTH} frames" in capsys.readouterr().out
    assert exit_code("import", "lerobot", apart, "--out", tmp_path / "other") == 0
    for mine, name in zip(recordings(tmp_path / "run"), ("episode_000002.mcap", "episode_000003.mcap"), strict=True):
        assert mine.read_bytes() == (tmp_path / "other/episodes" / name).read_bytes()
    # A later import adds the other episodes, in their current state, to the same run.
    assert exit_code("import", "lerobot", root, "--episodes", "0", "--out", tmp_path / "run") == 0
    assert [file.stem for file in recordings(tmp_path / "run")] == [f"episode_00000{number}" for number in (0, 2, 3)]


@pytest.mark.parametrize(
    ("words", "told"),
    [("9", "--episodes 9 is out of range: choose from 0 to 3."), ("2:9", "2:9 is out of range"),
     ("2:1", "2:1 ends before it begins"),
     ("first", "expected numbers and ranges such as 0:100, ::2 or 3,5,8:10.")],
)  # fmt: skip
def test_missing_episodes_are_one_sentence(
    words: str, told: str, apart: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert exit_code("import", "lerobot", apart, f"--episodes={words}", "--out", tmp_path / "run") == 2
    error = capsys.readouterr().err
    assert told in error
    assert error.count("\n") == 1
    assert not (tmp_path / "run").exists()


def test_the_other_episodes_are_edited(spoilt: tuple[Path, Path], apart: Path, tmp_path: Path) -> None:
    root, _ = spoilt
    assert exit_code("dataset", "drop", root, "--episodes", "1", "--out", tmp_path / "new") == 0
    assert exit_code("dataset", "drop", apart, "--episodes", "1", "--out", tmp_path / "expected") == 0
    assert content_of(tmp_path / "new") == content_of(tmp_path / "expected")
    assert exit_code("dataset", "drop", root, "--episodes", "0", "--out", tmp_path / "bad") == 1
    assert not (tmp_path / "bad").exists()
