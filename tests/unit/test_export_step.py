"""A run's dataset: made once, made again when damaged, deleted only if it is proven to be the run's."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from support.export import export, files_of, make_run, without_verification

from demorec.core.config import GenerateConfig, deciding_versions
from demorec.core.errors import ConfigError
from demorec.extensions.datasets.inspect import dataset_digest
from demorec.generate.export_step import export_run
from demorec.runs.run_file import GeneratedRun, load_run_file, save_run_file


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of made-up episodes with its dataset, to be copied."""
    folder = make_run(tmp_path_factory.mktemp("run") / "run", (5, 4))
    save_run_file(GeneratedRun(config=GenerateConfig(), versions=deciding_versions(), num_episodes=2), folder)
    with pytest.MonkeyPatch.context() as patch:
        without_verification(patch)
        export_run(folder, repo_id="me/cubes")
    return folder


@pytest.fixture
def run(exported: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    without_verification(monkeypatch)
    return shutil.copytree(exported, tmp_path / "run")


DAMAGED = (
    "meta/info.json",
    "meta/stats.json",
    "meta/tasks.parquet",
    "meta/episodes/chunk-000/file-000.parquet",
    "data/chunk-000/file-000.parquet",
    "videos/observation.images.wrist/chunk-000/file-000.mp4",
    "demorec/episodes/chunk-000/file-000.parquet",
    "demorec/configs.json",
)


@pytest.mark.parametrize(("name", "share"), [*((name, 0.6) for name in DAMAGED), (DAMAGED[0], 0.0)])
def test_a_dataset_cut_by_a_power_failure_is_set_aside_and_made_again(run: Path, name: str, share: float) -> None:
    good = files_of(run / "dataset")
    digest = load_run_file(run).export.dataset_digest  # type: ignore[union-attr]
    file = run / "dataset" / name
    file.write_bytes(file.read_bytes()[: int(share * file.stat().st_size)])
    bad = files_of(run / "dataset")
    assert bad != good
    said: list[str] = []
    record, report = export_run(run, repo_id="me/cubes", says=said.append)
    assert report is not None
    assert record.dataset_digest == digest == dataset_digest(run / "dataset")
    assert files_of(run / "unfinished" / "dataset") == bad
    assert "moved to unfinished/dataset" in said[0]
    assert export_run(run, repo_id="me/cubes") == (record, None)


def test_a_dataset_that_was_appended_to_is_not_deleted(run: Path, tmp_path: Path) -> None:
    other = make_run(tmp_path / "other", (6,), seed=1)
    export(other, run / "dataset", append=True)
    longer = files_of(run / "dataset")
    export_run(run, repo_id="me/cubes")
    assert files_of(run / "unfinished" / "dataset") == longer
    assert json.loads((run / "dataset/meta/info.json").read_text())["total_episodes"] == 2


@pytest.mark.parametrize("is_ours", [True, False])
def test_after_a_kill_in_the_export_only_the_runs_own_dataset_is_replaced(run: Path, is_ours: bool) -> None:
    """run.json records the beginning of the export, but not its result."""
    plain = json.loads((run / "run.json").read_text())
    plain["export"]["dataset_digest"] = ""
    (run / "run.json").write_text(json.dumps(plain))
    if is_ours:
        configs = run / "dataset/demorec/configs.json"
        (only,) = json.loads(configs.read_text()).values()
        configs.write_text(json.dumps({load_run_file(run).config_digest: only}))
    assert export_run(run, repo_id="me/cubes")[1] is not None
    assert (run / "unfinished" / "dataset").exists() == (not is_ours)


@pytest.mark.parametrize("foreign", ["mine.txt", "data/notes.csv", ".git/HEAD"])
def test_a_dataset_with_foreign_files_is_set_aside_when_the_run_has_changed(run: Path, foreign: str) -> None:
    note = run / "dataset" / foreign
    note.parent.mkdir(exist_ok=True)
    note.write_text("years of work")
    before = files_of(run / "dataset")
    assert export_run(run, repo_id="me/cubes")[1] is None  # kept as long as there is nothing to do
    assert files_of(run / "dataset") == before
    said: list[str] = []
    assert export_run(run, repo_id="me/other", says=said.append)[1] is not None
    (line,) = said
    assert line.startswith("dataset/ was moved to unfinished/dataset and is made again, since it ")
    assert files_of(run / "unfinished" / "dataset") == before
    assert not (run / "dataset" / foreign).exists()


@pytest.mark.parametrize("is_known", [True, False])
def test_an_edited_card_is_kept_when_the_run_has_changed(run: Path, is_known: bool) -> None:
    if not is_known:  # the run file was lost
        save_run_file(replace(load_run_file(run), export=None), run)
        configs: dict[str, object] = {load_run_file(run).config_digest: {}}
        (run / "dataset" / "demorec" / "configs.json").write_text(json.dumps(configs))
    with (run / "dataset" / "README.md").open("a") as card:
        card.write("my own card\n")
    for number, name in enumerate(("README.md", "README.md.1")):
        edited = (run / "dataset" / "README.md").read_bytes()
        said: list[str] = []
        export_run(run, repo_id=f"me/other_{number}", says=said.append)
        assert f"moved to unfinished/{name}" in said[0]
        assert (run / "unfinished" / name).read_bytes() == edited
        fresh = (run / "dataset" / "README.md").read_text()
        assert f"# me/other_{number}\n" in fresh
        assert "my own card" not in fresh
        (run / "dataset" / "README.md").write_text("another card of mine")
    assert not (run / "unfinished" / "dataset").exists()


def test_a_third_party_dataset_is_left_alone(run: Path) -> None:
    plain = json.loads((run / "run.json").read_text())
    plain["export"] = None
    (run / "run.json").write_text(json.dumps(plain))
    before = files_of(run / "dataset")
    with pytest.raises(ConfigError, match="did not make"):
        export_run(run, repo_id="me/cubes")
    assert files_of(run / "dataset") == before


def test_a_dataset_is_recognised_after_its_run_file_was_lost(run: Path) -> None:
    lost = replace(load_run_file(run), export=None)
    (run / "dataset" / "demorec" / "configs.json").write_text(json.dumps({lost.config_digest: {}}))
    before = files_of(run / "dataset")
    save_run_file(lost, run)
    record, report = export_run(run, repo_id="me/cubes")
    assert report is not None
    assert record.dataset_digest == report.digest
    assert files_of(run / "dataset").keys() == before.keys()


def test_a_dataset_of_other_episodes_is_left_alone_when_the_run_file_was_lost(run: Path) -> None:
    configs = run / "dataset" / "demorec" / "configs.json"
    configs.write_text(json.dumps({**json.loads(configs.read_text()), "0" * 16: {}}))
    before = files_of(run / "dataset")
    save_run_file(replace(load_run_file(run), export=None), run)
    with pytest.raises(ConfigError, match="in the way"):
        export_run(run, repo_id="me/cubes")
    assert files_of(run / "dataset") == before


def test_a_moved_dataset_is_made_again_and_reported(run: Path, tmp_path: Path) -> None:
    (run / "dataset").rename(tmp_path / "mine")
    before = files_of(tmp_path / "mine")
    said: list[str] = []
    assert export_run(run, repo_id="me/cubes", says=said.append)[1] is not None
    assert said == ["dataset/ is missing; it is made again."]
    assert files_of(tmp_path / "mine") == before
    assert not (run / "unfinished" / "dataset").exists()
