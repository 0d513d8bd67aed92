"""A LeRobot v2.1 dataset, written with PyArrow and av, is read; only appending to it requires a conversion."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

import pytest
from support.commands import exit_code
from support.drawn_datasets import PLAIN, STATE, TASKS, write_v21
from support.export import recordings
from support.stored_episodes import stored_episodes

from demorec.extensions.datasets.folder import LeRobotFolder
from demorec.extensions.datasets.playback import open_dataset_episode
from demorec.mcap import Recording

SAMPLE = Path(__file__).parents[2] / "recordings" / "sample" / "pick_place.mcap"


def assert_imported(root: Path, run: Path) -> None:
    """Check that numbers, instruction and images of every episode are those of the dataset's files."""
    assert exit_code("import", "lerobot", root, "--out", run) == 0
    for episode, (path, stored) in enumerate(zip(recordings(run), stored_episodes(root), strict=True)):
        with Recording(path) as recording:
            assert recording.table().features[STATE].tolist() == stored.columns[STATE]
            assert (recording.info.instruction, recording.info.robot_name) == (TASKS[episode], "arm")
            assert recording.info.cameras[0].kept == "h264"
            assert len(list(recording.images("top"))) == PLAIN.lengths[episode]


@pytest.mark.parametrize("version", ["v2.0", "v2.1"])
def test_it_is_imported_and_shown(version: str, tmp_path: Path) -> None:
    root = write_v21(tmp_path / "cups")
    path = root / "meta" / "info.json"
    path.write_text(path.read_text().replace("v2.1", version))
    assert_imported(root, tmp_path / "run")
    with open_dataset_episode(LeRobotFolder(root), 1) as episode:
        assert episode.info.simulation is None
        assert episode.curves[STATE].values.tolist() == stored_episodes(root)[1].columns[STATE]
        assert len(list(episode.packets("top"))) == PLAIN.lengths[1]


def test_an_export_that_would_append_names_the_command_that_converts_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = write_v21(tmp_path / "my cups")
    assert exit_code("export", "lerobot", SAMPLE, "--out", root, "--append", "--no-verify") == 1
    told = capsys.readouterr().err.strip()
    assert "format v2.1, and only v3.0 can be appended to" in told
    _, *arguments = shlex.split(told[told.index("demorec dataset select") :])
    assert exit_code(*arguments[:-1], tmp_path / "new") == 0
    assert json.loads((tmp_path / "new/meta/info.json").read_text())["codebase_version"] == "v3.0"
    assert_imported(tmp_path / "new", tmp_path / "run")


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("info.json", '"v2.1"|"v9.0"', "format v9.0, supported are v2.0, v2.1 and v3.0"),
        ("episodes.jsonl", '"length": 5|"length": -5', "has -5 as length"),
        ("episodes.jsonl", '{"episode_index": 1|[{"episode_index": 1', "The table cannot be read"),
        ("tasks.jsonl", '"task_index": 0|"task_index": null', "has None as task_index"),
    ],
)
def test_a_damaged_dataset_is_refused_in_a_sentence(
    name: str, text: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = write_v21(tmp_path / "cups")
    path, (old, new) = root / "meta" / name, text.split("|")
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new))
    assert exit_code("import", "lerobot", root, "--out", tmp_path / "run") == 1
    told = capsys.readouterr().err.splitlines()[-1]
    assert words in told
