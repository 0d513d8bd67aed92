"""Collected episodes as HDF5 in robomimic's layout: h5py is the judge, and robomimic where it is installed."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from support.export import export
from support.external import FORCE, STATE, TOP, URDF, make_external, write_external

from demorec.core.errors import ConfigError, ExportError
from demorec.mcap import Recording


def run_of(folder: Path, *outcomes: bool | None) -> Path:
    """An episode of 20 frames with one camera for each outcome."""
    (folder / "episodes").mkdir(parents=True)
    for index, success in enumerate(outcomes):
        given = make_external(cameras=(TOP,), num_frames=20, episode_index=index, success=success)
        write_external(folder / "episodes" / f"episode_{index:06d}.mcap", given)
    return folder


def test_numbers_and_pictures_are_those_of_the_recordings(tmp_path: Path) -> None:
    run = run_of(tmp_path / "run", True, None)
    report = export(run, tmp_path / "d.hdf5", "hdf5")
    assert (report.num_episodes, report.num_frames) == (2, 40)
    with h5py.File(tmp_path / "d.hdf5") as file:
        for index in range(2):
            given, demo = make_external(cameras=(TOP,), num_frames=20, episode_index=index), file[f"data/demo_{index}"]
            vectors = {"obs/state": STATE.name, "obs/force": FORCE.name, "actions": "action"}
            for place, name in vectors.items():
                expected = np.array([frame.samples[name].vector for frame in given.frames])
                assert demo[place].dtype == expected.dtype
                np.testing.assert_array_equal(demo[place][:], expected)
            assert json.loads(demo["obs/force"].attrs["names"]) == ["x", "y", "z"]
            with Recording(run / "episodes" / f"episode_{index:06d}.mcap") as recording:
                np.testing.assert_array_equal(demo["obs/top_image"][:], np.array(list(recording.images("top"))))
            assert demo["dones"][:].tolist() == [0] * 19 + [1]
            assert (demo.attrs["instruction"], demo.attrs["model_file"]) == ("stack the cups", URDF)
            assert set(demo["obs"]) == {"state", "force", "top_image"}


def test_what_nobody_knows_is_left_out(tmp_path: Path) -> None:
    export(run_of(tmp_path / "run", True, False, None), tmp_path / "d.hdf5", "hdf5", include_failures=True)
    with h5py.File(tmp_path / "d.hdf5") as file:
        good, bad, unknown = (file[f"data/demo_{index}"] for index in range(3))
        assert (good["rewards"][:].sum(), bad["rewards"][:].sum()) == (1, 0)
        assert (bool(good.attrs["success"]), bool(bad.attrs["success"])) == (True, False)
        assert "rewards" not in unknown
        assert "success" not in unknown.attrs
        assert all("states" not in demo for demo in (good, bad, unknown))
        assert json.loads(file["data"].attrs["env_args"])["env_name"] == "demorec/collected"


def test_it_is_replaced_only_as_it_was_written(tmp_path: Path) -> None:
    run, out = run_of(tmp_path / "run", True), tmp_path / "d.hdf5"
    export(run, out, "hdf5")
    export(run, out, "hdf5", overwrite=True)
    with h5py.File(out, "a") as file:
        file["data/demo_0/obs/mine"] = 1
    with pytest.raises(ConfigError, match="data/demo_0/obs/mine"):
        export(run, out, "hdf5", overwrite=True)


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


def test_a_missing_picture_is_an_error(tmp_path: Path) -> None:
    path = write_external(tmp_path / "a.mcap", make_external(num_frames=5))  # the wrist has none at first
    with pytest.raises(ExportError, match="Frame 0 has no image of the camera wrist"):
        export(path, tmp_path / "d.hdf5", "hdf5")
    assert not (tmp_path / "d.hdf5").exists()


def test_robomimic_reads_it(tmp_path: Path) -> None:
    """robomimic's own reader, where it is installed: its dependencies need a compiler, so it is none of ours."""
    dataset = pytest.importorskip("robomimic.utils.dataset", reason="robomimic is not installed")
    from robomimic.utils import file_utils, obs_utils

    export(run_of(tmp_path / "run", True, True), tmp_path / "d.hdf5", "hdf5")
    obs_utils.initialize_obs_utils_with_obs_specs({"obs": {"low_dim": ["state"], "rgb": ["top_image"]}})
    assert file_utils.get_env_metadata_from_dataset(tmp_path / "d.hdf5")["env_name"] == "demorec/collected"
    read = dataset.SequenceDataset(
        hdf5_path=str(tmp_path / "d.hdf5"),
        obs_keys=["state", "top_image"],
        dataset_keys=["actions", "rewards", "dones"],
        seq_length=3,
        load_next_obs=False,
    )
    given = make_external(cameras=(TOP,), num_frames=20)
    expected = np.array([frame.samples[STATE.name].vector for frame in given.frames[1:4]])
    np.testing.assert_array_equal(read[1]["obs"]["state"], expected)
