"""External episodes as datasets: numbers and packets equal those of the recordings, and gaps are not filled."""

from __future__ import annotations

import json
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import h5py
import numpy as np
import pytest
from support.export import data_table, export
from support.external import FORCE, STATE, TOP, Episode, make_external, write_external
from support.recording import write_episode

from demorec.core.errors import ConfigError, ExportError
from demorec.core.tables import EXPORTERS


def run_of(folder: Path, *episodes: Episode) -> Path:
    (folder / "episodes").mkdir(parents=True)
    for number, episode in enumerate(episodes):
        write_external(folder / "episodes" / f"episode_{number:06d}.mcap", episode)
    return folder


def complete(**arguments: Any) -> Episode:
    """An episode in which every frame has its image."""
    return make_external(cameras=(TOP,), **arguments)


def of_outcomes(*outcomes: bool | None) -> list[Episode]:
    """An episode of 20 frames for each outcome."""
    return [complete(num_frames=20, episode_index=index, success=success) for index, success in enumerate(outcomes)]


def test_numbers_are_those_of_the_recordings(tmp_path: Path) -> None:
    episodes = [complete(num_frames=length, episode_index=index) for index, length in enumerate((20, 33))]
    report = export(run_of(tmp_path / "run", *episodes), tmp_path / "d")
    assert (report.num_episodes, report.num_frames, report.transcoded) == (2, 53, ())
    table = data_table(tmp_path / "d")
    for name in ("observation.state", "observation.force", "action"):
        expected = [frame.samples[name].vector.astype(np.float32) for episode in episodes for frame in episode.frames]
        assert np.array_equal(np.array(table.column(name).to_pylist(), dtype=np.float32), np.array(expected)), name
    assert [index for index, done in enumerate(table.column("next.done").to_pylist()) if done] == [19, 52]
    info = json.loads((tmp_path / "d" / "meta" / "info.json").read_text())
    assert info["features"]["observation.state"]["names"] == ["shoulder.pos", "elbow.pos", "gripper.pos"]
    assert "next.success" not in info["features"]
    card = (tmp_path / "d" / "README.md").read_text()
    assert "2 demonstrations of two_joints, 53 frames" in card
    assert "scripted" not in card


def test_numbers_that_float32_does_not_hold_are_refused_where_it_is_written(tmp_path: Path) -> None:
    """LeRobot's datasets have float32; robomimic's files keep the recorded type."""
    given = complete(num_frames=5)
    given.frames[2].samples["observation.force"].vector[1] = 1e300
    run = run_of(tmp_path / "run", given)
    with pytest.raises(ExportError, match=r"observation\.force is too large for float32 in frame 2"):
        export(run, tmp_path / "d")
    export(run, tmp_path / "d.hdf5", "hdf5")
    with h5py.File(tmp_path / "d.hdf5") as file:
        assert file["data/demo_0/obs/force"][2, 1] == 1e300


def test_a_missing_image_is_an_error(tmp_path: Path) -> None:
    episode = complete(num_frames=30)
    gap = [replace(frame, images={}) if index in (7, 8) else frame for index, frame in enumerate(episode.frames)]
    run = run_of(tmp_path / "run", replace(episode, frames=gap))
    with pytest.raises(ExportError, match="Frame 7 has no image of the camera top, like 2 of 30 frames"):
        export(run, tmp_path / "d")


