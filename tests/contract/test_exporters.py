"""Guarantees of every row in the table of exporters."""

from __future__ import annotations

import shutil
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from support.export import content_of, export, feature_of, files_of, make_run
from support.recording import make_episode

from demorec.cli.shared.paths import refuse_inside
from demorec.core.config import VideoConfig
from demorec.core.errors import ConfigError, DemorecError, RecordingError
from demorec.core.extension import exporter_rows
from demorec.core.tables import EXPORTERS
from demorec.extensions.recovery.recover import recover
from demorec.mcap import EpisodeWriter, Recording
from demorec.runs.find import find, name_of

ON_REQUEST = ("observation.effort", "observation.contact_force", "observation.wrench")

pytestmark = pytest.mark.parametrize("exporter", EXPORTERS.names())


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_run(tmp_path_factory.mktemp("run") / "run", (6, 5, 4), failures=(1,))


def test_only_selected_episodes_are_exported_and_nothing_else_changes(exporter: str, run: Path, tmp_path: Path) -> None:
    before = files_of(run)
    row = EXPORTERS.load(exporter)
    calls: list[tuple[int, int]] = []
    options = row.options(episodes="1:", **({"verify": False} if exporter == "lerobot" else {}))
    report = row.export([run], tmp_path / "a" / "d", options, lambda done, total: calls.append((done, total)))
    assert (report.num_episodes, report.num_frames, report.skipped_failures) == (2, 9, 1)
    assert report.path == tmp_path / "a" / "d"
    assert calls == [(1, 4), (2, 4), (3, 4), (4, 4)]
    assert [path.name for path in (tmp_path / "a").iterdir()] == ["d"]
    assert files_of(run) == before


def test_sensor_features_are_exported_by_name(exporter: str, run: Path, tmp_path: Path) -> None:
    with Recording(run / "episodes" / "episode_000000.mcap") as recording:
        trajectory = recording.trajectory()
    features = {
        "observation.effort": trajectory.joint_effort[:, :7],
        "observation.contact_force": trajectory.contact_force[:, np.newaxis],
        "observation.wrench": trajectory.sensed["wrench"],
        "command": np.column_stack([trajectory.command_joint_target, trajectory.command_gripper]),
    }
    assert features.keys() == {*ON_REQUEST, "command"}
    export(run, tmp_path / "d", exporter, features=tuple(features), episodes="0")
    for name, expected in features.items():
        assert np.ptp(expected) > 0
        found, names = feature_of(tmp_path / "d", name, exporter)
        assert found.dtype in (np.float32, np.float64)
        assert np.array_equal(found, expected.astype(found.dtype)), name
        assert len(names) == expected.shape[1]
    export(run, tmp_path / "d", exporter, overwrite=True)  # files with it are still recognised


def test_its_result_is_recognised(exporter: str, run: Path, tmp_path: Path) -> None:
    """Every command that is given the result recognises it; in a folder, none writes anything else."""
    suffixes = exporter_rows()[exporter].suffixes or ("",)
    out = tmp_path / f"d{suffixes[0]}"
    export(run, out, exporter)
    kind = find(out).kind
    assert kind not in ("nothing", "unreadable")
    assert name_of(kind)
    if out.is_dir():
        with pytest.raises(ConfigError, match="A new file inside a dataset would prevent"):
            refuse_inside([out / "inner"])


def test_a_recovered_recording_is_left_out_like_a_failed_attempt(exporter: str, run: Path, tmp_path: Path) -> None:
    sources = [run / "episodes" / "episode_000000.mcap", tmp_path / "recovered.mcap"]
    info, frames, _ = make_episode(num_frames=70, episode_index=7)
    with suppress(InterruptedError), EpisodeWriter(tmp_path / "cut.mcap", info) as writer:
        for frame in frames:
            writer.write(frame)
        raise InterruptedError
    recover(tmp_path / "cut.mcap.part", sources[1])
    report = export(sources, tmp_path / "d", exporter)
    assert (report.num_episodes, report.skipped_failures) == (1, 1)
    with pytest.raises(ConfigError, match="failed or unfinished attempts: 1"):
        export(sources[1:], tmp_path / "e", exporter)


def test_the_same_recordings_give_the_same_bytes(exporter: str, run: Path, tmp_path: Path) -> None:
    export(run, tmp_path / "a", exporter, privileged=True, action="ee_delta")
    export(run, tmp_path / "b", exporter, privileged=True, action="ee_delta")
    assert content_of(tmp_path / "a") == content_of(tmp_path / "b")


def test_a_dataset_is_replaced_only_on_request(exporter: str, run: Path, tmp_path: Path) -> None:
    export(run, tmp_path / "d", exporter, episodes="0")
    before = content_of(tmp_path / "d")
    with pytest.raises(ConfigError, match="exists already"):
        export(run, tmp_path / "d", exporter)
    assert content_of(tmp_path / "d") == before
    assert export(run, tmp_path / "d", exporter, overwrite=True).num_episodes == 3
    assert content_of(tmp_path / "d") != before
    assert [path.name for path in tmp_path.iterdir()] == ["d"]


@pytest.mark.parametrize("kind", ["file", "folder", "recording"])
def test_other_files_are_never_replaced(exporter: str, run: Path, tmp_path: Path, kind: str) -> None:
    out = tmp_path / "d"
    if kind == "file":
        out.write_text("years of work")
    elif kind == "folder":
        out.mkdir()
        (out / "thesis.txt").write_text("years of work")
    else:
        shutil.copy(run / "episodes" / "episode_000000.mcap", out)
    before = content_of(out)
    with pytest.raises(ConfigError, match="never replaced"):
        export(run, out, exporter, overwrite=True)
    assert content_of(out) == before


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"episodes": "7"}, ConfigError, "Nothing to export"),
        ({"episodes": "x"}, ConfigError, "0:100"),
        ({"features": ("observation.stat",)}, ConfigError, "Did you mean 'observation.state'"),
        ({"features": ("front",)}, ConfigError, "observation.images.front, observation.images.wrist"),
        ({"features": ("observation.environment_state",)}, ConfigError, "only --privileged adds it"),
        ({"depth": True}, ConfigError, "needs recordings with depth images"),
    ],
)
def test_a_refused_export_leaves_nothing(
    exporter: str,
    run: Path,
    tmp_path: Path,
    options: dict[str, object],
    error: type[DemorecError],
    message: str,
) -> None:
    with pytest.raises(error, match=message):
        export(run, tmp_path / "d", exporter, **options)
    assert list(tmp_path.iterdir()) == []


def test_recordings_that_differ_are_refused(exporter: str, run: Path, tmp_path: Path) -> None:
    other = make_run(tmp_path / "other", (4,), video=VideoConfig(), width=48)
    with pytest.raises(ConfigError, match=r"does not fit into one dataset.*48x48 instead of 64x48"):
        export([run, other], tmp_path / "d", exporter)
    assert [path.name for path in tmp_path.iterdir()] == ["other"]


def test_a_damaged_recording_leaves_nothing(exporter: str, run: Path, tmp_path: Path) -> None:
    spoilt = tmp_path / "run"
    shutil.copytree(run, spoilt)
    path = spoilt / "episodes" / "episode_000002.mcap"
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(RecordingError):
        export(spoilt, tmp_path / "d", exporter)
    assert [path.name for path in tmp_path.iterdir()] == ["run"]