@pytest.mark.parametrize("exporter", EXPORTERS.names())
def test_a_failure_that_stays_out_blocks_nothing(tmp_path: Path, exporter: str) -> None:
    """Failed episodes that lack an image, or have other cameras and features, or another rate."""
    failed: dict[str, Any] = {"episode_index": 1, "num_frames": 5, "success": False}
    without = complete(**failed)
    without = replace(without, frames=[replace(frame, images={}) for frame in without.frames], images={"top": []})
    blind = make_external(cameras=(), **failed | {"episode_index": 2})
    slow = complete(**failed | {"episode_index": 3})
    slow = replace(slow, info=replace(slow.info, fps=20))
    run = run_of(tmp_path / "run", complete(num_frames=5), without, blind, slow)
    report = export(run, tmp_path / "d", exporter)
    assert (report.num_episodes, report.num_frames, report.skipped_failures) == (1, 5, 3)
    cases = {"": "no image of the camera top|cameras is none", "0,2": "cameras is none"}
    for episodes, error in cases.items():
        with pytest.raises((ExportError, ConfigError), match=error):
            export(run, tmp_path / "e", exporter, include_failures=True, episodes=episodes)
    other = run_of(tmp_path / "other", make_external(cameras=(), num_frames=5))
    with pytest.raises(ConfigError, match="cameras is none instead of top") as refused:
        export([run, other], tmp_path / "e", exporter)
    assert "fps is 20" not in str(refused.value)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"action": "ee"}, "action ee needs the scene"),
        ({"privileged": True}, "privileged needs the scene"),
        ({"intervention": True}, "intervention needs the scene"),
        ({"depth": True}, "depth needs recordings"),
        ({"features": ("observation.forse",)}, "Unknown feature 'observation.forse'.*observation.force"),
    ],
)
def test_options_that_an_external_episode_cannot_serve(tmp_path: Path, options: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        export(run_of(tmp_path / "run", complete(num_frames=5)), tmp_path / "d", **options)


def test_episodes_of_other_kinds_do_not_mix(tmp_path: Path) -> None:
    run = run_of(tmp_path / "run", complete(num_frames=5))
    write_episode(tmp_path / "run" / "episodes" / "episode_000001.mcap", num_frames=5)
    with pytest.raises(ConfigError, match="kind of episode is simulated instead of external"):
        export(run, tmp_path / "d")


def test_kept_h265_becomes_hevc(tmp_path: Path) -> None:
    from typing import cast

    from demorec.extensions.recorder.sampled_writer import SampledWriter

    context = cast(av.VideoCodecContext, av.CodecContext.create("libx265", "w"))
    context.width, context.height, context.pix_fmt, context.time_base = 64, 48, "yuv420p", Fraction(1, 30)
    context.options = {"tune": "zerolatency", "x265-params": "log-level=none:bframes=0:keyint=5"}
    episode = make_external(num_frames=12, cameras=(replace(TOP, kept="h265"),))
    packets = []
    for index in range(12):
        frame = av.VideoFrame.from_ndarray(np.full((48, 64, 3), 9 * index, dtype=np.uint8), format="rgb24")
        frame.pts = index
        packets += [bytes(packet) for packet in context.encode(frame)]
    packets += [bytes(packet) for packet in context.encode(None)]
    (tmp_path / "run" / "episodes").mkdir(parents=True)
    with SampledWriter(tmp_path / "run" / "episodes" / "episode_000000.mcap", episode.info) as writer:
        for frame_, packet in zip(episode.frames, packets, strict=True):
            writer.image("top", frame_.time_ns, packet)
            writer.write(frame_)
        writer.finish(episode.outcome)
    report = export(tmp_path / "run", tmp_path / "d")
    assert report.transcoded == ()
    with av.open(str(next((tmp_path / "d" / "videos").rglob("*.mp4")))) as file:
        assert file.streams.video[0].codec_context.name == "hevc"
        shown = [int(image.to_ndarray(format="rgb24").mean()) for image in file.decode(video=0)]
    assert np.abs(np.array(shown) - 9 * np.arange(12)).max() < 6


def test_an_hdf5_file_has_no_invented_data(tmp_path: Path) -> None:
    run = run_of(tmp_path / "run", *of_outcomes(True, False, None))
    export(run, tmp_path / "d.hdf5", "hdf5", include_failures=True)
    with h5py.File(tmp_path / "d.hdf5") as file:
        good, bad, unknown = (file[f"data/demo_{index}"] for index in range(3))
        assert (good["rewards"][:].sum(), bad["rewards"][:].sum()) == (1, 0)
        assert (bool(good.attrs["success"]), bool(bad.attrs["success"])) == (True, False)
        assert "rewards" not in unknown
        assert "success" not in unknown.attrs
        assert all("states" not in demo for demo in (good, bad, unknown))
        assert json.loads(file["data"].attrs["env_args"])["env_name"] == "demorec/collected"


def test_streams_of_one_name_are_refused(tmp_path: Path) -> None:
    given = make_external(cameras=(TOP,), num_frames=5)
    force = replace(FORCE, name="state")
    frames = [
        replace(frame, samples={**{k: v for k, v in frame.samples.items() if k != FORCE.name}, "state": sample})
        for frame in given.frames
        for sample in [frame.samples[FORCE.name]]
    ]
    info = replace(given.info, features=(*given.info.features[:2], force))
    path = write_external(tmp_path / "a.mcap", replace(given, info=info, frames=frames))
    with pytest.raises(ConfigError, match="Two streams of the episode would be called state"):
        export(path, tmp_path / "d.hdf5", "hdf5")
    assert not (tmp_path / "d.hdf5").exists()


def test_an_episode_without_actions_is_refused(tmp_path: Path) -> None:
    given = make_external(cameras=(), num_frames=5)
    frames = [replace(frame, samples={STATE.name: frame.samples[STATE.name]}) for frame in given.frames]
    info = replace(given.info, features=(STATE,))
    path = write_external(tmp_path / "a.mcap", replace(given, info=info, frames=frames))
    with pytest.raises(ConfigError, match="needs actions"):
        export(path, tmp_path / "d.hdf5", "hdf5")
